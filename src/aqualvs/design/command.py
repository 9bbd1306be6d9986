"""`aqualvs design`: predict what a design measures, and tilt its lasers best."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from aqualvs.design.calibrated import camera_errors, offset_costs
from aqualvs.design.changes import best_angles, changes
from aqualvs.design.file import (
    EXAMPLE,
    FAN_DEG,
    design_from,
    design_of_rig,
    load_design,
    merged_content,
)
from aqualvs.design.judge import predict, together
from aqualvs.design.report import (
    DESIGN_HTML,
    ERRORS_PNG,
    PICTURE_PNG,
    cause_table,
    centring_text,
    change_table,
    draw_figures,
    error_table,
    findings,
    gain_text,
    lasers_table,
    offset_table,
    predict_closely,
    shown_ranges,
    summary,
    verdict,
    write_page,
)
from aqualvs.design.settings import Design
from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import load_rig, save_rig
from aqualvs.report.figure_style import check_matplotlib
from aqualvs.results.files import Claim, writing
from aqualvs.yamlfile import parse_yaml

RIG_YAML = "rig.yaml"


@dataclass(frozen=True, slots=True, kw_only=True)
class DesignRequest:
    """Request of `aqualvs design`, see its `--help`."""

    # A design file, or the file of an existing rig; the example design if neither is given.
    design: Path | None = None
    rig: Path | None = None
    # Output folder.
    out: Path | None = None
    # Replacements of the file's values, see `merged_content`.
    given: Mapping[str, Any] = field(default_factory=dict)
    # Fan angle of an existing rig's lasers.
    fan_deg: float | None = None
    # Whether to optimise the stripes' directions of the tilted lasers, too.
    turn: bool = False
    # Whether to optimise the tilts.
    tilt: bool = True
    # Whether to report changes that would help.
    try_changes: bool = True
    # Whether to replace earlier output of this command in `out`.
    overwrite: bool = False


def run_design(request: DesignRequest) -> None:
    """Evaluate a design and print its predicted errors.

    Raises `AqualvsError` if a file or an option cannot be used, or the folder cannot be written.
    """
    if request.out is not None:
        check_matplotlib("aqualvs design -o")
    output = _Output()
    design = _requested_design(request)
    names = () if request.out is None else (RIG_YAML, ERRORS_PNG, PICTURE_PNG, DESIGN_HTML)
    files = [(request.out or Path()) / name for name in names]
    with Claim("design", files, overwrite=request.overwrite):
        if request.turn:
            turned = [replace(m, free_stripe=m.free_stripe or m.free_tilt) for m in design.mounts]
            design = design.with_mounts(turned)
        best = best_angles(design) if request.tilt else design
        exists = request.rig is not None and request.tilt
        first, fine, by_camera = _print_verdict(output, design, best, exists=exists)
        costs = offset_costs(best, best.rig.working_range)
        if costs:
            words = centring_text(best, costs, best.rig.working_range)
            output(offset_table(costs, best.rig.working_range), *filter(None, [words]))
        # Shares of the errors that a design without a posture has are none.
        if request.try_changes and predict_closely(best).valid.any():
            output(change_table(changes(best)))
        if request.out is not None:
            with writing(request.out):
                save_rig(designed_rig(best), request.out / RIG_YAML)
                pictures = draw_figures(best, by_camera, request.out)
                page = request.out / DESIGN_HTML
                name = best.rig.name
                write_page(page, name, first, output.parts, pictures, fine=fine, tilted=exists)
            for path in (request.out / RIG_YAML, *pictures, page):
                output.say(f"written: {path}")


def _print_verdict(
    output: "_Output", design: Design, best: Design, *, exists: bool
) -> tuple[str, bool, dict[str, FloatArray]]:
    """Print the verdict and the expected errors.

    Returns the verdict, whether the goals are met, and the `camera_errors` of `best`. `exists`: the
    verdict is on `design`, an existing rig, and is followed by that on `best`.
    """
    ranges, square = shown_ranges(best.rig.working_range), "one sigma on a wall or net square ahead"
    by_camera = camera_errors(best, ranges)
    first, fine = verdict(best, by_camera)
    if exists:
        now, tilted = camera_errors(design, ranges), first
        first, fine = verdict(design, now)
        output.say(first, "bold")
        output(f"Its lasers tilted best: {tilted}", *summary(best))
        _print_errors(output, design, now, f"As it is: {square}")
        output(gain_text(design, best))
        _print_errors(output, best, by_camera, f"Tilted best: {square}")
    else:
        output.say(first, "bold")
        output(*summary(best))
        _print_errors(output, best, by_camera, f"Expected error: {square}")
    return first, fine, by_camera


@dataclass(slots=True)
class _Output:
    """Output to the terminal; `parts` collects what the page repeats."""

    console: Console = field(default_factory=Console)
    parts: list[str | Table] = field(default_factory=list)

    def __call__(self, *parts: str | Table) -> None:
        """Print parts that belong together, and keep them for the page."""
        for part in parts:
            self.console.print(part) if isinstance(part, Table) else self.say(part)
        self.console.print()
        self.parts += parts

    def say(self, sentence: str, style: str | None = None) -> None:
        """Print a line that the page does not repeat among its parts."""
        self.console.print(sentence, style=style, markup=False, highlight=False, soft_wrap=True)


def _print_errors(
    output: _Output, design: Design, by_camera: Mapping[str, FloatArray], title: str
) -> None:
    """Print the mounts of the lasers, the errors, and the part of each tolerance."""
    closely = predict_closely(design)
    ranges = shown_ranges(design.rig.working_range)
    found = predict(design, ranges)
    causes = {**by_camera, **found.systematic}
    output(lasers_table(design, closely), *findings(design, closely))
    output(error_table(found, together(causes), title))
    middle = int(np.argmin(np.abs(found.ranges - math.sqrt(math.prod(design.rig.working_range)))))
    output(cause_table(causes, middle, ranges[middle]))


def _requested_design(request: DesignRequest) -> Design:
    """Return the design of the rig file, the design file or the example, with the given values."""
    if request.rig is not None:
        if request.design is not None:
            raise OptionError("give either a design file or --rig, not both")
        if request.given:
            names = ", ".join(request.given)
            raise OptionError(f"--rig: the rig file says {names} itself; change them there")
        return design_of_rig(load_rig(request.rig), request.fan_deg or FAN_DEG)
    if request.design is not None:
        return load_design(request.design, request.given)
    content = merged_content(parse_yaml(EXAMPLE, "the example", OptionError), request.given)
    return design_from(content, name="design", folder=Path())


def designed_rig(design: Design) -> Rig:
    """Return the nominal rig with its lasers, and a note of their mounts."""
    mounts = [
        {
            "name": mount.name,
            "position_mm": [round(value * 1e3, 3) for value in mount.position],
            "stripe_deg": round(math.degrees(mount.stripe), 2),
            "tilt_deg": round(math.degrees(mount.tilt), 2),
            "swing_deg": round(math.degrees(mount.swing), 2),
            "fan_deg": round(math.degrees(mount.fan), 2),
        }
        for mount in design.mounts
    ]
    rig = design.nominal_rig()
    return replace(rig, solved_from={**rig.solved_from, "design": {"mounts": mounts}})
