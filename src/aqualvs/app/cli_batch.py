"""The command line of batches: a signature only; the body is imported in it."""

from pathlib import Path
from typing import Annotated, Literal

import typer


def batch(
    context: typer.Context,
    dives: Annotated[
        list[str],
        typer.Argument(
            metavar="DIVES",
            help="Videos, recordings, folders, patterns such as 'dives/**/*.mp4', or a list (CSV "
            "or YAML) with columns dive, rig, name, water_n, temperature_c, salinity.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="Folder to write, or to go on with.", show_default=False),
    ],
    rig: Annotated[
        Path | None,
        typer.Option(
            help="Rig file of all dives; if left out, NAME.rig.yaml or rig.yaml beside each dive.",
            show_default=False,
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            help="Processes on this machine; one per core by default.", show_default=False
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="URL",
            help="Dask scheduler whose workers do it, such as tcp://192.168.1.10:8786.",
            show_default=False,
        ),
    ] = None,
    target: Annotated[
        str,
        typer.Option(
            metavar="auto|net|solid|FILE", help="What the lasers hit: a word, or a net.yaml."
        ),
    ] = "auto",
    detector: Annotated[
        Literal["ridge", "threshold"],
        typer.Option(help="Stripe detector; threshold is the paper's, for comparison."),
    ] = "ridge",
    mesh_filter: Annotated[
        Literal["none", "paper"],
        typer.Option(help="Filter for nets; paper is the paper's Algorithm 1."),
    ] = "none",
    fit: Annotated[
        Literal["robust", "pseudo_inverse"],
        typer.Option(help="Plane fit; pseudo_inverse is the paper's, for comparison."),
    ] = "robust",
    water_n: Annotated[
        float | None, typer.Option(help="Refractive index of the water.", show_default=False)
    ] = None,
    temperature_c: Annotated[
        float | None, typer.Option(help="Water temperature, for its index.", show_default=False)
    ] = None,
    salinity: Annotated[
        float | None, typer.Option(help="Salinity in per mille, for its index.", show_default=False)
    ] = None,
    dome: Annotated[
        bool, typer.Option("--dome/--no-dome", help="Refract at the dome, or ignore it.")
    ] = True,
    fps: Annotated[
        float | None, typer.Option(help="Frame rate of folders of images.", show_default=False)
    ] = None,
    index_target: Annotated[
        Path | None,
        typer.Option(
            help="Target on the vehicle (target.yaml) that tells the water's index on the way; "
            "dives are then not cut.",
            show_default=False,
        ),
    ] = None,
    report: Annotated[bool, typer.Option(help="Write report.html for each dive.")] = True,
) -> None:
    """Measure many dives."""
    from aqualvs.app.batch import command as body
    from aqualvs.app.run_inputs import Water, scanner_options

    given = ("target", "detector", "mesh_filter", "fit")
    sources = {name: context.get_parameter_source(name) for name in given}
    request = body.BatchRequest(
        dives=tuple(dives),
        out=out,
        rig=rig,
        water=Water(n_water=water_n, temperature_c=temperature_c, salinity=salinity),
        scheduler=scheduler,
        n_workers=workers,
        no_dome=not dome,
        fps=fps,
        scanner=scanner_options(target, detector, mesh_filter, fit),
        chosen=frozenset(n for n, s in sources.items() if s and s.name != "DEFAULT"),
        target=target,
        index_target=index_target,
        report=report,
    )
    raise typer.Exit(body.batch(request, typer.echo))
