"""The bundle through the dome: derivatives, steps, and solves of noise-free views."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.calibration.dome.checks import solved_by_offset
from aqualvs.calibration.dome.problem import DomeOptions, dome_problem
from aqualvs.calibration.solver.bundle import (
    PRIORS,
    Bundle,
    BundleState,
    KnownDistance,
    SquareBoard,
    TargetView,
    moved_target,
    plane_distance,
    rig_difference,
)
from aqualvs.calibration.solver.covariance import consider_covariance, observability
from aqualvs.calibration.solver.least_squares import solve
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL, Rig, RigUncertainty, rig_moved_by
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig
from dome_cases import AIR, INTRINSICS, WATER, board_points, rail, see

POSE = ("lens_x", "lens_y", "lens_z", "rotation_x", "rotation_y", "rotation_z")
DOME = ("inner_radius", "thickness", "n_acrylic", "n_air")
TOLERANCES = RigUncertainty.independent(
    {"inner_radius": 1e-4, "thickness": 1e-4, "n_acrylic": 3e-3}
)


def _bundle(rig: Rig, seed: int = 1, n_views: int = 4, noise_px: float = 0.0) -> Bundle:
    """Return views in air and water, one pose exact, one measured and one unknown in each."""
    rng = np.random.default_rng(seed)
    square = DOME_FROM_CAM_NOMINAL
    targets = []
    for medium, n in enumerate((AIR, WATER)):
        shoot = rail(rig, n, "distance", rng, n_views=n_views, tilt=0.2, noise_px=noise_px)
        for i, (view, pose) in enumerate(zip(shoot.views, shoot.poses, strict=True)):
            known = (KnownDistance(plane_distance(pose), 2e-4), SquareBoard(square, 0.1, 0.1))
            targets.append(TargetView(view, medium, pose, i == 0, *(known if i == 1 else ())))
    free = POSE + (DOME if rig.dome else ()) + rig.lens.parameter_names
    state = BundleState(rig, np.array([AIR, WATER]), tuple(t.dome_from_target for t in targets))
    media_sigma = np.array([0.0, 5e-4 if rig.dome else 0.0])
    priors = TOLERANCES if rig.dome else RigUncertainty.none()
    return Bundle(tuple(targets), free, state, priors, media_sigma)


@pytest.mark.parametrize(
    "rig", [example_rig(), bluerov2_rig(), replace(example_rig(), housing=None)]
)
def test_derivatives_are_those_of_central_differences(rig: Rig) -> None:
    bundle = _bundle(rig)
    # Away from where priors and measured poses have no residual.
    rng = np.random.default_rng(2)
    step = 1e-4 * rng.normal(size=bundle.n_parameters)
    state = bundle.moved(bundle.start, step)
    blocks = bundle.blocks(state)
    h = 1e-6
    for column in range(bundle.n_parameters):
        unit = np.zeros(bundle.n_parameters)
        unit[column] = h
        above = bundle.blocks(bundle.moved(state, unit))
        below = bundle.blocks(bundle.moved(state, -unit))
        for block, a, b in zip(blocks, above, below, strict=True):
            numeric = (a.residuals - b.residuals) / (2.0 * h)
            where = np.flatnonzero(block.columns == column)
            analytic = block.jacobian[..., where[0]] if len(where) else np.zeros_like(numeric)
            size = max(1.0, float(np.abs(block.jacobian).max()))
            # The media's prior is whitened by 2000, residuals of 1e4 lose ten digits to h.
            np.testing.assert_allclose(analytic / size, numeric / size, atol=2e-6)


def test_blocks_follow_the_views_and_priors_come_last() -> None:
    bundle = _bundle(example_rig())
    blocks = bundle.blocks(bundle.start)
    assert [len(b.residuals) for b in blocks[:8]] == [len(v.view) for v in bundle.views]
    assert [b.group for b in blocks[8:]] == ["distances", "tilts", "rolls"] * 2 + [PRIORS] * 2


def test_steps_add_up_to_the_difference_of_rigs() -> None:
    bundle = _bundle(example_rig())
    step = 1e-3 * np.random.default_rng(3).normal(size=bundle.n_parameters)
    moved = bundle.moved(bundle.start, step)
    found = rig_difference(bundle.start.rig, moved.rig, bundle.free)
    np.testing.assert_allclose(found, step[: len(bundle.free)], atol=1e-12)
    np.testing.assert_allclose(moved.media, [AIR, WATER + step[len(bundle.free)]], atol=1e-15)
    # The first pose of each set is exact.
    assert moved.poses[0] is bundle.start.poses[0]
    columns = bundle.pose_columns(1)
    expected = moved_target(bundle.start.poses[1], bundle.views[1].view.middle, step[columns])
    np.testing.assert_allclose(moved.poses[1].translation, expected.translation, atol=1e-15)


def test_finds_the_truth_of_views_with_hardly_any_noise() -> None:
    bundle = _bundle(example_rig(), n_views=5, noise_px=1e-4)
    free = tuple(name for name in bundle.free if name != "n_air")
    bundle = replace(bundle, free=free)
    rng = np.random.default_rng(4)
    size = np.full(bundle.n_parameters, 5e-3)
    size[len(POSE) : bundle.n_shared] = 0.0
    wrong = bundle.moved(bundle.start, size * rng.normal(size=bundle.n_parameters))
    found = solve(bundle, wrong)
    assert found.converged
    off = rig_difference(bundle.start.rig, found.state.rig, POSE)
    assert np.abs(off).max() < 1e-6
    np.testing.assert_allclose(found.state.media, bundle.start.media, atol=1e-5)


def test_distance_is_where_the_plane_meets_the_axis() -> None:
    turn = rotation_from_rotvec([0.1, 0.2, -0.3]) @ DOME_FROM_CAM_NOMINAL
    pose = SE3(turn, np.array([0.3, 0.8, -0.2]))
    on_axis = pose.inverse().apply(np.array([0.0, plane_distance(pose), 0.0]))
    assert on_axis[2] == pytest.approx(0.0, abs=1e-15)


def test_considered_numbers_pass_their_errors_on() -> None:
    """The gain of the covariance is what a shift of a considered number does to a solve."""
    rig, rng = example_rig(), np.random.default_rng(5)
    shoot = rail(rig, AIR, "exact", rng, noise_px=0.05)
    options = DomeOptions(refine_intrinsics=False)
    problem = dome_problem(rig, [shoot.as_set()], INTRINSICS, options)
    bundle = problem.bundle
    # All noise at its nominal size, so that both solves weigh alike.
    found = solve(bundle, bundle.start)
    names, covariance = consider_covariance(bundle, found, problem.considered)
    shift = 0.2 * np.sqrt(INTRINSICS.of(["cx"])[0, 0])
    held = names.index("cx") - len(names)
    gain = covariance[:, held] / INTRINSICS.of(["cx"])[0, 0]
    there = replace(found.state, rig=rig_moved_by(found.state.rig, ["cx"], np.array([shift])))
    start = replace(bundle.start, rig=rig_moved_by(bundle.start.rig, ["cx"], np.array([shift])))
    moved = solve(replace(bundle, start=start), there)
    off = rig_difference(there.rig, moved.state.rig, bundle.free)
    sigma = np.sqrt(np.diag(found.covariance))[: len(off)]
    # Noise scales, and with them the weights, move a little with the shift.
    np.testing.assert_allclose(off / sigma, gain[: len(off)] * shift / sigma, atol=0.15)
    assert np.abs(gain[: len(off)] * shift / sigma).max() > 1.0
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-9, atol=1e-18)


def test_a_shared_error_of_distances_shifts_the_solution_as_told() -> None:
    rig, rng = example_rig(), np.random.default_rng(6)
    shoot = rail(rig, AIR, "distance", rng, noise_px=0.05)
    shift = 1e-4
    states = []
    for offset in (0.0, shift):
        given = [replace(g, distance=g.distance + offset) for g in shoot.given if g and g.distance]
        one = shoot.with_given(given).as_set()
        problem = dome_problem(rig, [one], INTRINSICS, DomeOptions())
        found = solve(problem.bundle, problem.bundle.start)
        states.append((problem, found))
    (problem, first), (_, second) = states
    by_offset = solved_by_offset(problem, first)[:3]
    off = rig_difference(first.state.rig, second.state.rig, POSE[:3])
    # Solves stop within a fiftieth of a sigma of 0.1 mm.
    np.testing.assert_allclose(off, by_offset * shift, atol=4e-6)
    assert by_offset[1] > 0.1


def test_observability_tells_data_from_priors() -> None:
    rig, rng = example_rig(), np.random.default_rng(7)
    known = RigUncertainty.independent({"fx": 1e-6, "fy": 50.0})
    shoot = rail(rig, AIR, "exact", rng)
    problem = dome_problem(rig, [shoot.as_set()], known, DomeOptions())
    bundle = problem.bundle
    found = solve(bundle, bundle.start)
    n = len(bundle.free)
    after = RigUncertainty(bundle.free, found.covariance[:n, :n])
    seen = observability(bundle, found, after, ["fx", "fy", "lens_x"])
    assert "lens_x" not in seen.shrinkage
    assert seen.shrinkage["fx"] == pytest.approx(1.0, abs=1e-6)
    assert seen.shrinkage["fy"] < 0.02
    best, worst = seen.directions[0], seen.directions[-1]
    assert best.gain > 1e3
    assert list(best.main) == ["fy"]
    assert worst.gain < 1e-3
    assert list(worst.main) == ["fx"]
    assert worst in seen.unobservable()
    assert best not in seen.unobservable()


def test_views_behind_each_other_in_one_medium_only() -> None:
    """A bundle keeps the order of its views however media alternate."""
    rig, rng = example_rig(), np.random.default_rng(8)
    points = board_points()
    pose = SE3(DOME_FROM_CAM_NOMINAL, np.array([-0.35, 0.5, 0.27]))
    media = [1, 0, 1]
    views = [see(rig.in_water((AIR, WATER)[m]).camera(), pose, points, rng) for m in media]
    targets = tuple(TargetView(v, m, pose) for v, m in zip(views, media, strict=True))
    state = BundleState(rig, np.array([AIR, WATER]), (pose,) * 3)
    bundle = Bundle(targets, (), state, RigUncertainty.none(), np.zeros(2))
    for view, block in zip(views, bundle.blocks(state), strict=True):
        assert len(block.residuals) == len(view)
        # Ten nominal sigmas; views of the other medium are hundreds off.
        assert block.lengths.max() < 10.0
