"""`aqualvs check rig.yaml`: is this rig sane, and what can it measure? In words."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from aqualvs.app.check_accuracy import N_POINTS, SIGMA_PX, Accuracy, expect, index_sigma
from aqualvs.app.check_stripes import StripeView, blind_fraction, field_of_view, see_stripe
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import Laser, Rig
from aqualvs.optics.rigfile import load_rig

EXIT_SANE, EXIT_BAD = 0, 2

_USUAL_RANGES = (0.3, 0.6, 1.0)
_N_RANGES = 43


class Severity(StrEnum):
    """How much a finding matters."""

    OK = "ok"
    WARN = "warn"
    BAD = "bad"
    """Makes the rig useless as it is."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing found about a rig.

    Attributes
    ----------
    severity : Severity
    sentence : str
        What was found, with the value, and the remedy where one is needed.
    """

    severity: Severity
    sentence: str


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
    findings = check_rig(rig)
    console.print(f"{path}: rig '{rig.name}'", style="bold", markup=False, highlight=False)
    console.print(_findings_table(findings))
    if rig.lasers:
        console.print(_accuracy_table(rig))
    bad = any(finding.severity is Severity.BAD for finding in findings)
    console.print(_verdict(findings), style="bold red" if bad else "bold", highlight=False)
    return EXIT_BAD if bad else EXIT_SANE


def check_rig(rig: Rig) -> list[Finding]:
    """Return everything worth saying about a rig, in the order in which light passes it."""
    camera = rig.camera()
    return [
        *_check_lens(rig),
        *_check_view(rig, camera),
        _check_water(rig),
        _check_index(rig),
        *_check_lasers(rig, camera),
        *(_check_pair(a, b) for a, b in itertools.combinations(rig.lasers, 2)),
        *(_check_accuracy(accuracy) for accuracy in _accuracies(rig)),
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
    views = [see_stripe(camera, laser.plane, float(wall)) for wall in walls]
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


def _accuracies(rig: Rig) -> list[Accuracy]:
    near, far = rig.working_range
    inside = [wall for wall in _USUAL_RANGES if near <= wall <= far]
    return [expect(rig, wall) for wall in inside or [near, far]] if len(rig.lasers) > 1 else []


def _check_accuracy(accuracy: Accuracy) -> Finding:
    place = f"At {accuracy.wall_range * 1e3:.0f} mm"
    if not accuracy.valid:
        return Finding(
            Severity.WARN, f"{place} the stripes in the picture do not determine a plane."
        )
    range_mm = accuracy.sigma_range * 1e3
    pitch, yaw = math.degrees(accuracy.sigma_pitch), math.degrees(accuracy.sigma_yaw)
    sentence = (
        f"{place} noise of {SIGMA_PX} px alone gives a standard deviation of {range_mm:.2g} mm in "
        f"range, {pitch:.2g} degrees in pitch and {yaw:.2g} in yaw"
    )
    if range_mm > 0.01e3 * accuracy.wall_range or max(pitch, yaw) > 1.0:
        return Finding(
            Severity.WARN, f"{sentence}; put the lasers farther from the camera or across."
        )
    return Finding(Severity.OK, f"{sentence}.")


def _findings_table(findings: Sequence[Finding]) -> Table:
    style = {Severity.OK: "green", Severity.WARN: "yellow", Severity.BAD: "bold red"}
    table = Table(box=None, show_header=False, padding=(0, 1))
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for finding in findings:
        mark = style[finding.severity]
        table.add_row(f"[{mark}]{finding.severity.value}[/]", _escaped(finding.sentence))
    return table


def _accuracy_table(rig: Rig) -> Table:
    table = Table(
        title=f"A wall ahead, {SIGMA_PX} px on {N_POINTS} points a laser",
        title_justify="left",
        box=None,
    )
    table.add_column("range mm", justify="right")
    for laser in rig.lasers:
        table.add_column(f"{_escaped(laser.name)} mm/px", justify="right")
    for name in ("sigma range mm", "sigma pitch deg", "sigma yaw deg"):
        table.add_column(name, justify="right")
    for accuracy in _accuracies(rig):
        sigmas = (
            accuracy.sigma_range * 1e3,
            math.degrees(accuracy.sigma_pitch),
            math.degrees(accuracy.sigma_yaw),
        )
        cells = [value * 1e3 for value in accuracy.per_pixel] + list(sigmas)
        table.add_row(f"{accuracy.wall_range * 1e3:.0f}", *map(_shown, cells))
    return table


def _shown(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3g}"


def _escaped(text: str) -> str:
    return text.replace("[", r"\[")


def _verdict(findings: Sequence[Finding]) -> str:
    count = {s: sum(finding.severity is s for finding in findings) for s in Severity}
    if count[Severity.BAD]:
        return f"This rig cannot measure as it is: mend {_number(count[Severity.BAD])}."
    if count[Severity.WARN]:
        return f"This rig is sane, with {_number(count[Severity.WARN], 'warning')}."
    return "This rig is sane."


def _number(n: int, word: str = "fault") -> str:
    return f"{n} {word}" if n == 1 else f"{n} {word}s"
