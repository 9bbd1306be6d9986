"""`aqualvs check rig.yaml`: plausibility of a rig and its expected accuracy, in sentences.

The findings are in the order in which light passes the rig. They include the age, order and quality
of its calibrations, numbers that were assumed or that the calibration did not determine, and the
part of the picture that sees nothing of the outer medium.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from rich.console import Console

from aqualvs.calibration.water_index.state import IndexOptions
from aqualvs.check.finding import (
    check_errors,
    error_table,
    error_text,
    expected_errors,
    findings_table,
    index_sigma,
    index_sigma_of_step,
    sensitivity_table,
    share_plane,
    shutter_finding,
)
from aqualvs.errors import RigError
from aqualvs.geometry.planes import Plane, Rays, exchanged_plane
from aqualvs.optics.camera import POSE_PARAMETERS, Camera
from aqualvs.optics.expected_error import ExpectedError, StripeView, visible_stripe
from aqualvs.optics.rig import Laser, Rig, RigUncertainty, laser_parameter_names
from aqualvs.optics.rigfile import load_rig
from aqualvs.optics.sheet import sheet_in
from aqualvs.optics.solved import (
    ASSUMED,
    SolvedStep,
    assumptions,
    completed_uncertainty,
    is_exact,
    rig_uncertainty,
    solved_steps,
)
from aqualvs.optics.water import may_be_water
from aqualvs.scanning.plane_search import MIN_FACING
from aqualvs.text import Finding, Severity, count_text

SURFACES = "surfaces"
"""Extra of the step `lasers`: the surfaces that the lasers were seen on, or their number."""

# Fewest pictures of a calibration step; 1 for others.
_MIN_PICTURES = {"camera": 5, "dome": 2}
# Sigmas above which a calibration has not determined a parameter: position of the lens, rotation of
# the camera (rad), focal length, index of the water; tilt (rad) and offset of a laser plane.
_LENS_M, _TURN, _FOCAL_SHARE, _INDEX = 2e-3, math.radians(0.5), 0.005, 2e-3
_TILT, _OFFSET_M = math.radians(0.25), 2e-3


def check_solved(
    rig: Rig, steps: dict[str, SolvedStep], uncertainty: RigUncertainty, now: datetime
) -> Iterator[Finding]:
    """Yield findings on the calibration of a rig.

    `steps` are its calibrations, from `solved_steps`, and `now` is the time, with a time zone.
    """
    for name, step in steps.items():
        yield _step_summary(name, step, now)
        yield from _step_warnings(name, step, now)
    yield from _out_of_order(steps)
    yield from _assumed(rig, steps)
    yield from _undetermined(rig, uncertainty)


def age_text(date: datetime, now: datetime) -> str:
    """Return the age of a date as text: "today", "3 days ago", "5 months ago"."""
    days = (now - date).days
    if days < 1:
        return "today"
    for length, word, most in ((1, "day", 14), (7, "week", 60), (30.44, "month", 730)):
        if days < most:
            return f"{count_text(round(days / length), word)} ago"
    return f"{count_text(round(days / 365.25), 'year')} ago"


def _step_summary(name: str, step: SolvedStep, now: datetime) -> Finding:
    """Return a finding on age, size and residual of a calibration step."""
    verb = "were" if name == "lasers" else "was"
    sentence = (
        f"The {name} {verb} calibrated {age_text(step.date, now)} from "
        f"{count_text(step.pictures, 'picture')} with {count_text(step.points, 'point')}, to "
        f"{step.rms_px:.2g} px rms"
    )
    # Good pictures leave 0.05 to 0.2 px for corners, 0.1 to 0.3 for stripes.
    large_rms_px = 1.0
    if step.rms_px > large_rms_px:
        return Finding.warn(
            f"{sentence}: good pictures leave 0.3 px or less; check the board's square size and "
            "the medium, and calibrate again."
        )
    return Finding.ok(f"{sentence}.")


def _step_warnings(name: str, step: SolvedStep, now: datetime) -> Iterator[Finding]:
    """Yield warnings on an implausible, old or too small calibration step."""
    days, old_days = (now - step.date).days, 365
    if days < -1:
        yield Finding.warn(
            f"The date of solved_from.{name}, {step.date:%Y-%m-%d}, is in the future; set the "
            "clock of the computer that calibrates."
        )
    if days > old_days:
        yield Finding.warn(
            f"The calibration of the {name} is more than a year old; take one picture of a known "
            "target, or calibrate again."
        )
    if step.rms_px <= 0.0 and step.points > 0:
        yield Finding.warn(
            f"solved_from.{name}.rms_px is {step.rms_px:g}: no real picture fits that well."
        )
    if step.pictures < _MIN_PICTURES.get(name, 1):
        yield Finding.warn(
            f"The calibration of the {name} used {count_text(step.pictures, 'picture')}; take "
            f"at least {_MIN_PICTURES.get(name, 1)}, at different tilts and distances."
        )
    surfaces = step.extras.get(SURFACES)
    count = len(surfaces) if isinstance(surfaces, list) else surfaces
    if isinstance(count, int | float) and count < 2 and step.pictures < 2:
        yield Finding.warn(
            "The lasers were seen on one surface of one picture only, and any plane through such a "
            "line fits it; show their stripes at two distances at least."
        )


def _out_of_order(steps: dict[str, SolvedStep]) -> Iterator[Finding]:
    """Yield findings on calibration steps that are older than the steps they are based on."""
    chain = [name for name in ("camera", "dome", "lasers") if name in steps]
    for before, after in itertools.pairwise(chain):
        if steps[before].date > steps[after].date:
            verb = "were" if after == "lasers" else "was"
            yield Finding.warn(
                f"The {before} was calibrated after the {after}, which {verb} found with the "
                f"{before} as it was before; run 'aqualvs calibrate {after}' again."
            )


def _assumed(rig: Rig, steps: dict[str, SolvedStep]) -> Iterator[Finding]:
    """Yield findings on parameters without a stated uncertainty, with the assumed sigmas."""
    if is_exact(rig):
        yield Finding.ok(
            "The rig's numbers count as exact (solved_from.uncertainty), as for a simulated dive; "
            "remove that key for a real rig."
        )
    alike: dict[str, list[str]] = {}
    for one in assumptions(rig):
        alike.setdefault(one.words, []).append(f"the {one.what}")
    for words, what in alike.items():
        yield Finding.ok(
            f"No uncertainty is given for {', '.join(what)}; assumed (one sigma): {words}. "
            "'aqualvs calibrate' determines it."
        )
    for name, step in steps.items():
        numbers = step.extras.get(ASSUMED)
        if isinstance(numbers, list) and numbers:
            yield Finding.ok(
                f"The calibration of the {name} assumed an uncertainty for "
                f"{', '.join(map(str, numbers))}, which were written by hand."
            )


def _undetermined(rig: Rig, uncertainty: RigUncertainty) -> Iterator[Finding]:
    """Yield warnings on parameters that the calibration did not determine."""
    lens = _largest(uncertainty, POSE_PARAMETERS[:3])
    turn = _largest(uncertainty, POSE_PARAMETERS[3:])
    focal = _largest(uncertainty, ("fx", "fy")) / rig.focal_px
    index = _largest(uncertainty, ("n_water",))
    tested = [
        (
            lens > _LENS_M,
            f"The position of the lens in the dome is known only to {lens * 1e3:.1f} mm",
            "show the board nearer and in water, or at known distances",
        ),
        (
            turn > _TURN,
            f"The camera's rotation in the dome is known only to {math.degrees(turn):.1f} degrees",
            "give the poses of the boards",
        ),
        (
            focal > _FOCAL_SHARE,
            f"The focal length is known only to {focal:.1%}",
            "show the board tilted, and as large as the picture",
        ),
        (
            index > _INDEX,
            f"The water's index is known only to {index:.1g}",
            "give temperature and salinity",
        ),
    ]
    for laser in rig.lasers:
        tilt_1, tilt_2, offset = laser_parameter_names(laser)[:3]
        tilt, shift = _largest(uncertainty, (tilt_1, tilt_2)), _largest(uncertainty, (offset,))
        fact = f"Laser '{laser.name}' is known only to {math.degrees(tilt):.2g} degrees and "
        fact += f"{shift * 1e3:.2g} mm"
        remedy = "show its stripe on more surfaces, near and far"
        tested.append((tilt > _TILT or shift > _OFFSET_M, fact, remedy))
    for is_large, fact, remedy in tested:
        if is_large:
            yield Finding.warn(f"{fact} (one sigma); {remedy}, and calibrate again.")


def _largest(uncertainty: RigUncertainty, names: tuple[str, ...]) -> float:
    """Return the largest sigma of some parameters in any direction; 0 if none is known."""
    return math.sqrt(max(float(np.linalg.eigvalsh(uncertainty.of(names))[-1]), 0.0))


def field_of_view(camera: Camera) -> tuple[float, float]:
    """Return the horizontal and vertical field of view in the outer medium, in radians.

    NaN if the middle of an edge of the picture sees nothing of it.
    """
    width, height = camera.size_px
    middle_x, middle_y = (width - 1) / 2.0, (height - 1) / 2.0
    ends = [[-0.5, middle_y], [width - 0.5, middle_y], [middle_x, -0.5], [middle_x, height - 0.5]]
    rays = camera.rays(ends)
    return _angle(rays, 0, 1), _angle(rays, 2, 3)


def _angle(rays: Rays, first: int, second: int) -> float:
    cosine = float(rays.directions[first] @ rays.directions[second])
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def run_check(path: Path, console: Console | None = None) -> int:
    """Check a rig file, print the findings, and return the exit code.

    The code is 2 if a finding is bad, else 0, also with warnings. Raises `RigError` if the file is
    not a rig file.
    """
    rig = load_rig(path, need_lasers=False)
    console = console or Console()
    try:
        findings, errors = _checked(rig)
    except RigError as error:
        raise RigError(f"{path}: {error}") from None
    console.print(f"{path}: rig '{rig.name}'", style="bold", markup=False, highlight=False)
    bad = any(finding.severity is Severity.BAD for finding in findings)
    for line in (_verdict(findings), *error_text(errors)):
        console.print(line, style="bold red" if bad else "bold", highlight=False, soft_wrap=True)
    # The worst first; else in the order in which light passes the rig.
    order = (Severity.BAD, Severity.WARN, Severity.OK)
    console.print(findings_table(sorted(findings, key=lambda one: order.index(one.severity))))
    if errors:
        console.print(sensitivity_table(rig, errors))
        console.print(error_table(errors))
    return 2 if bad else 0


def check_rig(rig: Rig, now: datetime | None = None) -> list[Finding]:
    """Return the findings on a rig, in the order in which light passes it.

    `now` is the time, with a time zone, that the age of calibrations refers to; by default the
    computer's clock. Raises `RigError` if the notes of calibrations in the rig are malformed.
    """
    return _checked(rig, now)[0]


def _checked(
    rig: Rig, now: datetime | None = None
) -> tuple[list[Finding], tuple[ExpectedError, ...]]:
    """Return the findings of `check_rig`, and the expected errors that they rest on."""
    camera, uncertainty = rig.camera(), rig_uncertainty(rig)
    completed, shutter = completed_uncertainty(rig), shutter_finding(rig)
    errors = expected_errors(rig, completed)
    findings = [
        *_check_lens(rig),
        *_check_view(rig, camera),
        _check_water(rig),
        _check_index(rig, completed),
        *_check_lasers(rig, camera),
        *_check_pairs(rig.lasers),
        *_check_exchange(rig),
        *([] if shutter is None else [shutter]),
        *check_solved(rig, solved_steps(rig), uncertainty, now or datetime.now(UTC)),
        *check_errors(errors),
    ]
    return findings, errors


def _check_lens(rig: Rig) -> Iterator[Finding]:
    """Yield findings on the lens's position, principal point and focal lengths."""
    distance, port = float(np.linalg.norm(rig.dome_from_cam.translation)), rig.flat_port
    if port is not None:
        tilt = math.degrees(math.acos(math.cos(port.tilt_x) * math.cos(port.tilt_y)))
        yield Finding.ok(
            f"The lens looks through a flat port, {port.distance * 1e3:g} mm ahead, "
            f"{port.thickness * 1e3:g} mm thick and tilted by {tilt:.1f} degrees."
        )
    elif rig.dome is None and rig.is_air(rig.n_water):
        yield Finding.ok("There is no dome and no water: rays start at the lens, in air.")
    elif rig.dome is None:
        yield Finding.warn("There is no dome: rays start at the lens, in the water.")
    elif distance >= rig.dome.inner_radius:
        yield Finding.bad(
            f"The lens lies {distance * 1e3:.1f} mm from the dome's centre, outside the inner "
            f"radius of {rig.dome.inner_radius * 1e3:g} mm; correct camera.position_mm."
        )
    else:
        yield Finding.ok(
            f"The lens lies {distance * 1e3:.1f} mm from the dome's centre, "
            f"{(rig.dome.inner_radius - distance) * 1e3:.1f} mm inside the dome."
        )
    width, height = rig.size_px
    across, down = (rig.lens.cx + 0.5) / width, (rig.lens.cy + 0.5) / height
    if not (0.25 < across < 0.75 and 0.25 < down < 0.75):
        yield Finding.warn(
            f"The principal point ({rig.lens.cx:.0f}, {rig.lens.cy:.0f}) px is far from the middle "
            f"of a {width}x{height} picture; was the camera calibrated at this size?"
        )
    ratio = rig.lens.fx / rig.lens.fy
    if not 0.8 < ratio < 1.25:
        yield Finding.warn(
            f"The focal lengths {rig.lens.fx:.0f} and {rig.lens.fy:.0f} px differ by more than "
            "pixels usually do; was the camera calibrated at this size?"
        )


def _check_view(rig: Rig, camera: Camera) -> Iterator[Finding]:
    """Yield findings on the camera's direction and field of view."""
    axis = rig.dome_from_cam.rotation[:, 2]
    off = math.degrees(math.acos(min(max(float(axis[1]), -1.0), 1.0)))
    if off >= 90.0:
        yield Finding.bad(
            f"The camera looks {off:.0f} degrees away from forward (the dome's y axis); correct "
            "camera.rotation_deg."
        )
    elif off > 30.0:
        yield Finding.warn(
            f"The camera looks {off:.0f} degrees away from forward (the dome's y axis); posture is "
            "measured against the dome's axes."
        )
    across, down = (math.degrees(angle) for angle in field_of_view(camera))
    # Share of pixels, on a grid, that see nothing of the outer medium.
    grid = np.meshgrid(*(np.linspace(0, side - 1, 33) for side in rig.size_px))
    blind = float(np.mean(~camera.rays(np.stack(grid, axis=-1)).valid))
    if math.isnan(across) or math.isnan(down) or blind > 0.0:
        yield Finding.warn(
            f"{blind:.0%} of the picture sees no water: the lens model ends or "
            + ("light misses the flat port " if rig.flat_port else "the dome reflects ")
            + f"there; check camera.distortion and the {'port' if rig.flat_port else 'dome'}."
        )
    else:
        medium = "air" if rig.is_air(rig.n_water) else "the water"
        yield Finding.ok(f"The field of view in {medium} is {across:.0f} by {down:.0f} degrees.")


def _check_water(rig: Rig) -> Finding:
    n = rig.n_water
    if may_be_water(n):
        # Quan & Fry at 532 nm: fresh 1.334 to 1.336, sea (35 per mille) 1.340 to 1.343.
        fresh, sea = 1.330 <= n < 1.3375, 1.3375 <= n <= 1.345
        name = "fresh" if fresh else "sea" if sea else "unusual, but possible,"
        return Finding.ok(f"The water's index {n:.4f} is that of {name} water.")
    if rig.is_air(rig.n_water):
        return Finding(
            Severity.OK if rig.housing is None else Severity.WARN,
            f"The water's index {n:.4f} is that of air: this rig is for the bench.",
        )
    return Finding.bad(
        f"The water's index {n:.4f} is not that of water, which has 1.330 to 1.345 for green "
        "light; correct water.n, or give temperature_c and salinity_permille."
    )


def _check_index(rig: Rig, uncertainty: RigUncertainty) -> Finding:
    """Return a finding on whether the water's index is observable."""
    if rig.housing is None:
        return Finding.ok("Without a dome the water's index does not enter.")
    options = IndexOptions.of_target()
    sigma = index_sigma_of_step(rig, uncertainty, options)
    place_mm, turn_deg = 1e3 * options.sigma_place, math.degrees(options.sigma_turn)
    place = f"a target whose place is known to {place_mm:g} mm and {turn_deg:g} degrees"
    # With rig and target exactly known.
    by_noise, far_enough = index_sigma(rig), 5e-4
    if rig.dome is None:
        lead = "Through a flat port the index is observable"
    elif by_noise < far_enough:
        lead = "The lens is far enough from the dome's centre for the index to be observable"
    else:
        seen = "not at all" if sigma > 0.1 else f"only to {sigma:.2g}"
        return Finding.ok(
            f"The lens is near the dome's centre, where the water's index can be determined {seen} "
            "and hardly affects the range; give temperature and salinity."
        )
    if sigma < options.largest_sigma:
        return Finding.ok(f"{lead}: one picture of {place} gives it to {sigma:.2g}.")
    return Finding.ok(
        f"{lead}, but with this rig's uncertainty one picture of {place} gives it only to "
        f"{sigma:.2g}; give temperature and salinity."
    )


def _check_lasers(rig: Rig, camera: Camera) -> Iterator[Finding]:
    if not rig.lasers:
        yield Finding.bad("There are no lasers; run 'aqualvs calibrate lasers' or write them.")
    if len(rig.lasers) == 1:
        yield Finding.warn(
            "One laser draws one line on a target: points, but no pitch and yaw; add a second."
        )
    for laser in rig.lasers:
        yield from _check_laser(rig, camera, laser)


def _check_laser(rig: Rig, camera: Camera, laser: Laser) -> Iterator[Finding]:
    """Yield findings on how a laser's stripe moves with range, and where it is visible."""
    near, far = rig.working_range
    # Least distance of the plane from the lens, in metres: nearer, one pixel is hundreds of
    # millimetres of range at 0.6 m.
    least_baseline, small_baseline = 1e-3, 10e-3
    baseline = abs(float(laser.plane.normal @ rig.dome_from_cam.translation) - laser.plane.offset)
    if baseline < least_baseline:
        yield Finding.bad(
            f"Laser '{laser.name}' passes the lens at {baseline * 1e3:.2g} mm, so that its stripe "
            "does not move with range; offset_mm is in millimetres."
        )
        return
    if baseline < small_baseline:
        yield Finding.warn(
            f"Laser '{laser.name}' passes the lens at {baseline * 1e3:.2g} mm, so that its stripe "
            "hardly moves with range; turn its line across the way from the lens to the laser."
        )
    n_ranges = 43
    walls = np.geomspace(near, far, n_ranges)
    sheet = sheet_in(laser, rig.n_air, rig.n_water)
    views = [visible_stripe(camera, sheet, float(wall)) for wall in walls]
    seen = np.array([view.visible for view in views])
    if not seen.any():
        yield Finding.bad(
            f"Laser '{laser.name}' never crosses the picture between {near * 1e3:.0f} and "
            f"{far * 1e3:.0f} mm; check the sign of its offset_mm and its normal."
        )
        return
    picked = [i for i in (0, n_ranges // 2, n_ranges - 1) if seen[i]] or [int(np.argmax(seen))]
    places = ", ".join(_place(float(walls[i]), views[i]) for i in picked)
    if seen.all():
        yield Finding.ok(f"Laser '{laser.name}' crosses the picture {places}.")
    else:
        yield Finding.warn(
            f"Laser '{laser.name}' is in the picture only from {walls[seen][0] * 1e3:.0f} to "
            f"{walls[seen][-1] * 1e3:.0f} mm of the working range {near * 1e3:.0f} to "
            f"{far * 1e3:.0f} mm: {places}."
        )


def _place(wall: float, view: StripeView) -> str:
    x, y = view.pixels[len(view.pixels) // 2]
    return f"at {wall * 1e3:.0f} mm for {view.length_px:.0f} px through ({x:.0f}, {y:.0f})"


def _check_pairs(lasers: Sequence[Laser]) -> list[Finding]:
    """Check the angles between lasers; of more than three, report the widest and bad ones only."""
    pairs = list(itertools.combinations(lasers, 2))
    found = [_check_pair(*pair) for pair in pairs]
    if len(lasers) <= 3:
        return found
    widest = max(range(len(pairs)), key=lambda i: _angle_deg(*pairs[i]))
    return [one for i, one in enumerate(found) if i == widest or one.severity is Severity.BAD]


def _angle_deg(a: Laser, b: Laser) -> float:
    return math.degrees(math.acos(min(abs(float(a.plane.normal @ b.plane.normal)), 1.0)))


def _check_pair(a: Laser, b: Laser) -> Finding:
    """Return a finding on the angle between two lasers."""
    angle = _angle_deg(a, b)
    pair = f"Lasers '{a.name}' and '{b.name}'"
    if share_plane(a, b):
        return Finding.bad(
            f"{pair} lie in one plane, so the two draw one line; check their normals."
        )
    if angle < 15.0:
        return Finding.warn(
            f"{pair} meet at only {angle:.0f} degrees: only the distance between their stripes "
            "determines the tilt across them."
        )
    return Finding.ok(f"{pair} meet at {angle:.0f} degrees.")


def _check_exchange(rig: Rig) -> Iterator[Finding]:
    """Yield a finding on walls on which two lasers alone may be taken for each other."""
    if len(rig.lasers) != 2:
        return
    near, far = rig.working_range
    first, second = rig.lasers
    n_ranges = 43
    ahead = np.array([0.0, 1.0, 0.0])
    mixed = []
    for wall in np.geomspace(near, far, n_ranges).tolist():
        other = exchanged_plane(Plane(ahead, wall), first.plane, second.plane)
        if other is not None and near <= other.offset <= far and other.normal[1] >= MIN_FACING:
            mixed.append(wall)
    if mixed:
        yield Finding.warn(
            f"On a wall from {mixed[0] * 1e3:.0f} to {mixed[-1] * 1e3:.0f} mm, lasers "
            f"'{first.name}' and '{second.name}' could each have made the other's stripe, and "
            "frames are refused as ambiguous; aim them so that they do not cross within the "
            "working range, or add a third laser."
        )


def _verdict(findings: Sequence[Finding]) -> str:
    count = {s: sum(finding.severity is s for finding in findings) for s in Severity}
    if count[Severity.BAD]:
        faults = count_text(count[Severity.BAD], "fault")
        return f"This rig cannot measure as it is: correct {faults}."
    if count[Severity.WARN]:
        return f"This rig is sane, with {count_text(count[Severity.WARN], 'warning')}."
    return "This rig is sane."
