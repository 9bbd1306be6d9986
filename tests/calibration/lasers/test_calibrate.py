"""`calibrate_lasers`: the way through, and what it refuses."""

import functools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from aqualvs.calibration.lasers.calibrate import LaserOptions, calibrate_lasers
from aqualvs.calibration.lasers.checks import LaserCalibration, match_to_rig, named
from aqualvs.calibration.lasers.solve import InitialGuess, paper_plane, solve_lasers
from aqualvs.calibration.lasers.stripes_on_planes import board_surface
from aqualvs.calibration.lasers.views import LaserView, place_views
from aqualvs.errors import CalibrationError, OptionError
from aqualvs.geometry.arrays import BoolArray
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.rig import Laser, Rig, moved_plane
from aqualvs.simulation.scenarios import example_rig
from laser_cases import (
    BOARD_POSES,
    Noise,
    board_corners,
    board_views,
    box,
    box_corners,
    box_views,
    dome_from_board,
    dome_from_box,
    laser_error,
    simulated,
    without_lasers,
)
from laser_scenes import Clutter, glint, joined, scene
from windowed_cases import windowed

RIG = example_rig()
NOISE = Noise(corner_px=0.05, stripe_px=0.1)
N_SURFACES = 4


@functools.cache
def box_seen() -> list[LaserView]:
    return box_views(RIG, noise=NOISE, spacing=0.004)


def check(result: LaserCalibration, rig: Rig, *, sigmas: float = 5.0) -> None:
    """Every laser of `rig` is found, within its own uncertainty."""
    assert len(result.lasers) == len(rig.lasers)
    for figures, laser in zip(result.lasers, rig.lasers, strict=True):
        angle, offset = laser_error(figures.laser.plane, laser.plane)
        assert angle < sigmas * figures.sigma_normal
        assert abs(offset) < sigmas * figures.sigma_offset
        # A tenth of a pixel at a hundred places and more: thousandths of a degree.
        assert np.rad2deg(figures.sigma_normal) < 0.03
        assert figures.sigma_offset < 4e-4


def kept(views: list[LaserView], keep: Callable[[LaserView], BoolArray]) -> list[LaserView]:
    return [replace(v, stripes=v.stripes.at(np.flatnonzero(keep(v)))) for v in views]


def test_lasers_come_out_of_a_box() -> None:
    result = calibrate_lasers(RIG, box_seen(), box())
    check(result, RIG)
    assert [f.laser.name for f in result.lasers] == ["lower", "left", "right"]
    assert result.warnings == ()
    assert result.left_out == {}
    for figures in result.lasers:
        assert figures.sheet == "plane"
        assert len(figures.surfaces) >= 2
        # Bins of some points, whose noise of 0.1 px averages.
        assert 0.03 < figures.rms_px < 0.1
        angle, offset = laser_error(figures.paper_plane, figures.laser.plane)
        assert 0.0 < np.rad2deg(angle) < 0.3
        assert 0.0 < abs(offset) < 3e-3
    for i, view in enumerate(result.views):
        assert view.rms_corners_px == pytest.approx(0.05 * np.sqrt(2.0), rel=0.2)
        true = dome_from_box(i)
        assert np.abs(view.dome_from_target.translation - true.translation).max() < 5e-4
        # The two poses differ by noise, and are told apart.
        assert 0.0 < view.pose_angle < 1e-3


@pytest.mark.parametrize("thickness", [0.0, 0.006])
def test_lasers_come_out_of_boards(thickness: float) -> None:
    poses = [dome_from_board(i) for i in range(len(BOARD_POSES))]
    surfaces = board_surface(thickness=thickness)
    views = simulated(RIG, poses, board_corners(), surfaces, noise=NOISE, spacing=0.004)
    check(calibrate_lasers(RIG, views, surfaces), RIG)


def test_a_box_in_air_serves_a_rig_in_water() -> None:
    views = box_views(RIG.in_water(1.0003), noise=NOISE, spacing=0.004)
    result = calibrate_lasers(RIG, views, box(), options=LaserOptions(n_medium=1.0003))
    check(result, RIG)
    assert result.rig.n_water == RIG.n_water


def test_without_lasers_in_the_rig_they_are_named() -> None:
    result = calibrate_lasers(without_lasers(RIG), box_seen(), box())
    assert [f.laser.name for f in result.lasers] == ["horizontal", "vertical", "diagonal"]
    check(result, RIG)


def test_names_follow_the_rig_whatever_its_order() -> None:
    shuffled = replace(
        RIG,
        lasers=tuple(
            Laser(RIG.lasers[i].name, moved_plane(RIG.lasers[i].plane, 0.03, -0.02, 0.005))
            for i in (2, 0, 1)
        ),
    )
    result = calibrate_lasers(shuffled, box_seen(), box())
    check(result, replace(RIG, lasers=tuple(RIG.lasers[i] for i in (2, 0, 1))))
    for figures, laser in zip(result.lasers, shuffled.lasers, strict=True):
        assert figures.laser.name == laser.name
        assert figures.laser.plane.normal @ laser.plane.normal > 0.99


def test_a_laser_that_moved_far_is_named() -> None:
    moved = replace(RIG.lasers[0], plane=moved_plane(RIG.lasers[0].plane, 0.0, 0.0, 0.15))
    rig = replace(RIG, lasers=(moved, *RIG.lasers[1:]))
    result = calibrate_lasers(rig, box_seen(), box())
    assert result.warnings == (
        "laser 'lower' is far from where the rig had it; check that it is the same one",
    )


def test_bent_light_is_told_from_plane() -> None:
    rig = windowed(RIG)
    views = box_views(rig, noise=NOISE, spacing=0.004)
    start = replace(
        rig,
        lasers=tuple(
            replace(laser, plane=moved_plane(laser.plane, 0.01, -0.02, 0.003))
            for laser in rig.lasers
        ),
    )
    bent = calibrate_lasers(start, views, box())
    check(bent, rig)
    for figures in bent.lasers:
        assert figures.laser.window is not None
        assert figures.sheet.startswith("bent at its window: residuals")
    flat = calibrate_lasers(start, box_seen(), box())
    check(flat, RIG)
    for figures in flat.lasers:
        assert figures.laser.window is None
        assert figures.sheet.startswith("plane, its window left out")


def test_in_air_a_window_cannot_be_told_and_stays() -> None:
    rig = replace(windowed(RIG), n_air=1.0003)
    views = box_views(rig.in_water(1.0003), noise=NOISE, spacing=0.004)
    result = calibrate_lasers(rig, views, box(), options=LaserOptions(n_medium=1.0003))
    check(result, rig)
    for figures in result.lasers:
        assert figures.laser.window is not None
        assert "stripes cannot tell" in figures.sheet


def test_a_board_that_leans_is_noticed() -> None:
    rng = np.random.default_rng(5)
    poses = [dome_from_board(i) for i in range(len(BOARD_POSES))]
    true = simulated(RIG, poses, board_corners(), board_surface(), noise=NOISE)
    lean = [p @ SE3.from_rotvec(rng.normal(0.0, 0.02, 3), np.zeros(3)) for p in poses]
    leaning = simulated(RIG, lean, board_corners(), board_surface(), noise=NOISE)
    views = [LaserView(b.view, a.stripes) for a, b in zip(true, leaning, strict=True)]
    result = calibrate_lasers(RIG, views, board_surface())
    assert any("lie unevenly" in words for words in result.warnings)
    for figures, laser in zip(result.lasers, RIG.lasers, strict=True):
        angle, offset = laser_error(figures.laser.plane, laser.plane)
        # Its figures own up to it, though four boards are few.
        assert angle < 4.0 * figures.sigma_normal
        assert abs(offset) < 4.0 * figures.sigma_offset
    trusting = calibrate_lasers(RIG, views, board_surface(), options=LaserOptions(loose=False))
    assert not any("lie unevenly" in words for words in trusting.warnings)
    assert trusting.lasers[0].sigma_normal < result.lasers[0].sigma_normal


def test_the_papers_pseudo_inverse() -> None:
    plane = Plane.from_normal((0.3, -0.2, 0.9), -0.15)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3))
    points -= np.outer(plane.signed_distance(points), plane.normal)
    found = paper_plane(np.vstack([points, [[np.nan] * 3]]))
    angle, offset = laser_error(found, plane)
    assert angle < 1e-12
    assert abs(offset) < 1e-12


def test_many_lasers_are_numbered_from_the_left() -> None:
    planes = [Plane.from_normal((1.0, 0.02 * i, 0.0), 0.03 * i) for i in (2, 0, 1)]
    order, lasers = named(planes)
    assert order == [1, 2, 0]
    assert [laser.name for laser in lasers] == ["laser_1", "laser_2", "laser_3"]
    rig = replace(RIG, lasers=tuple(lasers))
    assert match_to_rig(rig, planes) == [1, 2, 0]
    assert match_to_rig(rig, planes[:2]) == [1, None, 0]


def corners_only(views: list[LaserView], keep: Callable[[LaserView], BoolArray]) -> list[LaserView]:
    return [replace(v, view=v.view.where(keep(v))) for v in views]


def on_forward(view: LaserView) -> BoolArray:
    there: BoolArray = np.abs(view.view.points[:, 1] - 0.7) < 1e-6
    return there


def test_views_without_markers_are_left_out_with_the_reason() -> None:
    views = [box_seen()[0], *corners_only([box_seen()[1]], lambda v: v.view.ids < 0), box_seen()[2]]
    result = calibrate_lasers(RIG, views, box())
    assert len(result.views) == 2
    assert result.left_out["view_1.png"].startswith("0 corners of the target found")


def test_no_markers_at_all() -> None:
    views = corners_only(box_seen(), lambda v: v.view.ids < 0)
    with pytest.raises(CalibrationError, match=r"no picture can be used: view_0\.png: 0 corners"):
        calibrate_lasers(RIG, views, box())


def test_no_pictures() -> None:
    with pytest.raises(CalibrationError, match="no pictures were given"):
        calibrate_lasers(RIG, [], box())


def test_markers_on_one_plane_only() -> None:
    views = corners_only(box_seen(), on_forward)
    with pytest.raises(CalibrationError, match=r"markers are seen on plane 'forward' only"):
        calibrate_lasers(RIG, views, box())
    mixed = [views[0], *box_seen()[1:]]
    assert "'forward' only" in calibrate_lasers(RIG, mixed, box()).left_out["view_0.png"]


def test_a_laser_on_one_plane_only() -> None:
    def without_right(view: LaserView) -> BoolArray:
        chain = view.stripes.chain
        lonely = (chain == 2 * N_SURFACES + 2) & (view.view.name == "view_0.png")
        keep: BoolArray = (chain < 2 * N_SURFACES) | lonely
        return keep

    views = kept(box_seen(), without_right)
    expected = (
        r"2 of 3 lasers can be solved \(not: right\).*"
        r"on one plane only: view_0.png, plane 'forward'"
    )
    with pytest.raises(CalibrationError, match=expected):
        calibrate_lasers(RIG, views, box())
    # Nobody said that there are three, so two are found, and the third is mentioned.
    two = calibrate_lasers(without_lasers(RIG), views, box())
    assert len(two.lasers) == 2
    assert any("belongs to no laser" in words for words in two.warnings)


def test_more_lasers_than_expected() -> None:
    with pytest.raises(CalibrationError, match="more lasers are seen than 2"):
        calibrate_lasers(RIG, box_seen(), box(), options=LaserOptions(n_lasers=2))


def test_fewer_lasers_than_expected() -> None:
    with pytest.raises(CalibrationError, match="3 of 5 lasers can"):
        calibrate_lasers(RIG, box_seen(), box(), options=LaserOptions(n_lasers=5))


def test_one_picture_of_a_board_fixes_no_plane() -> None:
    views = board_views(RIG, noise=NOISE, spacing=0.004)[:1]
    with pytest.raises(CalibrationError, match=r"two places of the board that differ.*nearer, far"):
        calibrate_lasers(without_lasers(RIG), views, board_surface())


@pytest.mark.parametrize("laser", [0, 2])
def test_one_laser_among_glints_is_found_where_it_is_told(laser: int) -> None:
    one = replace(RIG, lasers=(RIG.lasers[laser],))
    views = box_views(one, noise=NOISE, spacing=0.004)[:1]
    rng = np.random.default_rng(4)
    stripes = views[0].stripes
    for _ in range(5):
        stripes = joined(stripes, glint(rng, RIG.size_px))
    views = [replace(views[0], stripes=stripes)]
    told = calibrate_lasers(without_lasers(RIG), views, box(), options=LaserOptions(n_lasers=1))
    angle, offset = laser_error(told.lasers[0].laser.plane, one.lasers[0].plane)
    # One picture and two surfaces of it.
    assert np.rad2deg(angle) < 0.3
    assert abs(offset) < 2e-3
    with pytest.raises(
        CalibrationError, match=r"undecided: .* points in view_0\.png.*give --lasers N"
    ):
        calibrate_lasers(without_lasers(RIG), views, box())


def test_a_plane_that_may_be_print_is_asked_about() -> None:
    made = scene(3, 1, 8, clutter=Clutter(edges=0.6), noise_px=0.1, rail=True)
    views = [LaserView(v.view, v.stripes) for v in made.views]
    with pytest.raises(
        CalibrationError, match=r"1 laser is certain.*give their number \(--lasers N\)"
    ):
        calibrate_lasers(without_lasers(made.rig), views, board_surface())
    told = calibrate_lasers(
        without_lasers(made.rig), views, board_surface(), options=LaserOptions(n_lasers=1)
    )
    angle, offset = laser_error(told.lasers[0].laser.plane, made.rig.lasers[0].plane)
    assert np.rad2deg(angle) < 0.3
    assert abs(offset) < 2e-3


def test_a_laser_that_no_point_tells_of_is_named_with_the_remedy() -> None:
    camera, surfaces = RIG.camera(), box()
    placed, _ = place_views(camera, box_seen(), surfaces)
    start = InitialGuess(RIG, surfaces, tuple(placed), None)
    n_points = sum(len(view.placed) for view in placed)
    with pytest.raises(CalibrationError, match=r"laser 'lower' cannot be solved.*nearer, farther"):
        solve_lasers(start, list(RIG.lasers), np.full(n_points, -1), None)


def test_no_stripes() -> None:
    views = kept(box_seen(), lambda v: v.stripes.chain < 0)
    with pytest.raises(CalibrationError, match="no stripe lies on the target's surfaces"):
        calibrate_lasers(RIG, views, box())


def test_boards_all_at_one_place() -> None:
    views = simulated(RIG, [dome_from_board(1)] * 3, board_corners(), board_surface(), noise=NOISE)
    words = r"none of the lasers.*two places of the board that differ"
    with pytest.raises(CalibrationError, match=words):
        calibrate_lasers(RIG, views, board_surface())


@pytest.mark.parametrize("factor", [1e3, 1e-3], ids=["metres for millimetres", "the reverse"])
def test_swapped_units(factor: float) -> None:
    views = [replace(v, view=replace(v.view, points=v.view.points * factor)) for v in box_seen()]
    surfaces = box()
    scaled = replace(
        surfaces,
        planes=tuple(Plane(p.normal, p.offset * factor) for p in surfaces.planes),
        lowest=surfaces.lowest * factor,
        highest=surfaces.highest * factor,
    )
    with pytest.raises(CalibrationError, match=r"the target's points span .* millimetres"):
        calibrate_lasers(RIG, views, scaled)


def test_a_target_ten_times_too_large_lies_too_far_away() -> None:
    """A bare lens cannot tell a target's size; its distance gives it away."""
    rig = replace(RIG, housing=None, working_range=(0.3, 0.6))
    views = simulated(rig, [dome_from_board(i) for i in range(4)], board_corners(), board_surface())
    views = [replace(v, view=replace(v.view, points=v.view.points * 10.0)) for v in views]
    with pytest.raises(CalibrationError, match=r"stripes lie .* mm away"):
        calibrate_lasers(rig, views, board_surface())


def test_a_wrong_medium_is_refused() -> None:
    with pytest.raises(CalibrationError, match=r"corners miss by .* px .*air or water"):
        calibrate_lasers(RIG.in_water(1.0003), box_seen(), box())


@pytest.mark.parametrize(("taken_in", "said"), [("air", RIG.n_water), ("water", 1.0003)])
def test_pictures_in_the_other_medium_are_refused_with_the_remedy(
    taken_in: str, said: float
) -> None:
    """A few hundredths of a degree are left in corners, but a degree in the lasers."""
    seen = RIG.in_water(1.0003) if taken_in == "air" else RIG
    views = simulated(
        seen, [dome_from_board(i) for i in range(4)], board_corners(), board_surface(), noise=NOISE
    )
    with pytest.raises(CalibrationError, match=f"Give --medium {taken_in}"):
        calibrate_lasers(RIG, views, board_surface(), options=LaserOptions(n_medium=said))


def test_a_laser_that_was_off_in_most_pictures_is_mentioned() -> None:
    rig, two = without_lasers(RIG), replace(RIG, lasers=RIG.lasers[:2])
    surfaces = board_surface()
    poses = [dome_from_board(i) for i in range(len(BOARD_POSES))]
    all_on = simulated(RIG, poses[:2], board_corners(), surfaces, noise=NOISE, spacing=0.004)
    two_on = simulated(two, poses[2:], board_corners(), surfaces, noise=NOISE, spacing=0.004)
    renamed = [replace(v, view=replace(v.view, name=f"two_{i}.png")) for i, v in enumerate(two_on)]
    result = calibrate_lasers(rig, [*all_on, *renamed], surfaces)
    assert len(result.lasers) == 2
    assert any("belong" in words for words in result.warnings)


def test_a_medium_that_is_a_little_wrong_is_mentioned() -> None:
    result = calibrate_lasers(RIG.in_water(1.25), box_seen(), box())
    assert any("check the rig, the medium" in words for words in result.warnings)


def test_refinement_needs_something_uncertain() -> None:
    with pytest.raises(OptionError, match="refinement is asked for"):
        calibrate_lasers(RIG, box_seen(), box(), options=LaserOptions(refine=True))


@pytest.mark.parametrize("bad", [{"n_lasers": 0}, {"stripe_bias_px": -0.1}])
def test_senseless_options_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(OptionError, match=next(iter(bad))):
        LaserOptions(**bad)


def test_corners_cover_the_box() -> None:
    assert len(box_corners()) == 4 * 80
