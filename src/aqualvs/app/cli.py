"""The command line: signatures and help only.

Bodies live in their own modules and are imported when their command runs, so that `--help` needs
neither NumPy nor OpenCV. `main` is the one place where an exception becomes an exit code.
"""

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

from aqualvs import __version__
from aqualvs.app.cli_calibrate import board, calibrate
from aqualvs.app.cli_control import tune
from aqualvs.app.cli_follow import follow
from aqualvs.app.cli_live import doctor, live
from aqualvs.errors import AqualvsError

# Matrices here are small: threads of the linear algebra gain nothing, and where another process
# keeps the cores busy they wait for each other twenty times as long. Before NumPy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

app = typer.Typer(
    name="aqualvs",
    help="Underwater laser vision: range, pitch and yaw to a net or wall.",
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    add_completion=False,
)

app.add_typer(calibrate)
app.command(
    help="Print a calibration target, true to scale, with its yaml: OUT.pdf and OUT.yaml.",
    epilog="Example: aqualvs board charuco --paper a3 -o board",
)(board)
app.command(
    help="Measure live: a stream, a camera or a file in real time, to pilot, autopilot, ROS, "
    "Foxglove and recording. Ctrl-C ends it.",
    epilog="Example: aqualvs live udp://0.0.0.0:5600 --rig rig.yaml --dashboard "
    "--mavlink udpout:192.168.2.2:14550",
)(live)
app.command(
    help="Say whether this machine is ready, the stream arrives and the autopilot answers.",
    epilog="Example: aqualvs doctor udp://0.0.0.0:5600 --rig rig.yaml",
)(doctor)
app.command(
    help="Hold a distance to a net, or follow it: in simulation, or with a vehicle.",
    epilog="Example: aqualvs follow --sim -o out/follow",
)(follow)
app.command(
    help="Make gains for a vehicle model, and say what margins they leave.",
    epilog="Example: aqualvs tune bluerov2_heavy -o gains.yaml",
)(tune)

# Older versions of Typer keep this class in Click, newer ones in a private module of their own.
_USAGE_ERROR: type[Exception] = typer.BadParameter.__bases__[0]
_EXIT_BAD_INPUT = 2
_EXIT_INTERRUPTED = 130

RigFile = Annotated[Path, typer.Option("--rig", help="Rig file (YAML).", show_default=False)]
OutFolder = Annotated[
    Path, typer.Option("--out", "-o", help="Folder to write.", show_default=False)
]


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Show the version and exit.")] = False,
) -> None:
    if version:
        typer.echo(f"aqualvs {__version__}")
    elif context.invoked_subcommand is None:
        typer.echo(context.get_help())


@app.command(
    help="Measure a dive: range, pitch and yaw for every frame, all points, and a report. "
    "SOURCE is a video, a folder of images, an address (rtsp://, udp://, http://), or a recording "
    "(dive.mcap), which brings its own rig and options.",
    epilog="Example: aqualvs run dive.mp4 --rig rig.yaml -o out/dive",
)
def run(
    context: typer.Context,
    source: Annotated[str, typer.Argument(help="Video, folder of images, address, or recording.")],
    out: OutFolder,
    rig: Annotated[
        Path | None,
        typer.Option("--rig", help="Rig file; a recording has its own.", show_default=False),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace a run that is there.")
    ] = False,
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
    frames: Annotated[
        str, typer.Option(metavar="A:B", help="Only frames A to B-1.", show_default=False)
    ] = ":",
    fps: Annotated[
        float | None, typer.Option(help="Frame rate of a folder of images.", show_default=False)
    ] = None,
    overlay: Annotated[bool, typer.Option("--overlay", help="Write overlay.mp4 too.")] = False,
    report: Annotated[bool, typer.Option(help="Write report.html.")] = True,
    truth: Annotated[
        Path | None, typer.Option(help="CSV with the truth to compare with.", show_default=False)
    ] = None,
    index_target: Annotated[
        Path | None,
        typer.Option(
            help="Target on the vehicle (target.yaml) that tells the water's index on the way.",
            show_default=False,
        ),
    ] = None,
    net: Annotated[
        bool, typer.Option("--net", help="Tell the state of the net too, see aqualvs net.")
    ] = False,
    mcap: Annotated[
        bool, typer.Option("--mcap", help="Write dive.mcap too, for Foxglove and for replays.")
    ] = False,
) -> None:
    """Measure a dive."""
    from aqualvs.app import run as body
    from aqualvs.app.net_pass import NetRequest
    from aqualvs.app.run_inputs import FrameWindow, Water, scanner_options

    request = body.RunRequest(
        source=source,
        rig=rig,
        out=out,
        overwrite=overwrite,
        water=Water(n_water=water_n, temperature_c=temperature_c, salinity=salinity),
        no_dome=not dome,
        frames=FrameWindow.parse(frames),
        fps=fps,
        scanner=scanner_options(target, detector, mesh_filter, fit),
        target=target,
        chosen=_given(context, ("target", "detector", "mesh_filter", "fit")),
        mcap=mcap,
        overlay=overlay,
        report=report,
        truth=truth,
        index_target=index_target,
        net=NetRequest() if net else None,
    )
    raise typer.Exit(body.run_and_tell(request, typer.echo))


@app.command(
    help="Tell the state of a net: meshes, twine, fouling, holes, and a map. SOURCE is a dive "
    "(video or images, which is run into DIR first) or the folder of a run.",
    epilog="Example: aqualvs net out/dive --log vehicle.tlog",
)
def net(
    source: Annotated[str, typer.Argument(help="Folder of a run, or video, folder of images.")],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Folder to write; of a run its own if left out.",
            show_default=False,
        ),
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(help="Rig file, for a dive; a run has its own.", show_default=False),
    ] = None,
    target: Annotated[
        str,
        typer.Option(
            metavar="auto|net|solid|FILE", help="As for aqualvs run, which a dive needs first."
        ),
    ] = "auto",
    log: Annotated[
        Path | None,
        typer.Option(
            help="The vehicle's log, for depth and bearing: CSV, .tlog or .BIN.",
            show_default=False,
        ),
    ] = None,
    log_offset_s: Annotated[
        float | None,
        typer.Option(
            help="Log's clock minus the dive's; found from the motion if left out.",
            show_default=False,
        ),
    ] = None,
    twine_mm: Annotated[
        float | None,
        typer.Option(help="Diameter of the bare twine, where it is known.", show_default=False),
    ] = None,
    stretch_m: Annotated[float, typer.Option(help="Length of a stretch of net.")] = 0.5,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace what is there.")] = False,
) -> None:
    """Tell the state of a net."""
    from aqualvs.app import net as body
    from aqualvs.app.net_pass import NetRequest

    request = NetRequest(twine_mm=twine_mm, stretch_m=stretch_m, log=log, log_offset_s=log_offset_s)
    place = body.NetSource(source=source, rig=rig, out=out, target=target, overwrite=overwrite)
    raise typer.Exit(body.net(place, request, typer.echo))


@app.command(
    help="Render a dive with known truth: dive.mp4, truth.csv and rig.yaml. "
    "SCENARIO is a name from --list or a YAML file.",
    epilog="Example: aqualvs simulate net -o out/net",
)
def simulate(
    scenario: Annotated[
        str | None, typer.Argument(help="Scenario name or YAML file.", show_default=False)
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder to write.", show_default=False)
    ] = None,
    rig: Annotated[
        Path | None, typer.Option(help="Rig file; the example rig if left out.", show_default=False)
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace a dive that is there.")
    ] = False,
    list_: Annotated[bool, typer.Option("--list", help="List the scenarios and exit.")] = False,
) -> None:
    """Render a dive."""
    from aqualvs.app import simulate as body

    if list_:
        body.tell_scenarios(typer.echo)
    else:
        body.simulate(scenario, rig, out, typer.echo, overwrite=overwrite)


@app.command(
    help="Run the bundled dive and compare it with its truth.",
    epilog="Example: aqualvs demo -o out/demo",
)
def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write.")] = Path("out/demo"),
) -> None:
    """Run the bundled dive."""
    from aqualvs.app import demo as body

    raise typer.Exit(body.demo(out, typer.echo))


@app.command(
    help="Say in words whether a rig is sane and what it can measure.",
    epilog="Example: aqualvs check rig.yaml --against rig.before.yaml",
)
def check(
    rig: Annotated[Path, typer.Argument(help="Rig file (YAML).")],
    against: Annotated[
        Path | None,
        typer.Option(help="Older rig file: say what has moved since.", show_default=False),
    ] = None,
) -> None:
    """Check a rig."""
    if against is not None:
        from aqualvs.app.check_compare import run_compare

        raise typer.Exit(run_compare(rig, against))
    from aqualvs.app.check import run_check

    raise typer.Exit(run_check(rig))


@app.command(
    help="Draw a run's reflections in a laser's plane, with what the filters take for net: "
    "pictures after figures 13 and 14 of the paper, and the filter's binary image.",
    epilog="Example: aqualvs figures out/dive -o out/figures",
)
def figures(
    folder: Annotated[Path, typer.Argument(help="Folder of the run.")],
    out: OutFolder,
    frame: Annotated[
        int | None,
        typer.Option(help="Frame; the one that shows most if left out.", show_default=False),
    ] = None,
    laser: Annotated[
        str | None,
        typer.Option(help="Laser's name; the one that shows most if left out.", show_default=False),
    ] = None,
    target: Annotated[
        Path | None,
        typer.Option(
            help="Target file (net.yaml) with the parameters of the paper's filter.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Draw a run's reflections."""
    from aqualvs.app import figures as body

    body.figures(folder, out, typer.echo, frame=frame, laser=laser, target=target)


@app.command(
    help="Write the report of a run again. After a run that was killed, its points are completed "
    "first.",
    epilog="Example: aqualvs report out/dive --truth truth.csv",
)
def report(
    folder: Annotated[Path, typer.Argument(help="Folder of the run.")],
    truth: Annotated[
        Path | None, typer.Option(help="CSV with the truth to show.", show_default=False)
    ] = None,
) -> None:
    """Write a report again."""
    from aqualvs.app.outputs import recover
    from aqualvs.app.report import write_report

    if recover(folder):
        typer.echo(f"{folder}: points completed from the journal of a run that was killed")
    typer.echo(f"report: {write_report(folder, truth=truth)}")


def _given(context: typer.Context, names: Sequence[str]) -> frozenset[str]:
    """Return which of some options the user gave."""
    sources = {name: context.get_parameter_source(name) for name in names}
    return frozenset(
        name for name, source in sources.items() if source and source.name != "DEFAULT"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    arguments : sequence of str or None
        Without the program's name; None takes them from the process.

    Returns
    -------
    exit_code : int
        0, or 2 for bad input, or 128 + signal for a run that was stopped.
    """
    try:
        listed = None if arguments is None else list(arguments)
        code = app(args=listed, prog_name="aqualvs", standalone_mode=False)
    except AqualvsError as fault:
        return _complain(str(fault), _EXIT_BAD_INPUT)
    except (KeyboardInterrupt, typer.Abort):
        return _complain("interrupted", _EXIT_INTERRUPTED)
    except _USAGE_ERROR as fault:
        return _complain(f"{_usage(fault)}; see aqualvs --help", _EXIT_BAD_INPUT)
    return int(code or 0)


def _usage(fault: Exception) -> str:
    """Return what is wrong with the arguments, as the parser words it, in one line."""
    message = getattr(fault, "format_message", fault.__str__)()
    return " ".join(str(message).split()).rstrip(".")


def _complain(message: str, code: int) -> int:
    print(f"aqualvs: error: {message}", file=sys.stderr)
    return code
