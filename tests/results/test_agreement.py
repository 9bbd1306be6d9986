"""Do the lasers agree? Named where one has drifted, and silence where the target is bent."""

import re
from collections.abc import Callable, Iterator
from dataclasses import fields, replace

import numpy as np
import pytest

from agreement_cases import Diver, Target
from aqualvs.optics.lens import Lens, LensModel
from aqualvs.optics.rig import Rig, RigUncertainty, rig_moved_by
from aqualvs.optics.sheet import sheets_of
from aqualvs.optics.solved import with_uncertainty
from aqualvs.results.agreement import (
    N_BINS,
    AgreementState,
    AgreementVerdict,
    LaserAgreement,
    bin_stripes,
    fit_zoom,
)
from aqualvs.scanning.laser_bands import SearchAxis, plan_bands
from aqualvs.scanning.posture import Reason, Refusal
from aqualvs.scanning.scan import Scan, ScanPoints
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig
from whole import part_of

RIG = example_rig()
N_FRAMES = 24


def turned(rig: Rig, laser: int, degrees: float, towards: float = 0.0) -> Rig:
    """Turn one laser's sheet, in a direction of its own `tangent_basis` (radians)."""
    name = rig.lasers[laser].name
    tilt = np.tan(np.deg2rad(degrees)) * np.array([np.cos(towards), np.sin(towards)])
    return rig_moved_by(rig, (f"{name}:tilt_1", f"{name}:tilt_2"), tilt)


def swinging(i: int, **form: float) -> Target:
    t = i / N_FRAMES
    pitch, yaw = 12.0 * np.sin(6.28 * t), 9.0 * np.cos(9.0 * t)
    return Target(0.45 + 0.3 * t, pitch_deg=pitch, yaw_deg=yaw, **form)


def still(i: int, **form: float) -> Target:
    return Target(0.6, pitch_deg=3.0, yaw_deg=-4.0, **form)


def scans(
    seen_by: Rig, read_by: Rig, target: Callable[..., Target] = swinging, **form: float
) -> Iterator[Scan]:
    diver = Diver(seen_by, read_by)
    for i in range(0, N_FRAMES, 3):
        # Neighbouring frames of a video say the same.
        yield from 3 * [diver.scan(target(i, **form), index=i)]


def verdict_on(rig: Rig, frames: Iterator[Scan]) -> AgreementVerdict:
    agreement = LaserAgreement(rig)
    for scan in frames:
        agreement.add(scan)
    return agreement.verdict()


@pytest.mark.parametrize("rig", [RIG, bluerov2_rig()], ids=lambda rig: rig.name)
@pytest.mark.parametrize("target", [swinging, still])
def test_lasers_that_agree_are_left_alone(rig: Rig, target: Callable[..., Target]) -> None:
    verdict = verdict_on(rig, scans(rig, rig, target))
    assert verdict.state is AgreementState.AGREE
    assert verdict.sentence() == ""
    assert verdict.to_dict() == {"state": "agree", "n_frames": verdict.n_frames}


@pytest.mark.parametrize("laser", [0, 1, 2])
@pytest.mark.parametrize("towards", [0.0, 1.57])
@pytest.mark.parametrize("degrees", [0.4, 2.0])
def test_a_laser_that_has_turned_is_named(laser: int, towards: float, degrees: float) -> None:
    verdict = verdict_on(RIG, scans(turned(RIG, laser, degrees, towards), RIG))
    assert verdict.state is AgreementState.DRIFTED
    assert verdict.suspects == (laser,)
    # What is asked of it; stripe errors of 0.1 px make hundredths.
    assert np.rad2deg(verdict.angle) == pytest.approx(degrees, abs=0.1)
    assert f"laser {laser + 1} ({RIG.lasers[laser].name}) is off by" in verdict.sentence()


@pytest.mark.parametrize("laser", [0, 1, 2])
def test_a_laser_that_was_pushed_aside_is_off_by_millimetres(laser: int) -> None:
    name = RIG.lasers[laser].name
    pushed = rig_moved_by(RIG, (f"{name}:offset",), np.array([0.005]))
    sentence = verdict_on(RIG, scans(pushed, RIG)).sentence()
    assert re.search(rf"laser {laser + 1} \({name}\) is off by (4\.\d|5|5\.\d) mm", sentence)


@pytest.mark.parametrize(("laser", "towards"), [(0, 0.0), (1, 0.0), (2, 1.57)])
def test_a_tenth_of_a_degree_is_seen_where_it_matters(laser: int, towards: float) -> None:
    verdict = verdict_on(RIG, scans(turned(RIG, laser, 0.1, towards), RIG))
    assert verdict.suspects == (laser,)
    assert verdict.effect > 0.005


def test_a_drift_too_small_to_matter_is_no_alarm() -> None:
    assert verdict_on(RIG, scans(turned(RIG, 0, 0.03), RIG)).state is AgreementState.AGREE


@pytest.mark.parametrize("target", [swinging, still])
@pytest.mark.parametrize(
    "form",
    part_of(
        [
            {"curvature_x": 0.1},
            {"curvature_x": 0.5},
            {"curvature_x": 2.0},
            {"curvature_z": -1.0},
            {"curvature_x": -0.2, "curvature_z": 0.2},
            {"curvature_x": 0.3, "curvature_z": 0.3},
            {"twist": 0.5},
            {"twist": 0.1},
        ]
    ),
    ids=str,
)
@pytest.mark.parametrize("rig", [RIG, bluerov2_rig()], ids=lambda rig: rig.name)
def test_a_bent_target_is_no_alarm(
    rig: Rig, target: Callable[..., Target], form: dict[str, float]
) -> None:
    verdict = verdict_on(rig, scans(rig, rig, target, **form))
    assert verdict.state in (AgreementState.AGREE, AgreementState.NOT_FLAT)
    assert verdict.sentence() == ""


def test_a_drift_is_seen_on_a_slightly_bent_target() -> None:
    frames = scans(turned(RIG, 1, 0.4), RIG, curvature_x=0.2, curvature_z=0.1)
    verdict = verdict_on(RIG, frames)
    assert verdict.suspects == (1,)
    assert np.rad2deg(verdict.angle) == pytest.approx(0.4, abs=0.1)


def test_a_fisheye_that_does_not_fill_its_picture_is_no_bent_target() -> None:
    width, height = RIG.size_px
    lens = Lens(model=LensModel.FISHEYE, fx=140.0, fy=140.0, cx=0.5 * width, cy=0.5 * height)
    wide = replace(RIG, lens=lens)
    assert not wide.camera().rays(np.zeros((1, 2))).valid.any()
    assert verdict_on(wide, scans(wide, wide)).state is AgreementState.AGREE
    verdict = verdict_on(wide, scans(turned(wide, 1, 1.0), wide))
    assert verdict.state is AgreementState.DRIFTED
    assert verdict.suspects == (1,)


def zoomed(rig: Rig, zoom: float) -> Rig:
    lens = replace(rig.lens, fx=rig.lens.fx * (1.0 + zoom), fy=rig.lens.fy * (1.0 + zoom))
    return replace(rig, lens=lens)


@pytest.mark.parametrize("rig", [RIG, bluerov2_rig()], ids=lambda rig: rig.name)
@pytest.mark.parametrize("target", [swinging, still])
@pytest.mark.parametrize("zoom", [-0.05, 0.03, 0.1])
def test_a_zoomed_picture_is_no_fault_of_the_lasers(
    rig: Rig, target: Callable[..., Target], zoom: float
) -> None:
    verdict = verdict_on(rig, scans(zoomed(rig, zoom), rig, target))
    assert verdict.zoom == pytest.approx(zoom, abs=0.01)
    larger = "larger" if zoom > 0.0 else "smaller"
    assert f"% {larger} than the rig's calibration predicts: set zoom, " in verdict.sentence()
    assert verdict.state is AgreementState.ZOOMED
    assert verdict.suspects == ()
    found = verdict.to_dict()
    assert found["zoom_percent"] == pytest.approx(100.0 * zoom, abs=1.0)
    assert found["words"] == verdict.sentence()


def test_software_zooms_about_the_middle_of_the_picture() -> None:
    """By 4 %: the principal point, 9 px away, moves by 0.4 px, which would be a laser's turn."""
    width, height = RIG.size_px
    middle = np.array([0.5 * (width - 1), 0.5 * (height - 1)])
    lens = zoomed(RIG, 0.04).lens
    cx, cy = middle + 1.04 * (np.array([lens.cx, lens.cy]) - middle)
    verdict = verdict_on(RIG, scans(replace(RIG, lens=replace(lens, cx=cx, cy=cy)), RIG))
    assert verdict.state is AgreementState.ZOOMED
    assert verdict.zoom == pytest.approx(0.04, abs=0.003)


def test_a_zoom_that_the_calibration_leaves_open_is_no_alarm() -> None:
    for share, state in ((1e-3, AgreementState.ZOOMED), (1e-2, AgreementState.AGREE)):
        known = RigUncertainty.independent({"fx": share * RIG.lens.fx, "fy": share * RIG.lens.fy})
        rig = with_uncertainty(RIG, known)
        assert verdict_on(rig, scans(zoomed(rig, 0.03), rig)).state is state
    assert verdict_on(RIG, scans(zoomed(RIG, 0.005), RIG)).state is AgreementState.AGREE


def test_a_laser_that_may_have_moved_as_a_zoom_moves_it_is_named_beside_the_zoom() -> None:
    rig = bluerov2_rig()
    verdict = verdict_on(rig, scans(turned(rig, 0, 0.2), rig))
    assert verdict.state is AgreementState.DISAGREE
    assert verdict.suspects == (0,)
    assert "laser 1 (lower) is off by" in verdict.sentence()
    assert (
        " or so (recalibrate with 'aqualvs calibrate lasers'), or the picture is "
        in verdict.sentence()
    )


def test_the_sigma_of_a_zoom_is_that_of_drawn_rigs() -> None:
    names = [f"{laser.name}:{tilt}" for laser in RIG.lasers for tilt in ("tilt_1", "tilt_2")]
    rig = with_uncertainty(RIG, RigUncertainty.independent(dict.fromkeys(names, 1e-3)))
    agreement, rng, z = LaserAgreement(rig), np.random.default_rng(3), []
    along_x = np.array([band.axis is SearchAxis.ALONG_X for band in plan_bands(rig, rig.camera())])
    for _ in range(12):
        drawn = rig_moved_by(rig, tuple(names), rng.normal(0.0, 1e-3, len(names)))
        diver = Diver(drawn, rig)
        middles = []
        for i in range(0, N_FRAMES, 3):
            scan = diver.scan(swinging(i), index=i)
            assert scan.posture
            m = scan.posture.normal_in_dome / scan.posture.range
            middles.append(bin_stripes(scan.points, m, along_x.astype(np.int64), rig.size_px))
        found = fit_zoom(middles, rig, along_x.astype(np.int64), sheets_of(rig))
        z.append(found.zoom / np.sqrt(agreement.covariance(found, middles)[0, 0]))
    # Of 12 values, with a probability of 99 %.
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 1.55


def test_of_two_lasers_either_may_have_moved() -> None:
    two = replace(RIG, lasers=RIG.lasers[:2])
    verdict = verdict_on(two, scans(turned(two, 0, 0.4), two))
    assert verdict.state is AgreementState.DISAGREE
    assert set(verdict.suspects) == {0, 1}
    assert "(lower)" in verdict.sentence()
    assert " or laser " in verdict.sentence()
    assert verdict_on(two, scans(two, two)).state is AgreementState.AGREE


def test_what_the_calibration_leaves_open_is_no_alarm() -> None:
    """0.15 degrees, to one that knows its lasers to 0.0006 and to one that does to 0.06."""
    for sigma, state in ((1e-5, AgreementState.DRIFTED), (1e-3, AgreementState.AGREE)):
        sigmas = {f"{laser.name}:tilt_1": sigma for laser in RIG.lasers}
        rig = with_uncertainty(RIG, RigUncertainty.independent(sigmas))
        assert verdict_on(rig, scans(turned(rig, 0, 0.15), rig)).state is state


def test_few_frames_are_not_enough() -> None:
    agreement = LaserAgreement(RIG)
    assert agreement.verdict().state is AgreementState.NOT_CHECKED
    drifted = turned(RIG, 0, 0.4)
    for scan in scans(drifted, RIG):
        agreement.add(replace(scan, posture=Refusal(Reason.NO_TARGET)))
    assert agreement.verdict() == AgreementVerdict(AgreementState.NOT_CHECKED, 0)


def test_a_stripe_that_is_not_there_is_not_missed() -> None:
    two_of_three = (
        replace(scan, points=_without(scan, laser=2)) for scan in scans(turned(RIG, 0, 0.4), RIG)
    )
    assert verdict_on(RIG, two_of_three).state is AgreementState.NOT_CHECKED


def _without(scan: Scan, laser: int) -> ScanPoints:
    points = scan.points
    kept = points.laser != laser
    return ScanPoints(*(getattr(points, item.name)[kept] for item in fields(points)))


def test_long_dives_stay_small() -> None:
    agreement = LaserAgreement(RIG)
    frames = list(scans(RIG, RIG))
    for round_ in range(40):
        for scan in frames:
            agreement.add(replace(scan, index=scan.index + round_ * len(frames)))
    assert 12 <= agreement.verdict().n_frames <= 24


def test_pieces_of_stripe_ignore_what_lies_beside() -> None:
    """Half of each piece belongs to the stripe at least; the rest is a fish in front of it."""
    diver = Diver(RIG, RIG)
    scan = diver.scan(Target(0.6), noise_px=0.0)
    assert scan.posture
    m = scan.posture.normal_in_dome / scan.posture.range
    clean = bin_stripes(scan.points, m, diver.along_x, RIG.size_px)
    assert clean.shape == (3, N_BINS, 2)
    rng = np.random.default_rng(2)
    fish = rng.random(len(scan.points)) < 0.25
    points = scan.points.points_in_dome.copy()
    points[fish] *= 0.9
    pixels = scan.points.pixels.copy()
    pixels[fish] += 20.0
    spoilt = replace(scan.points, points_in_dome=points, pixels=pixels)
    found = bin_stripes(spoilt, m, diver.along_x, RIG.size_px)
    both = np.isfinite(clean) & np.isfinite(found)
    assert both.sum() > 0.8 * np.isfinite(clean).sum()
    # Along the stripe the middle moves with the points that are left; across it, by its slope.
    slope = np.abs(found - clean)[both]
    assert np.median(slope) < 1.0
    assert slope.max() < 10.0
