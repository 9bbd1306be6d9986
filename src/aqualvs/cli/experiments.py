"""Signatures of `aqualvs reproduce`, `benchmark` and `score`; bodies are imported when they run."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from aqualvs.cli.command import Overwrite


def benchmark(
    names: Annotated[
        list[str] | None,
        Argument(metavar="[LEVEL|DIVE]...", help="Levels or dives; all by default."),
    ] = None,
    out: Annotated[Path | None, Option("--out", "-o", help="Folder to write.")] = None,
    frames: Annotated[
        int | None, Option(help="Number of frames per dive, for a quick look.")
    ] = None,
    shutter: Annotated[
        str | None,
        Option(
            metavar="KIND[:MS]",
            help="rolling:READOUT:EXPOSURE, interlaced:EXPOSURE or global:EXPOSURE; global by "
            "default.",
        ),
    ] = None,
    overwrite: Overwrite = False,
    list_: Annotated[bool, Option("--list", help="List levels and dives and exit.")] = False,
) -> None:
    """Render the benchmark set."""
    from aqualvs.errors import OptionError
    from aqualvs.experiments import benchmark_set as body

    if list_:
        body.print_dives(typer.echo)
        return
    if out is None:
        raise OptionError("--out: missing; give the folder to write")
    body.make_set(
        out, names or [], typer.echo, n_frames=frames, shutter=shutter, overwrite=overwrite
    )


def score(
    truth: Annotated[Path, Option(help="Folder of the set, from 'aqualvs benchmark'.")],
    results: Annotated[
        list[str] | None,
        Argument(
            metavar="[NAME=PATH]...",
            help="Results of a system: a folder with DIVE.csv or DIVE/posture.csv, or one CSV "
            "with a column dive.",
        ),
    ] = None,
    own: Annotated[
        Path | None,
        Option(
            help="Also run aqualvs and its baselines on the set into this folder, and score them."
        ),
    ] = None,
    out: Annotated[
        Path | None, Option("--out", "-o", help="Folder for scores.csv, .json and .md.")
    ] = None,
    dives: Annotated[bool, Option("--dives", help="Show every dive in the table.")] = False,
    overwrite: Overwrite = False,
) -> None:
    """Score systems."""
    from aqualvs.experiments import benchmark_score as body

    body.run_score(
        results or [], truth, typer.echo, own=own, out=out, dives=dives, overwrite=overwrite
    )


def reproduce(
    experiments: Annotated[
        list[str] | None, Argument(metavar="EXPERIMENT", help="Names from --list; all by default.")
    ] = None,
    out: Annotated[Path, Option("--out", "-o", help="Folder to write.")] = Path("out/reproduce"),
    list_: Annotated[bool, Option("--list", help="List the experiments and exit.")] = False,
) -> None:
    """Run the paper's experiments."""
    from aqualvs.report.figure_style import check_matplotlib

    check_matplotlib("aqualvs reproduce")
    from aqualvs.experiments import command as body

    if list_:
        body.print_experiments(typer.echo)
        return
    raise typer.Exit(body.reproduce(experiments or (), out, typer.echo))
