"""The command line that compares a net between dates: a signature; the body is imported in it."""

from pathlib import Path
from typing import Annotated

import typer

from aqualvs.app.cli_options import Overwrite


def net_change(
    runs: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN...",
            help="Folders of runs with the state of their net (aqualvs net), or of batches.",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write.", show_default=False)],
    date: Annotated[
        list[str] | None,
        typer.Option(
            metavar="YYYY-MM-DD|auto",
            help="Day of the dive, once for every RUN in their order; else from the names or the "
            "video's clock.",
            show_default=False,
        ),
    ] = None,
    cell_m: Annotated[float, typer.Option(help="Side of the map's cells.")] = 1.0,
    overwrite: Overwrite = False,
) -> None:
    """Compare a net between dates."""
    from aqualvs.app.net_change import command as body

    request = body.NetChangeRequest(
        runs=tuple(runs), out=out, dates=tuple(date or ()), cell_m=cell_m, overwrite=overwrite
    )
    body.net_change(request, typer.echo)
