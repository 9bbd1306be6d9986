"""`calibrate dome` on simulated boards: recovery, what it says, and what it refuses."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from aqualvs.calibration.dome.calibrate import dome
from aqualvs.calibration.dome.problem import BoardSet, DomeOptions
from aqualvs.calibration.solver.result import CrossValidation, DomeCalibration
from aqualvs.calibration.targets.targets import View
from aqualvs.errors import CalibrationError
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec, rotvec_from_rotation
from aqualvs.optics.rig import Rig, RigUncertainty
from aqualvs.optics.solved import with_uncertainty
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig
from dome_cases import (
    AIR,
    INTRINSICS,
    WATER,
    Given,
    Shoot,
    drawn_rig,
    guessed,
    lens_error,
    normalised_errors,
    rail,
)
from whole import WHOLE

PAPER = example_rig()
QUICK = DomeOptions(check_cross_validation=False)


def _solve(
    sets: Sequence[BoardSet],
    rig: Rig = PAPER,
    options: DomeOptions = QUICK,
    *,
    rotation_known: bool = False,
    known: RigUncertainty = INTRINSICS,
) -> DomeCalibration:
    return dome(guessed(rig, rotation_known=rotation_known), sets, options, known)


def _rail(
    kind: str = "distance", rig: Rig = PAPER, n: float = AIR, seed: int = 1, n_views: int = 8
) -> Shoot:
    return rail(rig, n, kind, np.random.default_rng(seed), n_views=n_views)


# What is given of the boards, and how far the lens may be off, mm.
GIVEN = [("exact", 0.1), ("distance", 0.6), ("unknown", 1.5)]
RIGS = [PAPER, bluerov2_rig()]


@pytest.mark.parametrize(
    ("kind", "limit_mm", "rig"),
    [
        (*given, rig)
        for i, given in enumerate(GIVEN)
        for k, rig in enumerate(RIGS)
        # Rigs in turn: what is given matters more than who is asked.
        if WHOLE or i % 2 == k
    ],
)
def test_finds_lens_and_rotation(kind: str, limit_mm: float, rig: Rig) -> None:
    shoot = _rail(kind, rig)
    found = _solve([shoot.as_set()], rig, rotation_known=kind == "unknown")
    assert 1e3 * lens_error(found, rig) < limit_mm
    errors = normalised_errors(found, rig, shoot.poses)
    # The largest of some 60: beyond 4.5 once in two thousand times.
    assert max(map(abs, errors.values())) < 4.5
    # 8 views of 60 corners: 1 % of noise lost to Huber's weights, 3 % by chance.
    assert found.noise_px == pytest.approx(0.1, rel=0.1)
    assert found.rotation_is_solved == (kind != "unknown")
    if kind == "unknown":
        truth = rig.dome_from_cam.rotation
        np.testing.assert_array_equal(found.rig.dome_from_cam.rotation, truth)


def test_air_and_water_in_one_solve() -> None:
    air, water = _rail(), _rail("unknown", n=WATER + 4e-4, seed=2)
    sets = [air.as_set(), water.as_set(WATER, 5e-4, "pool")]
    found = _solve(sets)
    errors = normalised_errors(found, PAPER, air.poses + water.poses, (AIR, WATER + 4e-4))
    assert max(map(abs, errors.values())) < 4.5
    assert found.media[0].sigma == 0.0
    assert 0.0 < found.media[1].sigma <= 5e-4
    # The water that was solved for is that of the rig.
    assert found.rig.n_water == found.media[1].n
    assert found.uncertainty.sigmas["n_water"] == pytest.approx(found.media[1].sigma)
    assert any(line.startswith("pool: n = 1.33") for line in found.findings)
    assert found.views[8].label == "pool: view_0"


def test_a_rail_whose_zero_is_off_does_not_raise_doubts_about_the_water() -> None:
    """The lens then moves with the rail, which another index of the water would make up for."""
    rig, rng = bluerov2_rig(), np.random.default_rng(7)
    air = rail(rig, AIR, "distance", rng, n_views=12, rail_sigma=0.0)
    off = [Given(distance=g.distance + 8e-4) for g in air.given if g and g.distance]
    water = rail(rig, WATER, "unknown", rng, n_views=12)
    found = _solve([air.with_given(off).as_set(), water.as_set(WATER, 5e-4, "pool")], rig)
    assert not any("the pictures fit n" in line for line in found.findings)


def test_distances_are_not_blamed_for_intrinsics_that_are_held() -> None:
    """Dome and intrinsics within what is known of them bend eight of ten distances here."""
    options = replace(QUICK, refine_intrinsics=False)
    rng = np.random.default_rng(33)
    true = drawn_rig(bluerov2_rig(), options, rng)
    air = rail(true, AIR, "distance", rng, n_views=10)
    water = rail(true, WATER, "unknown", rng, n_views=10)
    sets = [air.as_set(), water.as_set(WATER, 5e-4, "pool")]
    found = _solve(sets, bluerov2_rig(), options)
    assert not found.left_out
    errors = normalised_errors(found, true, air.poses + water.poses, (AIR, WATER))
    assert max(map(abs, errors.values())) < 4.5


def test_the_zero_of_a_rail_is_no_better_known_than_it_is_said() -> None:
    sets, sigmas = [_rail().as_set()], []
    for zero in (0.0, 1e-3):
        found = _solve(sets, options=replace(QUICK, distance_offset_sigma=zero))
        sigmas.append(found.uncertainty.sigmas["lens_y"])
    by_zero = np.sqrt(sigmas[1] ** 2 - sigmas[0] ** 2)
    # Pictures tell the rest: 1 mm moves the lens by less than that, but by most of it.
    assert 0.3e-3 < by_zero < 1e-3


def test_half_the_boards_may_be_off_square() -> None:
    rng = np.random.default_rng(3)
    square = rail(PAPER, AIR, "distance", rng, n_views=7, tilt=0.0)
    tilted = rail(PAPER, AIR, "distance", rng, n_views=6, tilt=float(np.deg2rad(1.0)))
    both = Shoot(
        square.views + tilted.views, square.given + tilted.given, square.poses + tilted.poses
    )
    found = _solve([both.as_set()])
    turn = found.rig.dome_from_cam.rotation @ PAPER.dome_from_cam.rotation.T
    assert np.rad2deg(np.linalg.norm(rotvec_from_rotation(turn))) < 0.2
    assert 1e3 * lens_error(found, PAPER) < 0.6


def test_camera_may_be_turned_and_boards_stand_on_a_side() -> None:
    turn = rotation_from_rotvec(np.deg2rad([8.0, -6.0, 12.0]))
    turned = replace(
        PAPER,
        dome_from_cam=SE3(turn @ PAPER.dome_from_cam.rotation, PAPER.dome_from_cam.translation),
    )
    shoot = _rail(rig=turned)
    quarter = rotation_from_rotvec([0.0, 0.0, np.pi / 2.0])
    # The same boards, told in axes a quarter turn further.
    views = tuple(View(v.name, v.ids, v.points @ quarter.T, v.pixels) for v in shoot.views)
    found = _solve([BoardSet(name="air", views=views, poses=shoot.given)], turned)
    assert 1e3 * lens_error(found, turned) < 0.6
    off = found.rig.dome_from_cam.rotation @ turned.dome_from_cam.rotation.T
    assert np.rad2deg(np.linalg.norm(rotvec_from_rotation(off))) < 0.5


# Before and behind the centre, and aside.
PLACES_MM = [(0.0, -43.0, 0.0), (0.0, 43.0, 0.0), (-28.0, -12.0, -33.0), (40.0, -19.0, -7.0)]


@pytest.mark.parametrize(
    ("lens_mm", "n"),
    [
        (place, n)
        for i, place in enumerate(PLACES_MM)
        for k, n in enumerate((AIR, WATER))
        # Media in turn.
        if WHOLE or i % 2 == k
    ],
)
def test_starts_from_any_place_of_the_lens(lens_mm: tuple[float, float, float], n: float) -> None:
    rig = bluerov2_rig()
    shoot = _rail("unknown", rig, n)
    there = SE3(rig.dome_from_cam.rotation, 1e-3 * np.array(lens_mm))
    found = dome(replace(rig, dome_from_cam=there), [shoot.as_set(n)], QUICK, INTRINSICS)
    assert 1e3 * lens_error(found, rig) < 1.5


def test_held_intrinsics_stay_and_pass_their_uncertainty_on() -> None:
    shoot = _rail("exact")
    held = _solve([shoot.as_set()], options=replace(QUICK, refine_intrinsics=False))
    refined, exact = _solve([shoot.as_set()]), _solve([shoot.as_set()], known=RigUncertainty.none())
    assert held.rig.lens == PAPER.lens
    assert exact.rig.lens == PAPER.lens
    assert refined.rig.lens != PAPER.lens
    assert held.uncertainty.sigmas["fx"] == pytest.approx(INTRINSICS.sigmas["fx"])
    assert "fx" not in exact.uncertainty.names
    for name in ("lens_x", "lens_y", "lens_z"):
        assert held.uncertainty.sigmas[name] > refined.uncertainty.sigmas[name]
        assert refined.uncertainty.sigmas[name] > exact.uncertainty.sigmas[name]
    assert any("intrinsics: held" in line for line in held.findings)
    assert any("intrinsics: taken as exact" in line for line in exact.findings)
    assert any("intrinsics: refined" in line for line in refined.findings)


def test_knows_the_intrinsics_that_the_rig_has_written_down() -> None:
    shoot = _rail("exact")
    rig = with_uncertainty(guessed(PAPER, rotation_known=False), INTRINSICS)
    found = dome(rig, [shoot.as_set()], QUICK)
    told = _solve([shoot.as_set()])
    np.testing.assert_allclose(
        found.uncertainty.covariance, told.uncertainty.covariance, rtol=1e-3, atol=1e-16
    )


def test_rotation_known_with_an_uncertainty_passes_it_on() -> None:
    """At unknown poses a turn of the camera turns the lens about the dome's centre with it."""
    shoot, sigma = _rail("unknown"), 0.01
    rotation = {"rotation_x": sigma, "rotation_y": sigma, "rotation_z": sigma}
    sigmas = RigUncertainty.independent({**INTRINSICS.sigmas, **rotation})
    found = _solve([shoot.as_set()], rotation_known=True, known=sigmas)
    assert found.uncertainty.sigmas["rotation_x"] == pytest.approx(sigma, rel=1e-3)
    assert found.uncertainty.sigmas["lens_x"] == pytest.approx(0.0416 * sigma, rel=0.1)


def test_tolerances_stay_what_pictures_cannot_tell() -> None:
    found = _solve([_rail("unknown").as_set()], rotation_known=True)
    assert found.uncertainty.sigmas["inner_radius"] == pytest.approx(1e-4, rel=0.05)
    text = "\n".join(found.findings)
    assert "acrylic index" in text
    assert "not determined by the pictures, taken as given" in text
    assert "camera rotation: taken from the rig; boards at unknown poses do not" in text
    exact = replace(QUICK, inner_radius_sigma=0.0)
    without = _solve([_rail("unknown").as_set()], options=exact, rotation_known=True)
    assert "inner_radius" not in without.uncertainty.names
    assert without.rig.dome is not None
    assert without.rig.dome.inner_radius == 44.25e-3
    assert any("inner radius: taken as exact" in line for line in without.findings)


def test_says_that_the_dome_is_needed() -> None:
    found = _solve([_rail("exact").as_set()], options=DomeOptions())
    assert found.cross_validation is not None
    assert found.cross_validation.n_views == len(found.views)
    assert found.cross_validation.n_dome_better == len(found.views)
    # Poses from half of the corners: predictions are some noisier than 0.1 px each way.
    assert found.cross_validation.dome_rms_px < 0.2
    assert found.cross_validation.bare_rms_px > 2.0 * found.cross_validation.dome_rms_px
    assert any("the dome model is needed" in line for line in found.findings)


def _cross_validation(dome_px: Sequence[float], bare_px: Sequence[float]) -> CrossValidation:
    counts = np.full(len(dome_px), 40)
    return CrossValidation(np.array(dome_px), np.array(bare_px), counts)


def test_the_dome_is_compared_view_by_view() -> None:
    """An advantage in every view tells, where views differ more than the models do."""
    dome_px = np.array([0.12, 0.2, 0.31, 0.25, 0.36, 0.17, 0.22, 0.3, 0.27])
    better = _cross_validation(dome_px, dome_px * np.linspace(1.08, 1.22, 9))
    assert better.n_points == 360
    assert better.bare_rms_px / better.dome_rms_px == pytest.approx(1.15, abs=0.02)
    assert better.dome_is_better
    # As much better over all corners, by one view alone.
    one = dome_px.copy()
    one[4] *= 1.7
    by_one = _cross_validation(dome_px, one)
    assert by_one.bare_rms_px > better.bare_rms_px
    assert not by_one.dome_is_better
    assert not _cross_validation(dome_px, dome_px * np.linspace(0.82, 1.0, 9)).dome_is_better
    assert not _cross_validation([0.1, 0.1], [0.2, 0.21]).dome_is_better


def test_says_that_pictures_show_no_dome() -> None:
    """A lens at the centre sees through a dome as if it were not there."""
    centred = guessed(bluerov2_rig(), rotation_known=True)
    found = _solve([_rail("exact", centred).as_set()], centred, DomeOptions())
    (line,) = (line for line in found.findings if "do not show that there is a dome" in line)
    n, better = map(int, re.search(r"of (\d+) views.* better in (\d+) of", line).groups())
    assert ("but by too little" in line) == (better > n // 2)
    unknown = _solve([_rail("unknown", centred, WATER).as_set(WATER)], centred, rotation_known=True)
    assert any("do not distinguish n = 1.3333 from 1.0003" in line for line in unknown.findings)


def test_outliers_do_not_matter() -> None:
    shoot, rng = _rail(), np.random.default_rng(4)
    for view in shoot.views:
        bad = rng.permutation(len(view)) < 0.1 * len(view)
        view.pixels[bad] += rng.uniform(2.0, 50.0, (int(bad.sum()), 2))
    found = _solve([shoot.as_set()])
    errors = normalised_errors(found, PAPER, shoot.poses)
    assert max(map(abs, errors.values())) < 4.5
    assert found.n_points < 0.92 * sum(len(v) for v in shoot.views)


def test_one_wrong_pose_is_left_out() -> None:
    shoot = _rail("exact")
    given = list(shoot.given)
    pose = shoot.poses[3]
    given[3] = Given(dome_from_board=SE3(pose.rotation, pose.translation + 5e-3))
    found = _solve([shoot.with_given(given).as_set()])
    assert set(found.left_out) == {"view_3"}
    assert len(found.views) == 7
    assert 1e3 * lens_error(found, PAPER) < 0.1
    assert any("left out, view_3" in line for line in found.findings)


def test_one_wrong_distance_is_forgotten() -> None:
    shoot = _rail()
    given = list(shoot.given)
    assert given[3] is not None
    given[3] = replace(given[3], distance=(given[3].distance or 0.0) + 0.02)
    found = _solve([shoot.with_given(given).as_set()])
    assert set(found.left_out) == {"distance of view_3"}
    assert len(found.views) == 8
    errors = normalised_errors(found, PAPER, shoot.poses)
    assert max(map(abs, errors.values())) < 4.5


def _distances(change: Callable[[float], float]) -> Callable[[Shoot], Shoot]:
    def spoil(shoot: Shoot) -> Shoot:
        given = [Given(distance=change(g.distance)) for g in shoot.given if g and g.distance]
        return shoot.with_given(given)

    return spoil


def _squares(factor: float) -> Callable[[Shoot], Shoot]:
    def spoil(shoot: Shoot) -> Shoot:
        views = tuple(View(v.name, v.ids, factor * v.points, v.pixels) for v in shoot.views)
        return replace(shoot, views=views)

    return spoil


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_distances(lambda d: 1e-3 * d), "distances written in metres"),
        (_distances(lambda d: 0.1 * d), "distances in centimetres"),
        (_distances(lambda d: d / 25.4), "distances in inches"),
        (_distances(lambda d: -d), "count forward from the dome's centre and are positive"),
        (_distances(lambda d: 1.2 - d), "grow where the pictures show the board coming nearer"),
        (_distances(lambda d: d + 0.05), r"contradict the pictures, typically by -(49|50)"),
        (
            _distances(lambda d: d + 0.004),
            r"all given distances are \+4\.\d\d ± .* mm off.* radius",
        ),
        (_distances(lambda d: 1.01 * d), r"all given distances are \+(0\.9|1\.0)\d ± .* % off"),
        (_squares(1.03), r"square_mm would have to be 0\.9.* camera and housing those of the rig"),
        (_squares(1e-3), r"would stand 0\.\d+ mm away; is square_mm"),
        (_squares(1e3), r"would stand .*e\+05 mm away; is square_mm"),
    ],
)
def test_refuses_lengths_that_do_not_fit(spoil: Callable[[Shoot], Shoot], message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        _solve([spoil(_rail()).as_set()])


def _poses(change: Callable[[SE3], SE3]) -> Shoot:
    shoot = _rail("exact", n_views=5)
    return shoot.with_given([Given(dome_from_board=change(pose)) for pose in shoot.poses])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: p.inverse(), "cannot see a board at the given pose; poses must be dome_from"),
        (lambda p: SE3(p.rotation, 1e-3 * p.translation), "cannot see a board at the given pose"),
        (lambda p: SE3(p.rotation, 1e3 * p.translation), r"e\+05 mm away"),
        (
            lambda p: SE3(p.rotation, 10.0 * p.translation),
            "the given poses contradict the pictures",
        ),
    ],
)
def test_refuses_poses_that_do_not_fit(change: Callable[[SE3], SE3], message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        _solve([_poses(change).as_set()])


@pytest.mark.parametrize(
    ("kind", "taken"),
    [
        (kind, taken)
        for i, (kind, _) in enumerate(GIVEN)
        for k, taken in enumerate((AIR, WATER))
        # Media in turn.
        if WHOLE or i % 2 == k
    ],
)
def test_refuses_the_wrong_medium(kind: str, taken: float) -> None:
    shoot = _rail(kind, n=taken, n_views=6)
    stated, sigma = (WATER, 5e-4) if taken == AIR else (AIR, 0.0)
    word = "air" if taken == AIR else "water"
    with pytest.raises(CalibrationError, match=f"were they taken in {word}"):
        _solve([shoot.as_set(stated, sigma)], rotation_known=kind == "unknown")


def test_remarks_on_water_that_is_a_little_off() -> None:
    shoot = _rail("exact", n=WATER + 0.01)
    found = _solve([shoot.as_set(WATER, 5e-4)])
    assert any("the pictures fit n = 1.34" in line for line in found.findings)


def test_refuses_boards_that_are_all_alike() -> None:
    rng = np.random.default_rng(5)
    rig = bluerov2_rig()
    shoot = rail(rig, AIR, "unknown", rng, tilt=0.005, nearest=0.6, farthest=0.61)
    with pytest.raises(CalibrationError, match=r"parallel and at one distance.*; tilt the board"):
        _solve([shoot.as_set()], rig, rotation_known=True)


def test_refuses_a_lens_that_pictures_do_not_tell() -> None:
    """Three far views of a lens near the centre, at unknown poses in air."""
    rng, rig = np.random.default_rng(6), bluerov2_rig()
    shoot = rail(rig, AIR, "unknown", rng, n_views=3, nearest=0.8, farthest=1.2)
    wide = RigUncertainty.independent({**INTRINSICS.sigmas, "fx": 3.0, "fy": 3.0})
    with pytest.raises(CalibrationError, match=r"mm uncertain along .*; give the boards'"):
        _solve([shoot.as_set()], rig, rotation_known=True, known=wide)


def test_refuses_too_little() -> None:
    shoot = _rail("unknown")
    two = BoardSet(name="air", views=shoot.views[:2])
    with pytest.raises(CalibrationError, match="pictures that show the board: 2; the dome needs 3"):
        _solve([two], rotation_known=True)
    few = tuple(v.where(np.arange(len(v)) < 5) for v in shoot.views)
    with pytest.raises(CalibrationError, match="board corners in all pictures together: 40"):
        _solve([BoardSet(name="air", views=few)], rotation_known=True)


def test_refuses_a_rig_without_a_dome() -> None:
    shoot = _rail("unknown")
    with pytest.raises(CalibrationError, match="rig example has no dome"):
        dome(replace(PAPER, housing=None), [shoot.as_set()], QUICK, INTRINSICS)


def test_refuses_another_board() -> None:
    shoot, rng = _rail("unknown", n_views=4), np.random.default_rng(6)
    views = tuple(View(v.name, v.ids, rng.permutation(v.points), v.pixels) for v in shoot.views)
    with pytest.raises(CalibrationError, match="no pose of the board explains the pictures"):
        _solve([BoardSet(name="air", views=views)], rotation_known=True)


def test_refuses_options_that_mean_nothing() -> None:
    with pytest.raises(CalibrationError, match="must be positive"):
        DomeOptions(distance_sigma=0.0)
    with pytest.raises(ValueError, match="1 poses given for 8 views"):
        BoardSet(name="air", views=_rail().views, poses=[None])
