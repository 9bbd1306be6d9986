"""`aqualvs net`: condition of a net, from a dive or a run; `aqualvs net-change`: between dates."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from aqualvs.errors import OptionError, SourceError
from aqualvs.net_survey.surveys import (
    Survey,
    check_surveys,
    date_of_run,
    find_runs,
    given_dates,
    left_out,
    read_survey,
)
from aqualvs.nets.target_file import NetRequest
from aqualvs.optics.rigfile import rig_from_mapping
from aqualvs.pipeline import run_and_print
from aqualvs.report.figure_style import check_matplotlib
from aqualvs.report.run_data import mapping
from aqualvs.report.run_page import write_report
from aqualvs.results.files import Claim, writing
from aqualvs.results.folder import NET_FILES, POSTURE_CSV, REPORT_HTML, RUN_YAML, claim_run, recover
from aqualvs.results.net_survey import NetPass, check_stored, read_run
from aqualvs.results.run_request import RunRequest, Status, read_run_yaml, scanner_options
from aqualvs.sources.opening import folder_beside
from aqualvs.terminal import Echo, StopSignals, progress
from aqualvs.text import count_text

if TYPE_CHECKING:
    from aqualvs.net_survey.comparison import Comparison


@dataclass(frozen=True, slots=True, kw_only=True)
class NetSource:
    """Source of a survey: a dive or a run, and the folder to write."""

    source: str  # Folder of a run, or a dive as `open_source` takes it.
    # A dive needs a rig (a recording brings its own); its default folder is beside it. A run has
    # its own rig, and its own folder is the default.
    rig: Path | None = None
    out: Path | None = None
    # As `aqualvs run` takes it; for a dive.
    target: str = "auto"
    # Whether what is already there may be replaced.
    overwrite: bool = False


def net(place: NetSource, request: NetRequest, echo: Echo) -> int:
    """Evaluate the condition of a net, write it and print it.

    Returns 0, or 128 + signal if it was stopped: then the files tell of what came before. Raises
    `AqualvsError` if an input cannot be used, or a file not be written.
    """
    # A run without its postures is refused by its name; as a dive it would lack a rig.
    if any((Path(place.source) / name).is_file() for name in (POSTURE_CSV, RUN_YAML)):
        return net_of_run(place, request, echo)
    run = RunRequest(
        source=place.source,
        rig=place.rig,
        out=place.out or folder_beside(place.source),
        overwrite=place.overwrite,
        scanner=scanner_options(place.target, "ridge", "none", "robust"),
        chosen=frozenset() if place.target == "auto" else frozenset({"target"}),
        net=request,
    )
    return run_and_print(run, echo)


def net_of_run(place: NetSource, request: NetRequest, echo: Echo) -> int:
    """Find the state of a net from a run that is on disk; one that was killed is completed first.

    Returns and raises as `net`.
    """
    run_folder = Path(place.source)
    folder = place.out or run_folder
    if place.rig is not None:
        raise OptionError(
            f"--rig {place.rig}: {run_folder} is a run and has its rig; leave --rig out"
        )
    if recover(run_folder):
        echo(f"{run_folder}: points completed from the journal of a run that was killed")
    stored = StoredDive(run_folder)
    net = stored.net_pass(request)
    with claim_run(folder, NET_FILES, overwrite=place.overwrite):
        with StopSignals() as stop, progress(str(run_folder), stored.n_frames) as tick:
            for scan in read_run(run_folder):
                net.add(scan)
                tick(1)
                if stop.caught:
                    break
        result = net.write(folder, stored.video)
    for line in result.lines:
        echo(line)
    if stop.caught:
        echo(f"stopped by {stop.caught.name}; {folder} covers the frames before")
    elif missing := stored.missing(result.summary["n_frames"]):
        echo(f"warning: {missing}")
    if folder == run_folder and (run_folder / REPORT_HTML).exists():
        # The run's own page, brought up to date.
        with claim_run(folder, [REPORT_HTML], overwrite=True):
            echo(f"report: {write_report(run_folder)}")
    return stop.exit_code


class StoredDive:
    """Dive as stored in a run's folder.

    Raises `SourceError` if `run.yaml`, postures or points cannot be read.
    """

    def __init__(self, run_folder: Path) -> None:
        check_stored(run_folder)
        self._folder, self._content = run_folder, read_run_yaml(run_folder)
        if not isinstance(self._content.get("rig"), dict):
            raise SourceError(f"{run_folder / RUN_YAML}: holds no rig; run the dive again")

    @property
    def n_frames(self) -> int | None:
        """Number of frames that the run has measured, if known."""
        count = mapping(self._content, "summary").get("n_frames")
        return count if isinstance(count, int) else None

    def missing(self, n_read: int) -> str:
        """Return what the frames that were read lack of the dive, in words; "" if nothing."""
        if n_read < (self.n_frames or 0):
            return (
                f"{self._folder / POSTURE_CSV} holds {n_read} of the run's {self.n_frames} frames: "
                "the net is that of these alone; run the dive again"
            )
        status = self._content.get("status", Status.FINISHED)
        if status == Status.FINISHED:
            return ""
        return (
            f"the run did not finish (status: {status}): the net is that of its first "
            f"{count_text(n_read, 'frame')} alone"
        )

    @property
    def video(self) -> Path | None:
        """The dive's video, if it is still there."""
        path = mapping(self._content, "source").get("path")
        return Path(path) if isinstance(path, str) and Path(path).is_file() else None

    def net_pass(self, request: NetRequest) -> NetPass:
        """Return the evaluation of the net, to which the dive's scans are to be given.

        Raises `AqualvsError` if the rig in `run.yaml` is none, or the log cannot be read.
        """
        rig = rig_from_mapping(self._content["rig"], source_name=str(self._folder / RUN_YAML))
        return NetPass(rig, request)


NET_CHANGE_CSV, HOLES_CHANGE_CSV = "net_change.csv", "holes_change.csv"
NET_CHANGE_PNG, NET_CHANGE_HTML = "net_change.png", "net_change.html"
NET_CHANGE_FILES = (NET_CHANGE_CSV, HOLES_CHANGE_CSV, NET_CHANGE_PNG, NET_CHANGE_HTML)
"""What is written."""

_GIVEN = "given with --date"


@dataclass(frozen=True, slots=True, kw_only=True)
class NetChangeRequest:
    """Request for `aqualvs net-change`."""

    runs: tuple[Path, ...]  # Folders of runs, or of batches.
    out: Path  # Folder to write.
    dates: tuple[str, ...] = ()  # None, or one for each of `runs`.
    cell_m: float = 1.0  # Side of the map's cells.
    overwrite: bool = False

    def __post_init__(self) -> None:
        """Refuse values that cannot be."""
        if not 0.0 < self.cell_m < np.inf:
            raise OptionError(f"--cell-m {self.cell_m:g}: must be positive; correct it")


def net_change(request: NetChangeRequest, echo: Echo) -> "Comparison":
    """Compare dives along the same net, write the changes and print them.

    Raises `AqualvsError` if a run cannot be read or a file not be written, or there is nothing to
    compare.
    """
    check_matplotlib("aqualvs net-change")
    # `aqualvs net` and the processes of a batch need neither SciPy nor charts.
    from aqualvs.net_survey import tables
    from aqualvs.net_survey.comparison import compare
    from aqualvs.net_survey.page import draw_change, write_page
    from aqualvs.nets.tables import write_table

    surveys, origins = _surveys(request)
    check_surveys(surveys)
    files = [request.out / name for name in NET_CHANGE_FILES]
    with Claim("net-change", files, overwrite=request.overwrite):
        for folder in request.runs:
            for line in left_out(folder):
                echo(line)
        for one in surveys:
            echo(f"{one.folder}: {one.date} ({origins[str(one.folder)]})")
        result = compare(surveys, request.cell_m)
        with writing(request.out):
            cells, holes = tables.cell_rows(result), tables.hole_rows(result)
            write_table(request.out / NET_CHANGE_CSV, tables.NET_CHANGE_COLUMNS, cells)
            write_table(request.out / HOLES_CHANGE_CSV, tables.HOLES_CHANGE_COLUMNS, holes)
            draw_change(result, request.out / NET_CHANGE_PNG)
            write_page(request.out / NET_CHANGE_HTML, request.out / NET_CHANGE_PNG, result, origins)
    for line in tables.summary_lines(result):
        echo(line)
    echo(f"page: {request.out / NET_CHANGE_HTML}")
    return result


def _surveys(request: NetChangeRequest) -> tuple[list[Survey], dict[str, str]]:
    """Return the dives, and the source of each date."""
    given = given_dates(request.dates, len(request.runs))
    surveys, origins = [], {}
    for folder, day in zip(request.runs, given, strict=True):
        for run in find_runs(folder):
            found, origin = (day, _GIVEN) if day is not None else date_of_run(run)
            surveys.append(read_survey(run, found))
            origins[str(run)] = origin
    return surveys, origins
