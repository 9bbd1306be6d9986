"""The main path on painted frames: postures, every reason to refuse, labels."""

import copy
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pickle import dumps, loads
from typing import Any, TypeAlias

import cv2
import numpy as np
import pytest

from aqualvs.errors import RigError
from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.planes import Plane, Rays
from aqualvs.optics.rig import Rig
from aqualvs.optics.sheet import sheets_of
from aqualvs.scanner import Scanner, ScannerOptions
from aqualvs.scanning.laser_bands import SearchAxis
from aqualvs.scanning.paper.mesh_filter import MeshFilterOptions
from aqualvs.scanning.plane_fit import GLOW_SHARE, TWINE_SHARE
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.scanning.posture_estimator import FitMethod
from aqualvs.scanning.scan import Frame, Label, Scan, planes_of_image
from aqualvs.scanning.stripe import ThresholdOptions, flank_difference
from aqualvs.scanning.surfaces import Surface, SurfaceFinder
from aqualvs.scanning.target import TargetKind
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig
from fan_cases import Fan, fan_rig
from scanning_cases import merged, peaks_of
from scanning_cases import strands as broken
from windowed_cases import windowed

Lit: TypeAlias = Callable[[FloatArray], BoolArray]
BACKGROUND = 40.0
SIGMA_PX = 2.2
ALL = (0, 1, 2)


def plane(distance: float, pitch: float = 0.0, yaw: float = 0.0) -> Plane:
    normal = np.array([np.tan(np.deg2rad(yaw)), 1.0, np.tan(np.deg2rad(pitch))])
    return Plane(normal / np.linalg.norm(normal), distance)


def everywhere(points: FloatArray) -> BoolArray:
    return np.ones(points.shape[:-1], np.bool_)


def strands(points: FloatArray) -> BoolArray:
    """Upright and level twine of 3 mm, every 25 mm."""
    twine: BoolArray = (points[..., 0] % 0.025 < 0.003) | (points[..., 2] % 0.025 < 0.003)
    return twine


def upright_strands(points: FloatArray) -> BoolArray:
    """The paper's net: 10 mm of light every 25 mm."""
    twine: BoolArray = points[..., 0] % 0.025 < 0.010
    return twine


@cache
def rays_of(size_px: tuple[int, int]) -> Rays:
    """Rays of all pixels; the rigs with pictures of one size differ in their lasers alone."""
    (rig,) = (one for one in (example_rig(), bluerov2_rig()) if one.size_px == size_px)
    columns, rows = map(np.arange, size_px)
    return rig.camera().rays(np.stack(np.meshgrid(columns, rows), axis=-1))


def light_on(rig: Rig, targets: Sequence[tuple[Plane, Lit]], lasers: Sequence[int]) -> FloatArray:
    """Light of the lasers on the first target that each pixel meets, nearest first."""
    rays, sheets = rays_of(rig.size_px), sheets_of(rig)
    light = np.zeros(rig.size_px[::-1])
    open_ = np.ones(light.shape, np.bool_)
    for target, lit in targets:
        points, valid = target.intersect(rays)
        points = np.where(valid[..., None], points, 0.0)
        here = open_ & valid & lit(points)
        open_ &= ~here
        met = points[here]
        px_per_m = max(rig.lens.fx, rig.lens.fy) / np.sqrt(np.einsum("ij,ij->i", met, met))
        for i in lasers:
            off = sheets[i].signed_distance(met) * px_per_m
            light[here] += 130.0 * np.exp(-0.5 * (off / SIGMA_PX) ** 2)
    return light


def frame_of(light: FloatArray, *, grey: bool = False, noise: float = 0.0) -> Frame:
    rng = np.random.default_rng(9)
    value = BACKGROUND + light + rng.normal(0.0, noise, light.shape)
    luma = np.clip(np.rint(value), 0, 255).astype(np.uint8)
    if grey:
        return Frame(3, 0.12, luma)
    height, width = light.shape
    half = light.reshape(height // 2, 2, width // 2, 2).mean(axis=(1, 3))
    u = np.rint(120.0 - 50.0 * np.clip(half / 130.0, 0.0, 1.0)).astype(np.uint8)
    return Frame(3, 0.12, luma, (u, np.full_like(u, 110)))


def scan(
    targets: Sequence[tuple[Plane, Lit]],
    *,
    rig: Rig | None = None,
    lasers: Sequence[int] = ALL,
    options: ScannerOptions | None = None,
    grey: bool = False,
    noise: float = 0.0,
) -> Scan:
    rig = rig or example_rig()
    frame = frame_of(light_on(rig, targets, lasers), grey=grey, noise=noise)
    return Scanner(rig, options).process(frame)


def assert_posture(
    found: Posture | Refusal, target: Plane, share: float = 0.001, deg: float = 0.1
) -> None:
    assert found, found
    n = target.normal
    assert abs(found.range / target.offset - 1.0) < share
    assert abs(np.rad2deg(found.pitch - np.arctan2(n[2], n[1]))) < deg
    assert abs(np.rad2deg(found.yaw - np.arctan2(n[0], n[1]))) < deg


def reason(found: Posture | Refusal) -> Reason:
    assert not found, found
    assert found.detail
    return found.reason


TILTS = [plane(0.4), plane(0.6, 18.0, -22.0), plane(0.9, -12.0, 9.0)]


@pytest.mark.parametrize("target", TILTS, ids=str)
@pytest.mark.parametrize("grey", [False, True])
def test_a_wall(target: Plane, grey: bool) -> None:
    found = scan([(target, everywhere)], grey=grey, noise=2.0)
    # Painted stripes are exact; grey levels, noise and crossings leave hundredths of a pixel.
    assert_posture(found.posture, target)
    assert found.posture
    sigma = np.sqrt(np.diag(found.posture.covariance))
    assert sigma[0] < 0.002 * target.offset
    assert np.all(np.rad2deg(sigma[1:]) < 0.3)
    assert found.posture.nearest >= 0.99 * found.posture.range
    assert (found.index, found.time_s) == (3, 0.12)
    assert found.n_water == example_rig().n_water


def test_lines_whose_colour_is_lost_are_measured_by_luma() -> None:
    """In turbid water the glow beside a line is as green as the line: no step of colour is left."""
    wall, scanner = plane(0.55, 3.0, -5.0), Scanner(example_rig())
    frame = frame_of(light_on(scanner.rig, [(wall, everywhere)], ALL), noise=2.0)
    assert frame.chroma is not None
    u, v = (np.full_like(frame.chroma[0], level) for level in (119, 117))
    frame = replace(frame, chroma=(u, v))
    assert not scanner.measure(frame.index, frame.time_s, scanner.detect(frame)).posture
    peaks, found = scanner.scan(frame)
    assert_posture(found.posture, wall)
    # What is recorded measures the same again.
    again = scanner.measure(frame.index, frame.time_s, peaks).posture
    assert again
    assert found.posture
    assert again.range == found.posture.range
    # With one of the lasers dark, colour would have to tell.
    two = frame_of(light_on(scanner.rig, [(wall, everywhere)], (0, 1)), noise=2.0)
    assert not scanner.process(replace(two, chroma=(u, v))).posture


@pytest.mark.parametrize("grey", [False, True])
def test_dashes_without_colour_on_a_net_in_daylight_are_the_tallest_peaks(grey: bool) -> None:
    net, scanner = plane(0.75, 3.0, -5.0), Scanner(example_rig())
    dashes = light_on(scanner.rig, [(net, strands)], ALL)
    points, _ = net.intersect(rays_of(scanner.rig.size_px))
    twine = cv2.GaussianBlur(45.0 * strands(points), (0, 0), 1.0)
    frame = frame_of(dashes + twine, grey=True, noise=2.0)
    if not grey:
        # Too green for a grey camera, and as green everywhere.
        u, v = (np.full((288, 360), level, np.uint8) for level in (119, 117))
        frame = replace(frame, chroma=(u, v))
    assert not scanner.measure(frame.index, frame.time_s, scanner.detect(frame)).posture
    assert_posture(scanner.process(frame).posture, net)
    # With the lasers off, nothing is certain.
    off = frame_of(twine, grey=True, noise=2.0)
    assert not scanner.process(replace(off, chroma=frame.chroma)).posture


@pytest.mark.parametrize(
    ("wavelength", "bgr"), [(450.0, (1.0, 0.2, 0.1)), (650.0, (0.1, 0.2, 1.0))]
)
@pytest.mark.parametrize("make", [example_rig, bluerov2_rig])
def test_a_wall_under_blue_and_red_lasers(
    make: Callable[[], Rig], wavelength: float, bgr: tuple[float, float, float]
) -> None:
    target, rig = plane(0.55, 6.0, -9.0), make()
    light = light_on(rig, [(target, everywhere)], ALL)[..., None] * np.array(bgr)
    light += BACKGROUND + np.random.default_rng(9).normal(0.0, 2.0, light.shape)
    image = np.clip(np.rint(light), 0, 255).astype(np.uint8)
    frame = Frame(3, 0.12, *planes_of_image(image))
    lasers = tuple(replace(laser, wavelength_nm=wavelength) for laser in rig.lasers)
    # Half of what is searched is chroma of half the size.
    assert_posture(Scanner(replace(rig, lasers=lasers)).process(frame).posture, target, 0.002, 0.2)


@pytest.mark.parametrize("target", [plane(0.5, 5.0, -8.0), plane(1.0, -10.0, 14.0)], ids=str)
def test_a_wall_in_a_wide_picture(target: Plane) -> None:
    found = scan([(target, everywhere)], rig=bluerov2_rig())
    assert_posture(found.posture, target)


def slanting(rig: Rig, turns_deg: Sequence[float]) -> Rig:
    """A rig with lasers around the camera, all aimed at 0.5 m ahead of it."""
    normals = [np.array([np.cos(turn), -0.27, np.sin(turn)]) for turn in np.deg2rad(turns_deg)]
    lasers = (
        replace(rig.lasers[0], name=f"laser_{k}", plane=Plane(n / np.hypot(1.0, 0.27), -0.13))
        for k, n in enumerate(normals)
    )
    return replace(rig, lasers=tuple(lasers))


@pytest.mark.parametrize(
    "turns_deg", [(60.0, -30.0, 210.0), (50.0, -45.0, 225.0), (50.0, -45.0, 225.0, 130.0)], ids=str
)
@pytest.mark.parametrize("make", [example_rig, bluerov2_rig])
def test_a_wall_under_slanting_lasers(make: Callable[[], Rig], turns_deg: Sequence[float]) -> None:
    """Their stripes make peaks on the search lines of both directions."""
    rig, target = slanting(make(), turns_deg), plane(0.8, 10.0)
    found = scan([(target, everywhere)], rig=rig, lasers=range(len(turns_deg)))
    assert_posture(found.posture, target)


def test_stripes_seen_from_both_directions_are_not_too_many_for_the_lasers() -> None:
    """Tall peaks in a crowd are paint: there were twice as many as search lines."""
    rig = slanting(example_rig(), (50.0, -45.0, 225.0, 130.0))
    light = light_on(rig, [(plane(0.6), everywhere)], range(4))
    assert Scanner(rig).detect(frame_of(light, noise=4.0)).coloured_share > 0.9


@pytest.mark.parametrize("target", [plane(0.4), plane(0.55, -6.0, 11.0)], ids=str)
def test_a_net_in_open_water(target: Plane) -> None:
    found = scan([(target, strands)])
    # Strands cut stripes off askew: the light's centre on a strand is only nearly on the sheet.
    assert_posture(found.posture, target, share=0.006, deg=0.8)


def thin_strands(points: FloatArray) -> BoolArray:
    """Twine of 1.5 mm in squares, slightly turned."""
    x, z = points[..., 0], points[..., 2]
    lit: BoolArray = ((x + 0.25 * z) % 0.03 < 0.0015) | ((z - 0.25 * x) % 0.03 < 0.0015)
    return lit


def test_strands_on_two_search_lines_count_in_a_wide_picture() -> None:
    target = plane(0.9, 5.0, -8.0)
    found = scan([(target, thin_strands)], rig=bluerov2_rig())
    assert_posture(found.posture, target)
    assert found.points.used.mean() > 0.75


def test_a_net_before_a_wall_is_the_target_unless_the_wall_is_asked_for() -> None:
    net, wall = plane(0.45, 2.0, -5.0), plane(0.85, 0.0, 4.0)
    both = [(net, strands), (wall, everywhere)]
    for kind, target in ((TargetKind.AUTO, net), (TargetKind.NET, net), (TargetKind.SOLID, wall)):
        found = scan(both, options=ScannerOptions(target=kind))
        assert_posture(found.posture, target, share=0.01, deg=1.5)
    found = scan(both)
    on_wall = np.abs(wall.signed_distance(found.points.points_in_dome)) < 0.004
    on_net = np.abs(net.signed_distance(found.points.points_in_dome)) < 0.003
    assert np.mean(found.points.label[on_wall & ~on_net] == Label.BACKGROUND) > 0.85
    assert not np.any(found.points.used[on_wall & ~on_net])
    assert np.mean(found.points.label[on_net & ~on_wall] == Label.NET) > 0.98
    # Fragments of strands and crossings are left out of the posture.
    assert np.mean(found.points.used[on_net & ~on_wall]) > 0.3


def with_fan(rig: Rig, fan: Fan) -> Rig:
    """The rig with the lines of a fan in place of its lasers."""
    return replace(rig, lasers=fan_rig(fan).lasers)


FANS = [
    Fan(n_lines=9, spacing_deg=1.9, baseline=(-0.12, 0.0, 0.0), aim_deg=8.0),
    Fan(n_lines=14, spacing_deg=1.1, baseline=(-0.15, 0.02, 0.0), aim_deg=8.0),
]


@pytest.mark.parametrize("fan", FANS, ids=["9 lines", "14 lines"])
@pytest.mark.parametrize("wall", [plane(0.95, 0.0, -4.0), plane(1.15, 3.0, 6.0)], ids=str)
def test_a_net_before_a_wall_under_many_lasers(fan: Fan, wall: Plane) -> None:
    # A peak has a candidate for most lasers: the net has a small share of all candidates.
    rig, net = with_fan(bluerov2_rig(), fan), plane(0.55, 3.0, 2.0)
    found = scan([(net, thin_strands), (wall, everywhere)], rig=rig, lasers=range(fan.n_lines))
    assert_posture(found.posture, net, share=0.004, deg=1.0)


@pytest.mark.parametrize(("share", "apart_px"), [(0.06, -33), (0.1, -25), (0.06, 18)])
def test_a_double_reflection_is_no_net_before_a_wall(share: float, apart_px: int) -> None:
    rig, wall = with_fan(bluerov2_rig(), FANS[0]), plane(0.63, 5.0, -8.0)
    light = light_on(rig, [(wall, everywhere)], range(FANS[0].n_lines))
    # Noise breaks the fainter stripes as twine does.
    frame = frame_of(light + share * np.roll(light, apart_px, axis=1), noise=4.0)
    assert_posture(Scanner(rig).process(frame).posture, wall)


@pytest.mark.parametrize(
    ("rig", "distance"),
    [(example_rig(), 0.5), (windowed(example_rig()), 0.5), (windowed(example_rig()), 0.9)],
    ids=["planes", "bent", "bent, far"],
)
def test_crossings_are_on_the_target_but_not_in_the_posture(rig: Rig, distance: float) -> None:
    target = plane(distance, 3.0, -4.0)
    points = scan([(target, everywhere)], rig=rig).points
    near = np.zeros(len(points), np.bool_)
    for i, sheet in enumerate(sheets_of(rig)):
        off = np.abs(sheet.signed_distance(points.points_in_dome))
        near |= (points.laser != i) & (off * 878.0 / distance < SIGMA_PX)
    on_it = np.abs(target.signed_distance(points.points_in_dome)) < 0.003
    assert np.count_nonzero(near & on_it) > 3
    assert not np.any(points.used[near & on_it])
    clear = on_it & ~near
    # Crossing zones are wider than what is counted as near here; bent stripes cross more flatly.
    assert np.mean(points.used[clear]) > 0.88
    assert np.mean(points.label[on_it] == Label.SOLID) > 0.98


def test_every_point_has_its_pixel_laser_and_label() -> None:
    rig = example_rig()
    points = scan([(plane(0.5), everywhere)]).points
    pixels, valid = rig.camera().project(points.points_in_dome)
    assert valid.all()
    np.testing.assert_allclose(pixels, points.pixels, rtol=0.0, atol=1e-6)
    assert set(np.unique(points.label)) <= {int(one) for one in Label}
    target = points.used
    _, counts = np.unique(points.pixels[target], axis=0, return_counts=True)
    assert counts.max() == 1


def test_nothing_lit() -> None:
    for grey in (False, True):
        found = scan([], grey=grey)
        assert reason(found.posture) is Reason.NO_STRIPES
        assert len(found.points) == 0


def test_noise_alone_is_refused_without_a_word() -> None:
    rig = example_rig()
    width, height = rig.size_px
    luma = np.random.default_rng(0).integers(0, 256, (height, width), dtype=np.uint8)
    assert not Scanner(rig).process(Frame(0, 0.0, luma)).posture


def test_hardly_anything_lit() -> None:
    def a_spot(points: FloatArray) -> BoolArray:
        lit: BoolArray = np.abs(points[..., 2]) < 0.001
        return lit

    found = scan([(plane(0.5), a_spot)], lasers=(1,))
    assert reason(found.posture) is Reason.TOO_FEW_POINTS


@pytest.mark.parametrize("laser", [0, 1, 2])
def test_one_laser_on(laser: int) -> None:
    found = scan([(plane(0.5), everywhere)], lasers=(laser,))
    # Light of one laser may lie in the bands of others; no two of them make it a plane.
    assert reason(found.posture) in {Reason.ONE_LASER, Reason.NOT_A_PLANE}


def test_stray_peaks_of_a_dark_laser_cross_no_stripe() -> None:
    """They may be wide: the crossing of a stripe so wide would cover the others."""
    rig, wall = example_rig(), plane(0.5, 4.0)
    first, dark, last = rig.lasers

    def spot(points: FloatArray) -> BoolArray:
        return np.abs(points @ np.array([1.0, 0.0, 1.0]) - 0.1) < 0.003

    peaks = peaks_of(replace(rig, lasers=(first, last)), [(wall, everywhere)], 0.05)
    for axis, stray in peaks_of(replace(rig, lasers=(dark,)), [(wall, spot)]).items():
        assert 3 <= stray.n < 20, stray.n
        wide = stray._replace(width=np.full(stray.n, 400.0))
        peaks[axis] = merged(peaks[axis], wide)
    assert_posture(Scanner(rig).measure(0, 0.0, peaks).posture, wall)


def test_a_rig_of_one_laser() -> None:
    rig = example_rig()
    found = scan([(plane(0.5), everywhere)], rig=replace(rig, lasers=rig.lasers[:1]), lasers=(0,))
    assert reason(found.posture) is Reason.ONE_LASER


def test_two_lasers_are_enough() -> None:
    target = plane(0.5, 4.0, -7.0)
    assert_posture(scan([(target, everywhere)], lasers=(0, 1)).posture, target)


def test_lasers_on_different_surfaces_share_no_plane() -> None:
    rig = example_rig()
    wall = light_on(rig, [(plane(0.65), everywhere)], (1,))
    found = Scanner(rig).process(frame_of(wall + light_on(rig, [(plane(0.4), dash)], (2,))))
    assert reason(found.posture) is Reason.NOT_A_PLANE


def test_two_lasers_in_a_corner_show_no_plane_between_its_walls() -> None:
    """A plane may meet the stripe on one wall, and a few places of the one on the other."""
    left, normal = plane(0.705, 0.0, 20.0), plane(1.0, 0.0, -40.0).normal
    right = Plane(normal, float(normal @ np.array([0.05, 0.75, 0.0])))
    walls = [
        (left, lambda points: right.signed_distance(points) < 0.0),
        (right, lambda points: left.signed_distance(points) < 0.0),
    ]
    rig = example_rig()
    rig = replace(rig, lasers=rig.lasers[1:])
    found = Scanner(rig).measure(0, 0.0, peaks_of(rig, walls, 0.1))
    assert reason(found.posture) is Reason.ONE_LASER


def dash(points: FloatArray) -> BoolArray:
    """A piece of stripe 20 mm high, as on a fish."""
    lit: BoolArray = np.abs(points[..., 2]) < 0.01
    return lit


def test_a_dash_of_another_laser_does_not_turn_a_wall() -> None:
    """A line and a point always share a plane: that is no evidence for one."""
    rig = example_rig()
    wall = light_on(rig, [(plane(0.65), everywhere)], (1,))
    found = Scanner(rig).process(frame_of(wall + light_on(rig, [(plane(0.7), dash)], (2,))))
    assert not found.posture, found.posture


def test_stripes_side_by_side_far_away_do_not_fix_a_plane() -> None:
    """Two lasers 13 mm apart on a net at 1.7 m: the plane could turn about them."""
    rig = replace(example_rig(), working_range=(0.3, 1.8))
    first = rig.lasers[0]
    second = replace(
        first, name="beside", plane=Plane(first.plane.normal, first.plane.offset + 0.013)
    )
    found = scan(
        [(plane(1.7), strands)], rig=replace(rig, lasers=(first, second)), lasers=(0, 1), noise=3.0
    )
    # What is noticed first depends on which strands are taken for which laser's.
    reasons = {Reason.COLLINEAR, Reason.ONE_LASER, Reason.OUT_OF_RANGE}
    assert reason(found.posture) in reasons


def test_a_wall_where_a_net_was_asked_for() -> None:
    found = scan([(plane(0.5), everywhere)], options=ScannerOptions(target=TargetKind.NET))
    assert reason(found.posture) is Reason.NO_TARGET
    assert found.posture == Refusal(Reason.NO_TARGET, "surfaces in view, but none of kind net")
    assert np.mean(found.points.label == Label.SOLID) > 0.9


@pytest.mark.parametrize("distance", [0.27, 1.1])
def test_a_wall_out_of_range(distance: float) -> None:
    found = scan([(plane(distance), everywhere)])
    assert reason(found.posture) is Reason.OUT_OF_RANGE
    assert isinstance(found.posture, Refusal)
    assert f"range {distance:.2f}" in found.posture.detail
    assert not np.any(found.points.used)


def test_frames_do_not_depend_on_each_other() -> None:
    rig = example_rig()
    frames = [
        frame_of(light_on(rig, targets, ALL), noise=3.0)
        for targets in (
            [(plane(0.5, 4.0), everywhere)],
            [],
            [(plane(0.45), strands), (plane(0.8), everywhere)],
        )
    ]
    scanner = Scanner(rig)
    in_order = [scanner.process(frame) for frame in frames]
    again = [scanner.process(frame) for frame in reversed(frames)][::-1]
    for one, other in zip(in_order, again, strict=True):
        assert bool(one.posture) == bool(other.posture)
        np.testing.assert_array_equal(one.points.points_in_dome, other.points.points_in_dome)
        np.testing.assert_array_equal(one.points.label, other.points.label)
        if one.posture and other.posture:
            assert one.posture.range == other.posture.range
            np.testing.assert_array_equal(one.posture.covariance, other.posture.covariance)


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda one: loads(dumps(one))])
def test_a_copy_measures_what_its_original_does(copied: Callable[[Scanner], Scanner]) -> None:
    rig = example_rig()
    frame = frame_of(light_on(rig, [(plane(0.5, 4.0), everywhere)], ALL), noise=3.0)
    options = ScannerOptions(target=TargetKind.SOLID)
    scanner = Scanner(rig, options, rig.in_water(1.36).camera())
    found = scanner.process(frame)
    other = copied(scanner)
    assert found.posture
    np.testing.assert_array_equal(
        other.process(frame).points.points_in_dome, found.points.points_in_dome
    )
    assert other.options == options


def test_threads_share_a_scanner() -> None:
    rig = example_rig()
    walls = [plane(0.45 + 0.05 * i, 4.0) for i in range(6)]
    frames = [frame_of(light_on(rig, [(wall, everywhere)], ALL), noise=3.0) for wall in walls]
    scanner = Scanner(rig)
    alone = [scanner.process(frame).points.points_in_dome for frame in frames]
    with ThreadPoolExecutor(3) as pool:
        together = list(pool.map(scanner.process, 4 * frames))
    for points, scan in zip(4 * alone, together, strict=True):
        np.testing.assert_array_equal(points, scan.points.points_in_dome)


def test_what_is_no_rig_is_refused() -> None:
    with pytest.raises(RigError, match=r"rig is 'rig.yaml'; give what aqualvs.load_rig makes"):
        Scanner("rig.yaml")  # type: ignore[arg-type]


def test_a_frame_is_left_as_it_was() -> None:
    rig = example_rig()
    frame = frame_of(light_on(rig, [(plane(0.5), everywhere)], ALL))
    assert frame.chroma is not None
    planes = (frame.luma, *frame.chroma)
    before = [one.copy() for one in planes]
    for one in planes:
        one.flags.writeable = False
    assert Scanner(rig).process(frame).posture
    for one, kept in zip(planes, before, strict=True):
        np.testing.assert_array_equal(one, kept)


@pytest.mark.parametrize("size", [(720, 575), (360, 288), (576, 720)])
def test_a_frame_of_another_size_is_refused(size: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=f"is {size[0]} x {size[1]} px but"):
        Scanner(example_rig()).process(Frame(0, 0.0, np.zeros(size[::-1], np.uint8)))


@pytest.mark.parametrize(
    ("options", "share", "deg"),
    [
        (ScannerOptions(fit=FitMethod.PSEUDO_INVERSE), 0.002, 0.2),
        # Half a pixel at each end of a run, over hundreds of them.
        (ScannerOptions(detector=ThresholdOptions(level=110)), 0.003, 0.3),
    ],
    ids=["pseudo-inverse", "threshold"],
)
def test_the_paper_s_own_methods(options: ScannerOptions, share: float, deg: float) -> None:
    target = plane(0.5, 6.0, -9.0)
    found = scan([(target, everywhere)], options=options)
    assert_posture(found.posture, target, share=share, deg=deg)


@pytest.mark.parametrize("rig", [example_rig(), windowed(example_rig())], ids=["planes", "bent"])
def test_the_paper_s_mesh_filter_takes_a_wall_away_and_leaves_a_net(rig: Rig) -> None:
    options = ScannerOptions(mesh_filter=MeshFilterOptions())
    wall = scan([(plane(0.5), everywhere)], rig=rig, options=options)
    without = scan([(plane(0.5), everywhere)], rig=rig)
    assert len(wall.points) < 0.5 * len(without.points)
    # Where the filter's bins happen to part the strands, it takes them away, too.
    kept = [
        len(scan([(plane(range), upright_strands)], rig=rig, options=options, lasers=(0, 2)).points)
        for range in (0.42, 0.44, 0.46, 0.48, 0.5)
    ]
    assert np.median(kept) > 60


def patch(points: FloatArray) -> BoolArray:
    """As much of a wall as the flank of a fish."""
    flank: BoolArray = np.hypot(points[..., 0], points[..., 2]) < 0.05
    return flank


@pytest.mark.parametrize("lit", [everywhere, patch])
def test_a_wall_whose_lines_look_broken_is_measured_as_one(
    lit: Lit, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Noise breaks dim lines like twine; too few strands are left for a net's posture."""

    find = SurfaceFinder.find

    def find_broken(*arguments: Any) -> list[Surface]:
        return [replace(one, is_mesh=True, is_unbroken=True) for one in find(*arguments)]

    monkeypatch.setattr(SurfaceFinder, "find", find_broken)
    rig = example_rig()
    peaks = peaks_of(rig, [(plane(0.6, 4.0), lit)], 0.05)
    scan = Scanner(rig).measure(0, 0.0, peaks)
    if lit is everywhere:
        assert isinstance(scan.posture, Posture)
        assert scan.posture.range == pytest.approx(0.6, rel=1e-3)
        assert np.mean(scan.points.label == Label.SOLID) > 0.9
    else:
        assert isinstance(scan.posture, Refusal)
        assert scan.posture.reason in {Reason.COLLINEAR, Reason.TOO_FEW_POINTS, Reason.ONE_LASER}
    # Who asks for a net gets none.
    wanted = Scanner(rig, ScannerOptions(target=TargetKind.NET)).measure(0, 0.0, peaks)
    assert not wanted.posture


def test_without_its_dome_the_camera_reads_another_posture() -> None:
    rig, target = example_rig(), plane(0.9)
    frame = frame_of(light_on(rig, [(target, everywhere)], ALL))
    found = Scanner(rig, camera=rig.bare_camera()).process(frame).posture
    assert not found or abs(found.range / 0.9 - 1.0) > 0.03 or abs(np.rad2deg(found.pitch)) > 3.0


@pytest.mark.parametrize("rough_px", [0.1, 1.2])
def test_small_gaps_without_long_lines_are_a_nets_if_the_surface_is_rough(rough_px: float) -> None:
    """Growth leaves small gaps, as the joints of a mosaic, which is smooth."""

    def lit(points: FloatArray) -> BoolArray:
        return np.hypot(points[:, 0], points[:, 2]) % 0.034 < 0.03

    peaks = peaks_of(example_rig(), [(plane(0.5), lit)], rough_px)
    scan = Scanner(example_rig()).measure(0, 0.0, peaks)
    assert isinstance(scan.posture, Posture)
    expected = Label.SOLID if rough_px < 0.5 else Label.NET
    assert np.mean(scan.points.label == expected) > 0.9


def range_variance_of_net(width: float, pull: float = 0.0) -> float:
    """Return the variance of the range to a net at 0.5 m, pulled to the near side of stripes."""
    peaks = peaks_of(example_rig(), [(plane(0.5), broken)], 0.05)
    alike = {
        a: part._replace(
            width=np.full(part.n, width),
            pull=np.full(part.n, pull if a is SearchAxis.ALONG_Y else -pull),
        )
        for a, part in peaks.items()
    }
    found = Scanner(example_rig()).measure(0, 0.0, alike).posture
    assert isinstance(found, Posture)
    return float(found.covariance[0, 0])


def px_per_m() -> float:
    """Return how far stripes move in the picture as a target at 0.5 m moves away."""
    near, far = (peaks_of(example_rig(), [(plane(one), everywhere)]) for one in (0.5, 0.501))
    one, other = (part[SearchAxis.ALONG_Y] for part in (near, far))
    moved = np.interp(other.line, one.line, one.position) - other.position
    return float(np.median(np.abs(moved))) / 0.001


def test_a_shift_of_the_light_on_twine_is_in_the_sigma_of_the_range() -> None:
    # Narrow stripes weigh more, and each laser's strands share as much again.
    shared = np.sqrt(range_variance_of_net(5.0) - range_variance_of_net(1e-3))
    shift = 5.0 * TWINE_SHARE / px_per_m()
    assert 0.8 * shift < shared < 1.6 * shift


def test_glow_at_the_strands_of_a_net_is_in_the_sigma_of_the_range() -> None:
    shared = np.sqrt(range_variance_of_net(5.0, 0.01) - range_variance_of_net(5.0))
    shift = 5.0 * GLOW_SHARE * flank_difference(0.01, 5.0) / px_per_m()
    assert 0.9 * shift < shared < 1.1 * shift
