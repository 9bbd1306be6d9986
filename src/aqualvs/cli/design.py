"""Signature of `aqualvs design`; the body is imported when the command runs."""

import re
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from aqualvs.cli.command import Overwrite


def design(
    file: Annotated[Path | None, Argument(metavar="[DESIGN]", help="Design file (YAML).")] = None,
    example: Annotated[
        bool, Option("--example", help="Print an example design file and exit.")
    ] = False,
    rig: Annotated[
        Path | None, Option(help="Rig file of an existing rig, instead of a design.")
    ] = None,
    out: Annotated[
        Path | None,
        Option("--out", "-o", help="Folder to write: rig.yaml, design.html and pictures."),
    ] = None,
    image: Annotated[
        str | None, Option(metavar="WIDTHxHEIGHT", help="Size of the picture.")
    ] = None,
    fov_deg: Annotated[float | None, Option(help="Horizontal field of view in air.")] = None,
    dome_mm: Annotated[
        str | None, Option(metavar="RADIUS:THICKNESS", help="Dome: inner radius and thickness.")
    ] = None,
    flat_mm: Annotated[
        str | None,
        Option(
            metavar="DISTANCE:THICKNESS",
            help="Flat port instead of a dome: distance from the lens, and thickness.",
        ),
    ] = None,
    lens_mm: Annotated[
        str | None,
        Option(
            metavar="X,Y,Z",
            help="Position of the lens relative to the dome's centre: right, forward, up.",
        ),
    ] = None,
    baseline_mm: Annotated[
        float | None, Option(help="Distance of the lasers from the dome's centre.")
    ] = None,
    lasers: Annotated[int | None, Option(help="Number of lasers.")] = None,
    fan_deg: Annotated[float | None, Option(help="Fan angle of a laser.")] = None,
    range_mm: Annotated[str | None, Option(metavar="NEAR:FAR", help="Working range.")] = None,
    turn: Annotated[bool, Option("--turn", help="Also optimise the stripes' directions.")] = False,
    tilt: Annotated[bool, Option("--tilt/--no-tilt", help="Optimise the lasers' angles.")] = True,
    changes: Annotated[bool, Option(help="Report which changes would help most.")] = True,
    overwrite: Overwrite = False,
) -> None:
    """Predict what a design measures."""
    from aqualvs.design import command
    from aqualvs.design.file import EXAMPLE

    if example:
        typer.echo(EXAMPLE, nl=False)
        return
    given = {
        "camera": {
            **_numbers(image, "x", ("width_px", "height_px"), "--image"),
            "fov_deg": fov_deg,
        },
        "dome": _numbers(dome_mm, ":", ("inner_radius_mm", "thickness_mm"), "--dome-mm"),
        "flat": _numbers(flat_mm, ":", ("distance_mm", "thickness_mm"), "--flat-mm"),
        "lens": {"position_mm": _split(lens_mm, ",", 3, "--lens-mm") or None},
        "lasers": {
            "count": lasers,
            "baseline_mm": baseline_mm,
            "fan_deg": None if rig else fan_deg,
        },
        "working_range_mm": _split(range_mm, ":", 2, "--range-mm"),
    }
    request = command.DesignRequest(
        design=file,
        rig=rig,
        out=out,
        given=_without_none(given),
        fan_deg=fan_deg,
        turn=turn,
        tilt=tilt,
        try_changes=changes,
        overwrite=overwrite,
    )
    command.run_design(request)


def _without_none(given: dict[str, Any]) -> dict[str, Any]:
    """Return the values that the user gave, without None and empty parts."""
    kept: dict[str, Any] = {}
    for key, value in given.items():
        if isinstance(value, dict):
            value = {name: one for name, one in value.items() if one is not None}
        if value:
            kept[key] = value
    return kept


def _numbers(text: str | None, between: str, names: tuple[str, ...], option: str) -> dict[str, Any]:
    """Return the numbers of an option such as 1920x1080 by their names; empty if not given."""
    found = _split(text, between, len(names), option)
    return dict(zip(names, found, strict=False))


def _split(text: str | None, between: str, count: int, option: str) -> list[float | int]:
    """Return the numbers of an option's value, integers as such; empty if not given."""
    if text is None:
        return []
    from aqualvs.errors import OptionError

    pieces = text.split(between)
    try:
        if len(pieces) != count:
            raise ValueError
        return [int(p) if re.fullmatch(r"[+-]?\d+", p.strip()) else float(p) for p in pieces]
    except ValueError:
        shown = between.join("N" * count)
        point = ", decimals with a point" if "," in text else ""
        raise OptionError(f"{option} {text}: write {count} numbers as {shown}{point}") from None
