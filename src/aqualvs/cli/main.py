"""The `aqualvs` program: signatures, help and exit codes.

Command bodies live in other packages and are imported when their command runs, so that `--help`
needs neither NumPy nor OpenCV. `main` is the one place where an exception becomes an exit code.
Standard output and standard error are wrapped, so that losing them costs no result.
"""

import contextlib
import errno
import functools
import gc
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any, TextIO

import typer
from typer import Option

from aqualvs import __version__
from aqualvs.cli.batch import batch
from aqualvs.cli.calibrate import board, calibrate, export, import_file, schema
from aqualvs.cli.command import USAGE_ERROR, CheckedCommand, CommandGroups, usage_text
from aqualvs.cli.design import design
from aqualvs.cli.experiments import benchmark, reproduce, score
from aqualvs.cli.follow import follow, tune
from aqualvs.cli.live import doctor, live
from aqualvs.cli.run import check, demo, figures, net, net_change, report, run, simulate
from aqualvs.errors import AqualvsError


class LenientStream:
    """Text stream that keeps a fault instead of raising it.

    The reader of a pipe may end early, as `head` does, and a terminal may be closed. A run that has
    begun is finished all the same.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.fault: OSError | None = None  # First fault; afterwards text is dropped.

    def write(self, text: str) -> int:
        """Write a text, or drop it after a fault."""
        try:
            if self.fault is None:
                return self._stream.write(text)
        except OSError as fault:
            self.fault = fault
        return len(text)

    def flush(self) -> None:
        """Flush the stream."""
        try:
            if self.fault is None:
                self._stream.flush()
        except OSError as fault:
            self.fault = fault

    def __getattr__(self, name: str) -> Any:
        """Return any other attribute of the stream."""
        return getattr(self._stream, name)


@contextlib.contextmanager
def lenient_output() -> Iterator[LenientStream | None]:
    """Make standard output and error lenient, and able to write every character.

    Yields standard output; None if it is closed.
    """
    before = sys.stdout, sys.stderr
    output = None if sys.stdout is None else _lenient(sys.stdout)
    errors = None if sys.stderr is None else _lenient(sys.stderr)
    sys.stdout, sys.stderr = output, errors
    try:
        yield output
    finally:
        for stream in (output, errors):
            if stream is not None:
                stream.flush()
        sys.stdout, sys.stderr = before


def _lenient(stream: TextIO) -> LenientStream:
    # Characters that the terminal's encoding lacks must not raise.
    reconfigure = getattr(stream, "reconfigure", None)
    if reconfigure is not None:
        reconfigure(errors="backslashreplace")
    return LenientStream(stream)


# Before NumPy is imported: matrices here are too small for threads of the linear algebra, which
# slow down twenty-fold if other processes keep the cores busy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# The search for plugins reads the metadata of every installed package.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")

app = typer.Typer(
    name="aqualvs",
    cls=CommandGroups,
    help="Underwater laser vision: range, pitch and yaw to a net or wall.",
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def _group(title: str) -> Callable[..., Any]:
    """Return the decorator that registers a command in a group of `--help`."""
    return functools.partial(app.command, cls=CheckedCommand, rich_help_panel=title)


_measure, _calibrate, _live = _group("Measure"), _group("Calibrate"), _group("Live and control")
_nets, _simulate, _reference = _group("Nets"), _group("Simulate"), _group("Reference")

_measure(
    help="Run the bundled dive and compare it with its truth.",
    epilog="Example: aqualvs demo -o out/demo",
)(demo)
_measure(
    help="Measure a dive: range, pitch and yaw for every frame, all points, and a report. "
    "SOURCE is a video, a folder of images, an address (rtsp://, udp://, http://), or a recording "
    "(dive.mcap), which brings its own rig and options. Without -o, results go to NAME_run beside "
    "it.",
    epilog="Example: aqualvs run dive.mp4 --rig rig.yaml -o out/dive",
)(run)
_measure(
    help="Measure many dives, on one machine or several, each as by aqualvs run; write a summary "
    "and one Parquet data set. To resume after an interruption, run it again: finished work is "
    "kept. Exit code 1 if a dive could not be finished.",
    epilog="Example: aqualvs batch season/2026 --rig rig.yaml -o out/2026",
)(batch)
_measure(
    help="Rewrite the report of a run. If the run was killed, complete its points first.",
    epilog="Example: aqualvs report out/dive --truth truth.csv",
)(report)
_measure(
    help="Draw a run's reflections in a laser's plane, with those that the filters take for net, "
    "as in figures 13 and 14 of the paper, and the filter's binary image.",
    epilog="Example: aqualvs figures out/dive -o out/figures",
)(figures)
_calibrate(
    help="Make a printable calibration target, true to scale, and its file: OUT.pdf and OUT.yaml.",
    epilog="Example: aqualvs board charuco --paper a3 -o board",
)(board)
_calibrate(
    "import",
    help="Make a rig file from the calibration of another program: ROS, OpenCV, Kalibr, mrcal, "
    "COLMAP, Refractive COLMAP.",
    epilog="Example: aqualvs import camera_info.yaml --as camera -o rig.yaml",
)(import_file)
_calibrate(
    help="Write a rig's camera as a calibration file for another program.",
    epilog="Example: aqualvs export rig.yaml --to colmap-underwater -o cameras.txt",
)(export)
app.add_typer(calibrate, rich_help_panel="Calibrate")
_calibrate(
    help="Report whether a rig is plausible and what it can measure.",
    epilog="Example: aqualvs check rig.yaml --against last",
)(check)
_calibrate(
    help="Print the JSON Schema of rig files, with which editors complete and check them; write it "
    "to a file with > rig.schema.json.",
    epilog="Example: aqualvs schema",
)(schema)
_live(
    help="Check whether this machine is ready, the stream arrives and the autopilot answers.",
    epilog="Example: aqualvs doctor udp://0.0.0.0:5600 --rig rig.yaml",
)(doctor)
_live(
    help="Measure a stream, a camera or a file in real time; send the posture to pilot, autopilot, "
    "ROS, Foxglove and a recording. Ctrl-C ends it.",
    epilog="Example: aqualvs live udp://0.0.0.0:5600 --rig rig.yaml --dashboard "
    "--mavlink udpout:192.168.2.2:14550",
)(live)
_live(
    help="Hold a distance to a net, or follow it, in simulation or with a vehicle.",
    epilog="Example: aqualvs follow --sim -o out/follow",
)(follow)
_live(
    help="Compute controller gains for a vehicle model and report their stability margins.",
    epilog="Example: aqualvs tune bluerov2_heavy -o gains.yaml",
)(tune)
_nets(
    help="Report the condition of a net: meshes, twine, fouling, holes, and a map. SOURCE is a "
    "dive (video or images, which is run first) or the folder of a run.",
    epilog="Example: aqualvs net out/dive --log vehicle.tlog",
)(net)
_nets(
    "net-change",
    help="Compare a net between dates: how fouling grew and where, which holes are new, grown, "
    "gone, or were not passed. RUN is the folder of a run that aqualvs net has evaluated, or of "
    "a batch.",
    epilog="Example: aqualvs net-change out/2026-05-01 out/2026-05-22 -o out/change",
)(net_change)
_simulate(
    help="Render a dive with ground truth: dive.mp4, truth.csv and rig.yaml. "
    "SCENARIO is a name from --list or a YAML file.",
    epilog="Example: aqualvs simulate net_diamond --camera webcam -o out/net",
)(simulate)
_simulate(
    help="Predict the accuracy of a camera, a dome and lasers, and optimise the lasers' tilt. "
    "DESIGN is a file; options override its values, or those of the example.",
    epilog="Example: aqualvs design --image 1920x1080 --fov-deg 69 --dome-mm 51:6 "
    "--baseline-mm 150 --lasers 3 --range-mm 300:1200 -o out/design",
)(design)
_reference(
    help="Repeat the paper's experiments in a simulated tank and compare each with the paper: "
    "figures, tables and one page, reproduce.html.",
    epilog="Example: aqualvs reproduce distance angles -o out/reproduce",
)(reproduce)
_reference(
    help="Render the public benchmark set: dives by difficulty, each with its ground truth and "
    "rig.",
    epilog="Example: aqualvs benchmark sun fouled -o bench",
)(benchmark)
_reference(
    help="Score the results of one or more systems on a benchmark set: plain CSV in, scores out.",
    epilog="Example: aqualvs score mine=out/mine --truth bench --own out/own -o scores",
)(score)

# 128 + signal as in a shell: SIGINT and SIGPIPE.
_EXIT_BAD_INPUT, _EXIT_INTERRUPTED, _EXIT_BROKEN_PIPE = 2, 130, 141
# Longest error message, in characters.
_MAX_MESSAGE = 2000


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[bool, Option("--version", help="Show the version and exit.")] = False,
) -> None:
    if version:
        typer.echo(f"aqualvs {__version__}")
    elif context.invoked_subcommand is None:
        typer.echo(context.get_help())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    arguments : sequence of str or None
        Without the program's name; None takes them from the process.

    Returns
    -------
    exit_code : int
        0 for success; 2 for bad input; 128 + signal for a run that was stopped; 141 for success
        whose output was not read to its end.
    """
    if arguments is None:
        # Compiling a kernel makes many objects and little garbage. With Python's thresholds,
        # garbage collection takes a tenth of a first run.
        gc.set_threshold(50_000, 20, 50)
    with lenient_output() as output:
        code = _exit_code(arguments)
    code = _complete(code, output, ends=arguments is None)
    if arguments is None:
        # The process ends here. A last garbage collection of all imported modules would take a
        # third of a second.
        gc.freeze()
    return code


@functools.cache
def program() -> Any:
    """Return the program with its commands, which Typer would make from `app` at every call."""
    return typer.main.get_command(app)


def _exit_code(arguments: Sequence[str] | None) -> int:
    """Run the program; print an expected error in one line and return the exit code."""
    try:
        listed = None if arguments is None else list(arguments)
        code = program()(args=listed, prog_name="aqualvs", standalone_mode=False)
    except AqualvsError as fault:
        return _complain(str(fault), _EXIT_BAD_INPUT)
    except (KeyboardInterrupt, typer.Abort):
        return _complain("interrupted", _EXIT_INTERRUPTED)
    except OSError as fault:
        if fault.filename is None:
            raise
        denied = isinstance(fault, PermissionError)
        remedy = "; change its rights, or choose another path" if denied else ""
        message = f"{os.fsdecode(fault.filename)}: {fault.strerror}{remedy}"
        return _complain(message, _EXIT_BAD_INPUT)
    except USAGE_ERROR as fault:
        return _complain(usage_text(fault), _EXIT_BAD_INPUT)
    return int(code or 0)


def _complain(message: str, code: int) -> int:
    """Print an error message in one line and return the exit code."""
    # Names of files, and values in them, may contain line feeds and other control characters.
    line = "".join(sign if sign.isprintable() else repr(sign)[1:-1] for sign in message)
    if len(line) > _MAX_MESSAGE:
        # A value may be a megabyte long; the file's name is in front of it, the remedy behind.
        line = f"{line[: _MAX_MESSAGE // 2]} ... {line[-_MAX_MESSAGE // 2 :]}"
    print(f"aqualvs: error: {line}", file=sys.stderr)
    return code


def _complete(code: int, output: LenientStream | None, *, ends: bool) -> int:
    """Return the exit code after a possible fault of standard output.

    `ends`: the process ends now, so that its output may be redirected.
    """
    fault = None if output is None else output.fault
    if fault is None:
        return code
    if ends:
        # So that the last flush at exit succeeds.
        with contextlib.suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, sys.stdout.fileno())
            os.close(nowhere)
    if fault.errno == errno.EPIPE:
        return code or _EXIT_BROKEN_PIPE
    return _complain(f"standard output: cannot be written ({fault.strerror})", _EXIT_BAD_INPUT)
