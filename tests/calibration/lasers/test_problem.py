"""Derivatives of the joint problem, and what its pieces promise."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.calibration.lasers.problem import N_BOARD_POSE, LaserProblem, LaserState, distances_of
from aqualvs.calibration.lasers.stripes_on_planes import (
    StripePoints,
    TargetSurfaces,
    binned,
    board_surface,
    correlation_factor,
    with_gain,
)
from aqualvs.calibration.solver.bundle import Bundle, BundleState, TargetView
from aqualvs.optics.rig import Rig, RigUncertainty
from aqualvs.optics.sheet import sheets_of
from aqualvs.simulation.scenarios import example_rig
from laser_cases import board_views, box, box_views, dome_from_board, dome_from_box
from windowed_cases import windowed

FREE = ("lens_x", "lens_y", "rotation_z", "fx", "cy", "k1", "inner_radius", "n_acrylic", "n_air")


def made(
    rig: Rig, *, target: str, free: tuple[str, ...] = (), medium: float = 0.0, loose: bool = False
) -> tuple[LaserProblem, LaserState]:
    """A problem at its true state."""
    in_box = target == "box"
    surfaces: TargetSurfaces = box() if in_box else board_surface()
    views = (box_views if in_box else board_views)(rig, spacing=0.02)[:2]
    poses = tuple((dome_from_box if in_box else dome_from_board)(i) for i in range(2))
    state = BundleState(rig, np.array([rig.n_water]), poses)
    shots = tuple(TargetView(v.view, 0, p) for v, p in zip(views, poses, strict=True))
    bundle = Bundle(shots, free, state, RigUncertainty.none(), np.array([medium]))
    camera, sheets, groups, n = rig.camera(), sheets_of(rig), [], len(surfaces.planes)
    for i, view in enumerate(views):
        planes = surfaces.placed(poses[i])
        for i_laser, sheet in enumerate(sheets):
            mine = np.flatnonzero(view.stripes.chain // n == i_laser)
            group = binned(i, i_laser, view.stripes.at(mine), view.stripes.chain[mine] % n)
            groups.append(with_gain(group, camera, planes, sheet))
    prior = np.array([0.01, 0.01, 0.002]) if loose else None
    problem = LaserProblem(bundle, surfaces, tuple(groups), len(sheets), prior)
    return problem, LaserState(state, sheets, np.zeros((2, N_BOARD_POSE)))


@pytest.mark.parametrize(
    ("target", "bent", "medium", "loose"),
    [
        ("box", False, 0.0, False),
        ("box", True, 0.01, False),
        ("board", False, 0.01, False),
        ("board", False, 0.0, True),
    ],
)
def test_jacobians_are_derivatives(target: str, bent: bool, medium: float, loose: bool) -> None:
    rig = windowed(example_rig()) if bent else example_rig()
    problem, state = made(rig, target=target, free=FREE, medium=medium, loose=loose)
    if loose:
        tilted = np.array([[0.02, -0.01, 0.003], [-0.015, 0.02, -0.002]])
        state = replace(state, board_poses=tilted)
    blocks = problem.blocks(state)
    # Different units need different steps: index and radians move pixels more than focal lengths.
    size = np.full(problem.n_parameters, 1e-6)
    for name in ("fx", "cy"):
        size[FREE.index(name)] = 1e-3
    for i in range(problem.n_parameters):
        step = np.zeros(problem.n_parameters)
        step[i] = size[i]
        after, before = (problem.blocks(problem.moved(state, s * step)) for s in (1.0, -1.0))
        for block, up, down in zip(blocks, after, before, strict=True):
            numeric = (up.residuals - down.residuals) / (2.0 * size[i])
            place = np.flatnonzero(block.columns == i)
            exact = block.jacobian[..., place[0]] if len(place) else np.zeros_like(numeric)
            scale = max(1.0, float(np.abs(exact).max(initial=0.0)))
            # Central differences of a step of 1e-6 leave 1e-10 of the residual's 1e3 to 1e5.
            np.testing.assert_allclose(
                numeric, exact, atol=2e-5 * scale, err_msg=str((i, block.group))
            )


@pytest.mark.parametrize("bent", [False, True])
def test_at_the_truth_residuals_vanish(bent: bool) -> None:
    rig = windowed(example_rig()) if bent else example_rig()
    problem, state = made(rig, target="box")
    for block in problem.blocks(state):
        # Bins are means of pixels of a line that is nearly straight: a hundredth of a pixel.
        assert np.abs(block.residuals).max() < 0.1
    for group in problem.groups:
        assert np.abs(distances_of(problem, state, group)).max() < 2e-5


def test_a_pixel_across_is_a_residual_of_one_pixel() -> None:
    problem, state = made(example_rig(), target="box")
    shifted = tuple(replace(g, pixels=g.pixels + 0.5 * g.across) for g in problem.groups)
    moved = replace(problem, groups=shifted)
    n = len(problem.groups)
    for a, b, group in zip(
        problem.blocks(state)[:n], moved.blocks(state)[:n], problem.groups, strict=True
    ):
        change = (b.residuals - a.residuals)[:, 0] * group.sigma_px
        # The gain is held, and the surface is seen under a changing angle.
        np.testing.assert_allclose(np.abs(change), 0.5, rtol=0.01)


def line(n: int, *, sign: float = 1.0, sigma: float = 0.1) -> StripePoints:
    x = np.arange(float(n))
    pixels = np.stack([x, 100.0 + 0.1 * x], axis=-1)
    across = np.tile(sign * np.array([-0.1, 1.0]) / np.hypot(0.1, 1.0), (n, 1))
    return StripePoints(pixels, across, np.zeros(n, np.int64), np.full(n, sigma))


def test_bins_hold_neighbours_and_end_at_gaps() -> None:
    points = line(100)
    points = points.at(np.flatnonzero((np.arange(100) < 40) | (np.arange(100) >= 60)))
    shuffled = points.at(np.random.default_rng(0).permutation(80))
    group = binned(0, 1, shuffled, np.zeros(80, np.int64))
    assert int(group.counts.sum()) == 80
    assert group.counts.max() <= 12
    middle = group.pixels[:, 0]
    assert not np.any((middle > 39.0) & (middle < 60.0))
    np.testing.assert_allclose(group.pixels[:, 1], 100.0 + 0.1 * middle)
    # A full bin is worth one point.
    assert group.sigma_px[group.counts == group.counts.max()] == pytest.approx(0.1)


def test_bins_keep_surfaces_apart_and_heed_noise() -> None:
    points = line(24)
    sigma = np.where(np.arange(24) % 2 == 0, 0.05, 5.0)
    pixels = points.pixels + np.where(np.arange(24) % 2 == 0, 0.0, 3.0)[:, None] * points.across
    flipped = points.across * np.where(np.arange(24) % 3 == 0, -1.0, 1.0)[:, None]
    points = replace(points, sigma_px=sigma, pixels=pixels, across=flipped)
    group = binned(0, 0, points, (np.arange(24) >= 10).astype(np.int64))
    assert group.surface.tolist() == sorted(group.surface.tolist())
    assert set(group.surface.tolist()) == {0, 1}
    off = (group.pixels - [0.0, 100.0]) @ (np.array([-0.1, 1.0]) / np.hypot(0.1, 1.0))
    assert np.abs(off).max() < 0.01
    assert np.abs(np.linalg.norm(group.across, axis=1) - 1.0).max() < 1e-12


def test_a_shared_error_bounds_what_a_stripe_tells() -> None:
    group = binned(0, 0, line(1200), np.zeros(1200, np.int64), 0.3)
    information = float(np.sum(1.0 / group.sigma_px**2))
    # A place and a direction, each as good as the shared error.
    assert information == pytest.approx(2.0 / 0.3**2, rel=0.02)


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.8])
def test_correlation_factor_is_that_of_the_process(correlation: float) -> None:
    rng = np.random.default_rng(7)
    sequences = []
    for _ in range(40):
        values = rng.standard_normal(100)
        for i in range(1, 100):
            values[i] = correlation * values[i - 1] + np.sqrt(1.0 - correlation**2) * values[i]
        values[rng.uniform(size=100) < 0.1] = np.nan
        sequences.append(values)
    true = (1.0 + correlation) / (1.0 - correlation)
    # 4000 values; of the slowest the tail beyond 12 lags, a fifteenth, is cut off.
    assert correlation_factor(sequences) == pytest.approx(true, rel=0.2)


def test_correlation_of_nothing_is_one() -> None:
    assert correlation_factor([]) == 1.0
    assert correlation_factor([np.full(10, np.nan)]) == 1.0
