"""The search for a plane: what hides it, and how often it is missed all the same."""

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.scanning.plane_search import JY, N_ROWS, WEIGHT, X, Z, search_plane

N_LASERS, N_SUBSEGMENTS, N_SEEDS = 3, 63, 400


def stripes() -> FloatArray:
    """A plane with a fifth of the light, two thirds of that on another one, the rest scattered."""
    rng = np.random.default_rng(5)
    table = np.zeros((N_ROWS, N_LASERS * N_SUBSEGMENTS))
    table[JY], table[WEIGHT] = 1e-3, rng.uniform(3.0, 6.0, table.shape[1])
    for laser in range(N_LASERS):
        mine = slice(laser * N_SUBSEGMENTS, (laser + 1) * N_SUBSEGMENTS)
        along = np.linspace(-0.25, 0.25, N_SUBSEGMENTS)
        depth = rng.uniform(0.3, 1.5, N_SUBSEGMENTS)
        net_mask = rng.permutation(N_SUBSEGMENTS)[:14]
        depth[net_mask] = 0.6
        if laser:
            depth[rng.permutation(N_SUBSEGMENTS)[:13]] = 0.9
        points = np.stack(
            [along, np.ones(N_SUBSEGMENTS), np.full(N_SUBSEGMENTS, 0.1 * (laser - 1))]
        )
        table[X : Z + 1, mine] = points * depth + rng.normal(0.0, 4e-4, (3, N_SUBSEGMENTS))
    return table


def test_a_plane_with_a_fifth_of_the_light_is_found_beside_a_smaller_one() -> None:
    table, laser = stripes(), np.repeat(np.arange(N_LASERS), N_SUBSEGMENTS)
    start = np.arange(N_LASERS + 1) * N_SUBSEGMENTS
    found = np.empty((N_SEEDS, 4))
    for seed in range(N_SEEDS):
        assert search_plane(table, table[WEIGHT], laser, start, 0.24, 1.8, seed, found[seed])
    missed = np.abs(found[:, 3] - 0.6) > 0.01
    assert not missed.any()


def test_a_plane_is_found_whose_heavy_light_is_all_of_one_laser() -> None:
    n_each, table = 20, np.zeros((N_ROWS, 60))
    laser, start = np.repeat(np.arange(N_LASERS), n_each), np.arange(N_LASERS + 1) * n_each
    along = np.tile(np.linspace(-0.25, 0.25, n_each), N_LASERS)
    table[X : Z + 1] = 0.5 * np.stack([along, np.ones(60), 0.1 * (laser - 1.0)])
    table[JY], table[WEIGHT] = 1e-3, np.where(laser == 0, 15.0, 2.5)
    found = np.empty(4)
    assert search_plane(table, table[WEIGHT], laser, start, 0.24, 1.8, 0, found)
    np.testing.assert_allclose(found, [0.0, 1.0, 0.0, 0.5], atol=1e-9)


def test_a_plane_is_found_among_many_lasers_and_much_noise() -> None:
    n_lasers, n_each, n_seeds = 15, 680, 30
    rng = np.random.default_rng(8)
    table = np.zeros((N_ROWS, n_lasers * n_each))
    laser, start = np.repeat(np.arange(n_lasers), n_each), np.arange(n_lasers + 1) * n_each
    depth = rng.uniform(0.3, 1.5, len(laser))
    weight = np.full(len(laser), 3.0)
    # Pieces of four, with an eighth of the light.
    for first in start[:-1]:
        for run in rng.permutation(n_each // 4)[:8]:
            lit = slice(first + 4 * run, first + 4 * run + 4)
            depth[lit], weight[lit] = 0.6, 9.0
    along = np.tile(np.linspace(-0.25, 0.25, n_each), n_lasers)
    points = np.stack([along, np.ones(len(laser)), 0.03 * (laser - 7.0)]) * depth
    table[X : Z + 1] = points + rng.normal(0.0, 3e-4, points.shape)
    table[JY], table[WEIGHT] = 1e-3, weight
    found = np.empty((n_seeds, 4))
    for seed in range(n_seeds):
        assert search_plane(table, table[WEIGHT], laser, start, 0.24, 1.8, seed, found[seed])
    # With a sixth of the trials 12 miss it.
    assert np.count_nonzero(np.abs(found[:, 3] - 0.6) > 0.01) <= 1


def test_a_wall_with_less_sampling_weight_than_the_specks_of_caustics_is_found() -> None:
    n_wall, n_specks, n_pictures = 36, 60, 20
    n_each = n_wall + n_specks
    laser, start = np.repeat(np.arange(N_LASERS), n_each), np.arange(N_LASERS + 1) * n_each
    on_wall = np.tile(np.arange(n_each) < n_wall, N_LASERS)
    # The limited weight of long stripes, and what they have without the limit.
    weight = np.where(on_wall, 0.55, 2.5)
    intensity_weight = np.where(on_wall, 16.0, 2.5)
    missed = np.zeros(2, np.int64)
    for picture in range(n_pictures):
        rng, table = np.random.default_rng(picture), np.zeros((N_ROWS, len(laser)))
        along = np.tile(np.r_[np.linspace(-0.3, 0.3, n_wall), np.zeros(n_specks)], N_LASERS)
        along[~on_wall] = rng.uniform(-0.3, 0.3, N_LASERS * n_specks)
        depth = np.where(on_wall, 0.6, rng.uniform(0.3, 1.5, len(laser)))
        table[X : Z + 1] = np.stack([along, np.ones(len(laser)), 0.1 * (laser - 1.0)]) * depth
        table[JY], table[WEIGHT] = 1e-3, weight
        for k, bright in enumerate((intensity_weight, weight)):
            found = np.empty(4)
            search_plane(table, bright, laser, start, 0.24, 1.8, 0, found)
            missed[k] += abs(found[3] - 0.6) > 0.01
    assert missed[0] == 0
    # By the sampling weights alone.
    assert missed[1] > n_pictures // 2
