"""Signatures of the commands on dives and rigs; bodies are imported when they run.

`run`, `report`, `figures`, `net`, `net-change`, `simulate`, `demo` and `check`.
"""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from aqualvs.cli.command import (
    MAX_WORKERS,
    Celsius,
    Detector,
    Fit,
    IndexTarget,
    MeshFilter,
    Overwrite,
    Refraction,
    Salinity,
    Target,
    WaterIndex,
    given,
    importing,
)


def net_change(
    runs: Annotated[
        list[Path],
        Argument(
            metavar="RUN...", help="Folders of runs that aqualvs net has evaluated, or of batches."
        ),
    ],
    out: Annotated[Path, Option("--out", "-o", help="Folder to write.")],
    date: Annotated[
        list[str] | None,
        Option(
            metavar="YYYY-MM-DD|auto",
            help="Date of each dive, in the order of the RUNs; by default from the folder's or "
            "video's name, or the video's clock.",
        ),
    ] = None,
    cell_m: Annotated[float, Option(help="Side length of the map's cells.")] = 1.0,
    overwrite: Overwrite = False,
) -> None:
    """Compare a net between dates."""
    from aqualvs.net_survey import command as body

    request = body.NetChangeRequest(
        runs=tuple(runs), out=out, dates=tuple(date or ()), cell_m=cell_m, overwrite=overwrite
    )
    body.net_change(request, typer.echo)


def run(
    context: typer.Context,
    source: Annotated[str, Argument(help="Video, folder of images, address, or recording.")],
    out: Annotated[
        Path | None,
        Option("--out", "-o", help="Folder to write; by default NAME_run beside the dive."),
    ] = None,
    rig: Annotated[Path | None, Option("--rig", help="Rig file; a recording has its own.")] = None,
    overwrite: Overwrite = False,
    target: Target = "auto",
    detector: Detector = "ridge",
    mesh_filter: MeshFilter = "none",
    fit: Fit = "robust",
    water_n: WaterIndex = None,
    temperature_c: Celsius = None,
    salinity: Salinity = None,
    dome: Refraction = True,
    frames: Annotated[
        str, Option(metavar="A:B", help="Only frames A to B-1.", show_default=False)
    ] = ":",
    fps: Annotated[
        float | None, Option(help="Frame rate of a folder of images; 1 by default.")
    ] = None,
    overlay: Annotated[bool, Option("--overlay", help="Also write overlay.mp4.")] = False,
    report: Annotated[bool, Option(help="Write report.html.")] = True,
    truth: Annotated[
        Path | None, Option(help="CSV with the ground truth, to compare with.")
    ] = None,
    index_target: IndexTarget = None,
    net: Annotated[
        bool, Option("--net", help="Also report the condition of the net, see aqualvs net.")
    ] = False,
    mcap: Annotated[
        bool, Option("--mcap", help="Also write dive.mcap, for Foxglove and for replays.")
    ] = False,
    rerun: Annotated[
        Path | None, Option(metavar="FILE.rrd", help="Also write a file for Rerun.")
    ] = None,
    workers: Annotated[
        int | None,
        Option(min=1, max=MAX_WORKERS, help="Number of worker processes; one per core by default."),
    ] = None,
) -> None:
    """Measure a dive."""
    with importing():
        from aqualvs import pipeline as body
        from aqualvs.nets.target_file import NetRequest
        from aqualvs.results.run_request import FrameWindow, RunRequest, Water, scanner_options
        from aqualvs.sources.opening import folder_beside
        from aqualvs.workers.start_method import n_cores

    request = RunRequest(
        source=source,
        rig=rig,
        out=out or folder_beside(source),
        overwrite=overwrite,
        water=Water(n_water=water_n, temperature_c=temperature_c, salinity=salinity),
        no_dome=not dome,
        frames=FrameWindow.parse(frames),
        fps=fps,
        scanner=scanner_options(target, detector, mesh_filter, fit),
        target=target,
        chosen=given(context, ("target", "detector", "mesh_filter", "fit")),
        mcap=mcap,
        rerun=rerun,
        overlay=overlay,
        report=report,
        truth=truth,
        index_target=index_target,
        net=NetRequest() if net else None,
        n_processes=workers or n_cores(),
    )
    raise typer.Exit(body.run_and_print(request, typer.echo))


def net(
    source: Annotated[str, Argument(help="Folder of a run, a video, or a folder of images.")],
    out: Annotated[
        Path | None,
        Option(
            "--out",
            "-o",
            help="Folder to write; by default the run's own, or NAME_run beside a dive.",
        ),
    ] = None,
    rig: Annotated[
        Path | None, Option(help="Rig file, if SOURCE is a dive; a run has its own.")
    ] = None,
    target: Annotated[
        str,
        Option(metavar="auto|net|solid|FILE", help="As for aqualvs run; only if SOURCE is a dive."),
    ] = "auto",
    log: Annotated[
        Path | None, Option(help="The vehicle's log, for depth and bearing: CSV, .tlog or .BIN.")
    ] = None,
    log_offset_s: Annotated[
        float | None,
        Option(help="The log's clock minus the dive's; by default found from the motion."),
    ] = None,
    twine_mm: Annotated[float | None, Option(help="Diameter of the bare twine, if known.")] = None,
    stretch_m: Annotated[float, Option(help="Length of a stretch of net.")] = 0.5,
    overwrite: Overwrite = False,
) -> None:
    """Report the condition of a net."""
    from aqualvs.net_survey import command as body
    from aqualvs.nets.target_file import NetRequest

    request = NetRequest(twine_mm=twine_mm, stretch_m=stretch_m, log=log, log_offset_s=log_offset_s)
    place = body.NetSource(source=source, rig=rig, out=out, target=target, overwrite=overwrite)
    raise typer.Exit(body.net(place, request, typer.echo))


def figures(
    folder: Annotated[Path, Argument(help="Folder of the run.")],
    out: Annotated[
        Path | None,
        Option("--out", "-o", help="Folder to write; by default figures in the run's folder."),
    ] = None,
    frame: Annotated[int | None, Option(help="Frame; by default the one that shows most.")] = None,
    laser: Annotated[
        str | None, Option(help="Name of the laser; by default the one that shows most.")
    ] = None,
    target: Annotated[
        Path | None,
        Option(help="Target file (net.yaml) with the parameters of the paper's filter."),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Draw a run's reflections."""
    from aqualvs.report.figure_style import check_matplotlib

    check_matplotlib("aqualvs figures")
    from aqualvs.report import mesh_figures as body

    body.figures(
        folder,
        out or folder / "figures",
        typer.echo,
        frame=frame,
        laser=laser,
        target=target,
        overwrite=overwrite,
    )


def report(
    folder: Annotated[Path, Argument(help="Folder of the run.")],
    truth: Annotated[
        Path | None,
        Option(help="CSV with the ground truth to show; aqualvs net rewrites the page without it."),
    ] = None,
) -> None:
    """Rewrite a report."""
    from aqualvs.report.run_page import write_report
    from aqualvs.results.folder import POSTURE_CSV, REPORT_HTML, claim_run, recover
    from aqualvs.results.summary import compare_with_truth

    if recover(folder):
        typer.echo(f"{folder}: points completed from the journal of a run that was killed")
    # Rewriting the report is the purpose of the command.
    with claim_run(folder, [REPORT_HTML], overwrite=True):
        found = None if truth is None else compare_with_truth(folder / POSTURE_CSV, truth)
        page = write_report(folder, truth=truth)
    for line in [*(found.lines() if found else []), f"report: {page}"]:
        typer.echo(line)


def simulate(
    scenario: Annotated[str | None, Argument(help="Scenario name or YAML file.")] = None,
    out: Annotated[Path | None, Option("--out", "-o", help="Folder to write.")] = None,
    rig: Annotated[Path | None, Option(help="Rig file; by default the example rig.")] = None,
    camera: Annotated[
        str, Option(help="Camera that takes the pictures: ideal, webcam, action or pal.")
    ] = "ideal",
    shutter: Annotated[
        str | None,
        Option(
            metavar="KIND:MS",
            help="Shutter of the camera, in milliseconds: rolling:READOUT:EXPOSURE, "
            "interlaced:EXPOSURE or global:EXPOSURE; by default the rig's.",
        ),
    ] = None,
    overwrite: Overwrite = False,
    list_: Annotated[bool, Option("--list", help="List the scenarios and exit.")] = False,
) -> None:
    """Render a dive."""
    from aqualvs.experiments import simulate as body

    if list_:
        body.print_scenarios(typer.echo)
    else:
        code = body.simulate(
            scenario, rig, out, typer.echo, camera=camera, shutter=shutter, overwrite=overwrite
        )
        raise typer.Exit(code)


def demo(
    out: Annotated[Path, Option("--out", "-o", help="Folder to write.")] = Path("out/demo"),
    overwrite: Overwrite = False,
) -> None:
    """Run the bundled dive."""
    from aqualvs import demo as body

    raise typer.Exit(body.demo(out, typer.echo, overwrite=overwrite))


def check(
    rig: Annotated[Path, Argument(help="Rig file (YAML).")],
    against: Annotated[
        Path | None,
        Option(
            metavar="last|FILE",
            help="Report what has moved since the last calibration, or since an older rig file.",
        ),
    ] = None,
) -> None:
    """Check a rig."""
    if against is not None:
        from aqualvs.check.comparison import last_calibration, run_compare

        is_word = str(against) == "last" and not against.exists()
        raise typer.Exit(run_compare(rig, last_calibration(rig) if is_word else against))
    from aqualvs.check.rig import run_check

    raise typer.Exit(run_check(rig))
