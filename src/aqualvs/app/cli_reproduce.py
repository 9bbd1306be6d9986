"""The command line of the paper's experiments: a signature only; the body is imported in it."""

from pathlib import Path
from typing import Annotated

import typer


def reproduce(
    experiments: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="EXPERIMENT",
            help="Names from --list; all of them if left out.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write.")] = Path(
        "out/reproduce"
    ),
    list_: Annotated[bool, typer.Option("--list", help="List the experiments and exit.")] = False,
) -> None:
    """Run the paper's experiments."""
    from aqualvs.app.reproduce import command as body

    if list_:
        body.tell_experiments(typer.echo)
        return
    request = body.ReproduceRequest(names=tuple(experiments or ()), out=out)
    raise typer.Exit(body.reproduce(request, typer.echo))
