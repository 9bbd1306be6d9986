"""Findings of `aqualvs check`, one sentence each, and the expected errors of a rig.

The accuracy part predicts, in sentences and tables, the standard deviations of the posture to a
wall ahead, from noise and from the uncertainty of the rig, and that of the water's index.
"""

import math
from collections.abc import Iterator, Sequence

import numpy as np
from rich.table import Table

from aqualvs.calibration.water_index.filter import MIN_POINTS, FrameCorners, IndexModel, believe
from aqualvs.calibration.water_index.state import IndexOptions, first_state
from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.expected_error import (
    N_POINTS,
    SIGMA_PX,
    USUAL_RANGES,
    ExpectedError,
    WallView,
    expected_posture_errors,
    in_mm_and_degrees,
)
from aqualvs.optics.rig import Laser, Rig, RigUncertainty
from aqualvs.optics.shutter import ShutterKind
from aqualvs.text import Finding, Severity


def findings_table(findings: Sequence[Finding]) -> Table:
    """Return the findings as a table for a terminal, one row each."""
    style = {Severity.OK: "green", Severity.WARN: "yellow", Severity.BAD: "bold red"}
    table = Table(box=None, show_header=False, padding=(0, 1))
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for finding in findings:
        mark = style[finding.severity]
        table.add_row(f"[{mark}]{finding.severity.value}[/]", escaped(finding.sentence))
    return table


def number_table(title: str | None, *columns: str, texts: Sequence[str] = ()) -> Table:
    """Return an empty table; columns in `texts` are left-justified, others right-justified."""
    table = Table(title=title, title_justify="left", box=None)
    for name in columns:
        table.add_column(name, justify="left" if name in texts else "right")
    return table


def escaped(text: str) -> str:
    """Return text in which Rich does not take square brackets for markup."""
    return text.replace("[", r"\[")


def share_plane(one: Laser, other: Laser) -> bool:
    """Return whether two laser planes differ by less than 1 degree and 5 mm."""
    cosine = float(one.plane.normal @ other.plane.normal)
    shift = one.plane.offset - math.copysign(1.0, cosine) * other.plane.offset
    max_tilt, max_shift_m = math.radians(1.0), 5e-3
    return abs(cosine) > math.cos(max_tilt) and abs(shift) < max_shift_m


def expected_errors(rig: Rig, uncertainty: RigUncertainty) -> tuple[ExpectedError, ...]:
    """Return the expected errors at the usual ranges within the working range, else at its ends.

    Empty for a rig with fewer than two lasers, which measures no posture.
    """
    if len(rig.lasers) < 2:
        return ()
    near, far = rig.working_range
    inside = [wall for wall in USUAL_RANGES if near <= wall <= far]
    return expected_posture_errors(rig, uncertainty, inside or [near, far])


def check_errors(errors: Sequence[ExpectedError]) -> Iterator[Finding]:
    """Yield findings on the errors at each range, from noise and from the rig's uncertainty."""
    for expected in errors:
        place = f"At {expected.wall_range * 1e3:.0f} mm"
        if not expected.valid:
            yield Finding.warn(f"{place} the stripes in the picture do not determine a plane.")
            continue
        yield _noise_finding(expected, place)
        yield _calibration_finding(expected, place)


def _noise_finding(expected: ExpectedError, place: str) -> Finding:
    range_mm, pitch, yaw = in_mm_and_degrees(expected.sigma_noise)
    sentence = (
        f"{place} noise of {SIGMA_PX} px alone gives a standard deviation of {range_mm:.2g} mm in "
        f"range, {pitch:.2g} degrees in pitch and {yaw:.2g} in yaw"
    )
    if range_mm > 0.01e3 * expected.wall_range or max(pitch, yaw) > 1.0:
        return Finding.warn(f"{sentence}; put the lasers farther from the camera or across.")
    return Finding.ok(f"{sentence}.")


def _calibration_finding(expected: ExpectedError, place: str) -> Finding:
    range_mm, pitch, yaw = in_mm_and_degrees(expected.sigma_calibration)
    share = 1e-3 * range_mm / expected.wall_range
    sentence = (
        f"{place} the uncertainty of the rig leaves a systematic error of {range_mm:.2g} mm "
        f"({share:.2%}) in range, {pitch:.2g} degrees in pitch and {yaw:.2g} in yaw (one sigma)"
    )
    # Systematic errors that a user should know of before the dive.
    large_share, large_angle_deg = 0.005, 0.5
    if share > large_share or max(pitch, yaw) > large_angle_deg:
        return Finding.warn(
            f"{sentence}, more than {large_share:.1%} or {large_angle_deg} degrees; calibrate "
            "what is only assumed, or again with more pictures, nearer and farther ones."
        )
    return Finding.ok(f"{sentence}.")


def sensitivity_table(rig: Rig, errors: Sequence[ExpectedError]) -> Table:
    """Return the table of the range error for one pixel across each laser's stripe."""
    names = [f"{escaped(laser.name)} mm/px" for laser in rig.lasers]
    table = number_table("Range error for a pixel", "range mm", *names)
    for expected in errors:
        cells = (_cell(value * 1e3) for value in expected.per_pixel)
        table.add_row(f"{expected.wall_range * 1e3:.0f}", *cells)
    return table


def error_table(errors: Sequence[ExpectedError]) -> Table:
    """Return the table of the standard deviations of the posture to a wall ahead, by cause."""
    title = f"Expected error, one sigma: a wall ahead, {SIGMA_PX} px on {N_POINTS} points a laser"
    names = ("range mm", "from", "range mm", "range %", "pitch deg", "yaw deg")
    table = number_table(title, *names, texts=["from"])
    for expected in errors:
        rows = {
            "rig": expected.sigma_calibration,
            "pixel noise": expected.sigma_noise,
            "both": expected.sigma,
        }
        for i, (name, sigmas) in enumerate(rows.items()):
            range_mm, pitch, yaw = in_mm_and_degrees(sigmas)
            share = 0.1 * range_mm / expected.wall_range
            place = "" if i else f"{expected.wall_range * 1e3:.0f}"
            table.add_row(place, name, *map(_cell, (range_mm, share, pitch, yaw)))
    return table


def error_text(errors: Sequence[ExpectedError]) -> Iterator[str]:
    """Yield one sentence on the errors at the middle one of the ranges, if it is valid."""
    if not errors or not errors[len(errors) // 2].valid:
        return
    middle = errors[len(errors) // 2]
    range_mm, pitch, yaw = in_mm_and_degrees(middle.sigma)
    share = 1e-3 * range_mm / middle.wall_range
    yield (
        f"At {middle.wall_range * 1e3:.0f} mm expect errors of {range_mm:.2g} mm ({share:.2%}) in "
        f"range, {pitch:.2g} degrees in pitch and {yaw:.2g} in yaw (one sigma)."
    )


def index_sigma(rig: Rig) -> float:
    """Return the sigma of the water's index from a known target, infinite if not observable.

    The target is a plate of 10 by 6 corners, 180 by 100 mm, at a known position 0.4 m ahead, with
    each corner detected to `SIGMA_PX`: like an index target on the vehicle in one picture. Rig and
    position count as exact; `index_sigma_of_step` does not take them so.
    """
    if rig.housing is None:
        return np.inf
    corners = _plate()
    index_step = 1e-4
    stepped, seen_stepped = rig.in_water(rig.n_water + index_step).camera().project(corners)
    here, seen = rig.camera().project(corners)
    slope = (stepped - here)[seen & seen_stepped] / index_step
    information = float(np.sum(slope**2)) / SIGMA_PX**2
    return 1.0 / np.sqrt(information) if information > 0.0 else np.inf


def index_sigma_of_step(rig: Rig, uncertainty: RigUncertainty, options: IndexOptions) -> float:
    """Return the sigma that `calibrate water` gives the index by one picture of such a target.

    `rig` has a housing, `uncertainty` is its, and `options` have that of the target's position.
    Infinite if the camera sees too little of the target.
    """
    points = _plate()
    pixels, seen = rig.camera().project(points)
    if np.count_nonzero(seen) < MIN_POINTS:
        return np.inf
    ids = tuple(np.flatnonzero(seen).tolist())
    frame = FrameCorners(0.0, ids, points[seen], pixels[seen])
    model = IndexModel(rig, uncertainty, options, frame.points.mean(axis=0))
    camera = uncertainty.of(model.camera_names)
    state = first_state(0.0, rig.n_water, options.pose_sigmas, camera)
    state = state.with_corners(ids, options.sigma_corner_px)
    return believe(model, state, frame, SIGMA_PX).state.sigma


def _plate() -> FloatArray:
    x, z = np.meshgrid(np.linspace(-0.09, 0.09, 10), np.linspace(-0.05, 0.05, 6))
    return np.stack([x, np.full_like(x, 0.4), z], axis=-1).reshape(-1, 3)


def _cell(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3g}"


# Speed (m/s) and rate of turn (rad/s) at which errors by the shutter are stated: those of a small
# vehicle near a net in waves.
_SPEED, _TURN = 0.2, math.radians(15.0)


def shutter_finding(rig: Rig) -> Finding | None:
    """Return the effect of a rig's shutter on a moving vehicle; None if the rig states none."""
    shutter = rig.shutter
    if shutter.instant:
        return None
    rates = f"At {_SPEED:g} m/s and {math.degrees(_TURN):.0f} degrees/s"
    blur = ""
    if shutter.exposure > 0.0:
        pixels = rig.focal_px * _TURN * shutter.exposure
        blur = f"an exposure of {1e3 * shutter.exposure:g} ms blurs a net over {pixels:.1f} px"
    if shutter.kind is ShutterKind.GLOBAL:
        return Finding.ok(f"The shutter exposes all rows at once. {rates} {blur}.")
    blur = f"; {blur}" if blur else ""
    apart = 1e3 * abs(shutter.readout)
    if shutter.is_interlaced:
        return Finding.ok(
            f"The video is interlaced, its fields {apart:g} ms apart. {rates} the target moves by "
            f"{_SPEED * apart:.1f} mm and {math.degrees(_TURN) * shutter.readout:.2f} degrees "
            f"({rig.focal_px * _TURN * shutter.readout:.1f} px) between them{blur}. Each field is "
            "measured by itself: twice as many postures, each of half the rows."
        )
    order = "first row to the last" if shutter.readout > 0.0 else "last row to the first"
    return Finding.ok(
        f"The shutter rolls, {apart:g} ms from the {order}. {rates} "
        f"{_rolling_error(rig)}{blur}. The frames beside it correct that."
    )


def _rolling_error(rig: Rig) -> str:
    """Return a clause on the largest errors on a wall in the middle of the working range."""
    wall = WallView.ahead(rig, math.sqrt(math.prod(rig.working_range)))
    by_rates = wall.by_rates(lambda rows: rig.shutter.row_times(rows, rig.size_px[1]))
    if not np.isfinite(by_rates).all():
        apart = math.degrees(_TURN) * abs(rig.shutter.readout)
        return f"its rows see a target {apart:.2f} degrees apart"
    away, pitch, yaw = np.abs(by_rates) @ [_SPEED, _TURN, _TURN]
    return (
        f"one frame reads a wall at {1e3 * wall.wall_range:.0f} mm up to {1e3 * away:.1f} mm and "
        f"{math.degrees(max(pitch, yaw)):.2f} degrees off"
    )
