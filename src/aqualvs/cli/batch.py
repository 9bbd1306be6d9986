"""Signature of `aqualvs batch`; the body is imported when the command runs."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from aqualvs.cli.command import (
    MAX_WORKERS,
    Celsius,
    Detector,
    Fit,
    MeshFilter,
    Refraction,
    Salinity,
    Target,
    WaterIndex,
    given,
    importing,
)


def batch(
    context: typer.Context,
    dives: Annotated[
        list[str],
        Argument(
            metavar="DIVES",
            help="Videos, recordings, folders, patterns such as 'dives/**/*.mp4', or a list (CSV "
            "or YAML) with columns dive, rig, name, water_n, temperature_c, salinity, log, "
            "log_offset_s.",
        ),
    ],
    out: Annotated[Path, Option("--out", "-o", help="Folder to write or to resume.")],
    rig: Annotated[
        Path | None,
        Option(
            help="Rig file for all dives; by default NAME.rig.yaml or rig.yaml beside each dive."
        ),
    ] = None,
    workers: Annotated[
        int | None,
        Option(max=MAX_WORKERS, help="Processes on this machine; one per core by default."),
    ] = None,
    scheduler: Annotated[
        str | None,
        Option(
            metavar="URL",
            help="Dask scheduler whose workers to use, such as tcp://192.168.1.10:8786.",
        ),
    ] = None,
    target: Target = "auto",
    detector: Detector = "ridge",
    mesh_filter: MeshFilter = "none",
    fit: Fit = "robust",
    water_n: WaterIndex = None,
    temperature_c: Celsius = None,
    salinity: Salinity = None,
    dome: Refraction = True,
    fps: Annotated[
        float | None, Option(help="Frame rate of folders of images; 1 by default.")
    ] = None,
    index_target: Annotated[
        Path | None,
        Option(
            help="Target on the vehicle (target.yaml) from which to track the water's index; dives "
            "are then not split."
        ),
    ] = None,
    report: Annotated[bool, Option(help="Write report.html for each dive.")] = True,
    net: Annotated[
        bool,
        Option(
            "--net",
            help="Also report the condition of each dive's net, as aqualvs net does; a list may "
            "name the vehicles' logs.",
        ),
    ] = False,
    twine_mm: Annotated[
        float | None, Option(help="With --net: diameter of the bare twine, if known.")
    ] = None,
    stretch_m: Annotated[
        float | None, Option(help="With --net: length of a stretch of net, 0.5 by default.")
    ] = None,
) -> None:
    """Measure many dives."""
    from aqualvs.workers import start_method

    if scheduler is None:
        start_method.prepare(start_method.FOR_BATCHES)
    with importing():
        from aqualvs.batch import command as body
        from aqualvs.nets.target_file import net_request
        from aqualvs.results.run_request import RunRequest, Water, scanner_options

    run = RunRequest(
        source="",
        rig=rig,
        out=out,
        water=Water(n_water=water_n, temperature_c=temperature_c, salinity=salinity),
        no_dome=not dome,
        fps=fps,
        scanner=scanner_options(target, detector, mesh_filter, fit),
        chosen=given(context, ("target", "detector", "mesh_filter", "fit")),
        target=target,
        index_target=index_target,
        report=report,
        net=net_request(wanted=net, twine_mm=twine_mm, stretch_m=stretch_m),
    )
    request = body.BatchRequest(dives=tuple(dives), run=run, scheduler=scheduler, n_workers=workers)
    raise typer.Exit(body.batch(request, typer.echo))
