"""`aqualvs check rig.yaml`: is this rig sane, and what can it measure? In words."""

import itertools
import math
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from rich.console import Console

from aqualvs.app.check_accuracy import (
    check_errors,
    error_table,
    expected_errors,
    index_sigma,
    sensitivity_table,
)
from aqualvs.app.check_finding import Finding, Severity, count_words, findings_table
from aqualvs.app.check_solved import check_solved
from aqualvs.app.check_view import blind_fraction, field_of_view
from aqualvs.errors import RigError
from aqualvs.optics.assumed import completed_uncertainty
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import Laser, Rig
from aqualvs.optics.rigfile import load_rig
from aqualvs.optics.sheet import sheet_in
from aqualvs.optics.solved import rig_uncertainty, solved_steps
from aqualvs.optics.stripe_view import StripeView, see_stripe

EXIT_SANE, EXIT_BAD = 0, 2

_N_RANGES = 43


def run_check(path: Path, console: Console | None = None) -> int:
    """Check a rig file, print what was found, and return the exit code.

    Returns
    -------
    int
        0 where the rig is sane, warnings allowed; 2 where something is bad.

    Raises
    ------
    RigError
        If the file is not a rig file.
    """
    rig = load_rig(path, need_lasers=False)
    console = console or Console()
    try:
        findings = check_rig(rig)
    except RigError as error:
        raise RigError(f"{path}: {error}") from None
    console.print(f"{path}: rig '{rig.name}'", style="bold", markup=False, highlight=False)
    console.print(findings_table(findings))
    errors = expected_errors(rig, completed_uncertainty(rig))
    if errors:
        console.print(sensitivity_table(rig, errors))
        console.print(error_table(errors))
    bad = any(finding.severity is Severity.BAD for finding in findings)
    console.print(_verdict(findings), style="bold red" if bad else "bold", highlight=False)
    return EXIT_BAD if bad else EXIT_SANE


def check_rig(rig: Rig, now: datetime | None = None) -> list[Finding]:
    """Return everything worth saying about a rig, in the order in which light passes it.

    Parameters
    ----------
    rig : Rig
    now : datetime, optional
        With a time zone; calibrations are as old as it makes them. The computer's clock if left
        out.

    Raises
    ------
    RigError
        If what calibrations have noted down in the rig cannot be understood.
    """
    camera, uncertainty = rig.camera(), rig_uncertainty(rig)
    return [
        *_check_lens(rig),
        *_check_view(rig, camera),
        _check_water(rig),
        _check_index(rig),
        *_check_lasers(rig, camera),
        *(_check_pair(a, b) for a, b in itertools.combinations(rig.lasers, 2)),
        *check_solved(rig, solved_steps(rig), uncertainty, now or datetime.now(UTC)),
        *check_errors(expected_errors(rig, completed_uncertainty(rig))),
    ]


def _check_lens(rig: Rig) -> Iterator[Finding]:
    distance = float(np.linalg.norm(rig.dome_from_cam.translation))
    if rig.dome is None:
        yield Finding(Severity.WARN, "There is no dome: rays start at the lens, in the water.")
    else:
        gap = rig.dome.inner_radius - distance
        if gap <= 0.0:
            yield Finding(
                Severity.BAD,
                f"The lens lies {distance * 1e3:.1f} mm from the dome's centre, outside the inner "
                f"radius of {rig.dome.inner_radius * 1e3:g} mm; correct camera.position_mm.",
            )
        else:
            yield Finding(
                Severity.OK,
                f"The lens lies {distance * 1e3:.1f} mm from the dome's centre, "
                f"{gap * 1e3:.1f} mm inside the dome.",
            )
    width, height = rig.size_px
    across, down = (rig.lens.cx + 0.5) / width, (rig.lens.cy + 0.5) / height
    if not (0.25 < across < 0.75 and 0.25 < down < 0.75):
        yield Finding(
            Severity.WARN,
            f"The image centre ({rig.lens.cx:.0f}, {rig.lens.cy:.0f}) px is far from the middle of "
            f"a {width}x{height} picture; was the camera calibrated at this size?",
        )
    ratio = rig.lens.fx / rig.lens.fy
    if not 0.8 < ratio < 1.25:
        yield Finding(
            Severity.WARN,
            f"The focal lengths {rig.lens.fx:.0f} and {rig.lens.fy:.0f} px differ by more than "
            "pixels usually do; was the camera calibrated at this size?",
        )


def _check_view(rig: Rig, camera: Camera) -> Iterator[Finding]:
    axis = rig.dome_from_cam.rotation[:, 2]
    off = math.degrees(math.acos(min(max(float(axis[1]), -1.0), 1.0)))
    if off >= 90.0:
        yield Finding(
            Severity.BAD,
            f"The camera looks {off:.0f} degrees away from forward (the dome's y axis); correct "
            "camera.rotation_deg.",
        )
    elif off > 30.0:
        yield Finding(
            Severity.WARN,
            f"The camera looks {off:.0f} degrees away from forward (the dome's y axis); posture is "
            "measured against the dome's axes.",
        )
    across, down = (math.degrees(angle) for angle in field_of_view(camera))
    blind = blind_fraction(camera)
    if math.isnan(across) or math.isnan(down) or blind > 0.0:
        yield Finding(
            Severity.WARN,
            f"{blind:.0%} of the picture sees no water: the lens model ends or the dome reflects "
            "there; check camera.distortion and the dome.",
        )
    else:
        yield Finding(
            Severity.OK, f"The field of view in the water is {across:.0f} by {down:.0f} degrees."
        )


def _check_water(rig: Rig) -> Finding:
    n = rig.n_water
    if 1.32 <= n <= 1.36:
        return Finding(Severity.OK, f"The water's index {n:.4f} is that of {_water_name(n)}.")
    if abs(n - rig.n_air) < 1e-3:
        return Finding(
            Severity.WARN, f"The water's index {n:.4f} is that of air: this rig is for the bench."
        )
    return Finding(
        Severity.BAD,
        f"The water's index {n:.4f} is not that of water, which has 1.330 to 1.345 for green "
        "light; correct water.n, or give temperature_c and salinity_permille.",
    )


def _water_name(n: float) -> str:
    # Quan & Fry at 532 nm: fresh 1.334 to 1.336, sea (35 per mille) 1.340 to 1.343.
    if 1.330 <= n < 1.3375:
        return "fresh water"
    return "sea water" if 1.3375 <= n <= 1.345 else "no usual water, but possible"


def _check_index(rig: Rig) -> Finding:
    sigma = index_sigma(rig)
    if sigma < 5e-4:
        return Finding(
            Severity.OK,
            f"The lens is far enough from the dome's centre to see the water's index: one picture "
            f"of a known target gives it to {sigma:.1g}.",
        )
    if rig.dome is None:
        return Finding(Severity.OK, "Without a dome the water's index does not enter.")
    seen = "not at all" if sigma > 0.1 else f"only to {sigma:.1g}"
    return Finding(
        Severity.OK,
        f"This lens, so near the dome's centre, can see the water's index {seen}; give it by "
        "temperature and salinity. It matters as little to the range.",
    )


def _check_lasers(rig: Rig, camera: Camera) -> Iterator[Finding]:
    if not rig.lasers:
        yield Finding(
            Severity.BAD, "There are no lasers; run 'aqualvs calibrate lasers' or write them."
        )
    if len(rig.lasers) == 1:
        yield Finding(
            Severity.WARN,
            "One laser draws one line on a target: points, but no pitch and yaw; add a second.",
        )
    for laser in rig.lasers:
        yield _check_laser(rig, camera, laser)


def _check_laser(rig: Rig, camera: Camera, laser: Laser) -> Finding:
    near, far = rig.working_range
    walls = np.geomspace(near, far, _N_RANGES)
    sheet = sheet_in(laser, rig.n_air, rig.n_water)
    views = [see_stripe(camera, sheet, float(wall)) for wall in walls]
    seen = np.array([view.visible for view in views])
    if not seen.any():
        return Finding(
            Severity.BAD,
            f"Laser '{laser.name}' never crosses the picture between {near * 1e3:.0f} and "
            f"{far * 1e3:.0f} mm; check the sign of its offset_mm and its normal.",
        )
    picked = [i for i in (0, _N_RANGES // 2, _N_RANGES - 1) if seen[i]] or [int(np.argmax(seen))]
    places = ", ".join(_place(float(walls[i]), views[i]) for i in picked)
    if seen.all():
        return Finding(Severity.OK, f"Laser '{laser.name}' crosses the picture {places}.")
    return Finding(
        Severity.WARN,
        f"Laser '{laser.name}' is in the picture only from {walls[seen][0] * 1e3:.0f} to "
        f"{walls[seen][-1] * 1e3:.0f} mm of the working range {near * 1e3:.0f} to "
        f"{far * 1e3:.0f} mm: {places}.",
    )


def _place(wall: float, view: StripeView) -> str:
    x, y = view.pixels[len(view.pixels) // 2]
    return f"at {wall * 1e3:.0f} mm for {view.length_px:.0f} px through ({x:.0f}, {y:.0f})"


def _check_pair(a: Laser, b: Laser) -> Finding:
    cosine = float(a.plane.normal @ b.plane.normal)
    angle = math.degrees(math.acos(min(abs(cosine), 1.0)))
    pair = f"Lasers '{a.name}' and '{b.name}'"
    apart = abs(a.plane.offset - math.copysign(1.0, cosine) * b.plane.offset)
    if angle < 1.0 and apart < 5e-3:
        return Finding(
            Severity.BAD, f"{pair} lie in one plane, so the two draw one line; check their normals."
        )
    if angle < 15.0:
        return Finding(
            Severity.WARN,
            f"{pair} meet at {angle:.0f} degrees only: tilt across their stripes is told by the "
            "distance between them alone.",
        )
    return Finding(Severity.OK, f"{pair} meet at {angle:.0f} degrees.")


def _verdict(findings: Sequence[Finding]) -> str:
    count = {s: sum(finding.severity is s for finding in findings) for s in Severity}
    if count[Severity.BAD]:
        faults = count_words(count[Severity.BAD], "fault")
        return f"This rig cannot measure as it is: mend {faults}."
    if count[Severity.WARN]:
        return f"This rig is sane, with {count_words(count[Severity.WARN], 'warning')}."
    return "This rig is sane."
