"""`aqualvs net`: the condition of a net, from a dive or from a run of it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aqualvs.errors import OptionError, SourceError
from aqualvs.nets.target_file import NetRequest
from aqualvs.optics.rigfile import rig_from_mapping
from aqualvs.pipeline import run_and_print
from aqualvs.report.run_page import write_report
from aqualvs.results.folder import (
    NET_FILES,
    NET_MAP_PNG,
    POSTURE_CSV,
    REPORT_HTML,
    RUN_YAML,
    claim_run,
    recover,
)
from aqualvs.results.net_survey import NetPass, check_stored, read_run
from aqualvs.results.run_request import RunRequest, read_run_yaml, scanner_options
from aqualvs.sources.opening import folder_beside
from aqualvs.terminal import StopSignals, progress


@dataclass(frozen=True, slots=True, kw_only=True)
class NetSource:
    """Source of a survey: a dive or a run, and the folder to write.

    Attributes
    ----------
    source : str
        Folder of a run, or a dive as `open_source` takes it.
    rig, out : Path or None
        A dive needs a rig (a recording brings its own); its default folder is beside it. A run has
        its own rig, and its own folder is the default.
    target : str
        As `aqualvs run` takes it; for a dive.
    overwrite : bool
        Whether what is already there may be replaced.
    """

    source: str
    rig: Path | None = None
    out: Path | None = None
    target: str = "auto"
    overwrite: bool = False


def net(place: NetSource, request: NetRequest, echo: Callable[[str], object]) -> int:
    """Evaluate the condition of a net, write it and print it.

    Returns
    -------
    exit_code : int
        0, or 128 + signal if it was stopped: then the files tell of what came before.

    Raises
    ------
    AqualvsError
        If an input cannot be used, or a file not be written.
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


def net_of_run(place: NetSource, request: NetRequest, echo: Callable[[str], object]) -> int:
    """Find the state of a net from a run that is on disk; one that was killed is completed first.

    Returns
    -------
    exit_code : int
        0, or 128 + signal if it was stopped: then the files tell of what came before.

    Raises
    ------
    AqualvsError
        If the run cannot be read, or a file not be written.
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
    for line in [*result.lines, f"map of the net: {folder / NET_MAP_PNG}"]:
        echo(line)
    if stop.caught:
        echo(f"stopped by {stop.caught.name}; {folder} tells of the frames before")
    if folder == run_folder and (run_folder / REPORT_HTML).exists():
        # The run's own page, brought up to date.
        with claim_run(folder, [REPORT_HTML], overwrite=True):
            echo(f"report: {write_report(run_folder)}")
    return stop.exit_code


class StoredDive:
    """Dive as stored in a run's folder.

    Parameters
    ----------
    run_folder : Path

    Raises
    ------
    SourceError
        If `run.yaml`, postures or points cannot be read.
    """

    def __init__(self, run_folder: Path) -> None:
        check_stored(run_folder)
        self._folder = run_folder
        self._content = _run_file(run_folder)

    @property
    def n_frames(self) -> int | None:
        """Number of frames that the run has measured, if known."""
        summary = self._content.get("summary")
        count = summary.get("n_frames") if isinstance(summary, dict) else None
        return count if isinstance(count, int) else None

    @property
    def video(self) -> Path | None:
        """The dive's video, if it is still there."""
        source = self._content.get("source")
        path = source.get("path") if isinstance(source, dict) else None
        return Path(path) if isinstance(path, str) and Path(path).is_file() else None

    def net_pass(self, request: NetRequest) -> NetPass:
        """Return the evaluation of the net, to which the dive's scans are to be given.

        Raises
        ------
        AqualvsError
            If the rig in `run.yaml` is none, or the log cannot be read.
        """
        rig = rig_from_mapping(self._content["rig"], source_name=str(self._folder / RUN_YAML))
        return NetPass(rig, request)


def _run_file(run_folder: Path) -> dict[str, Any]:
    content = read_run_yaml(run_folder)
    if not isinstance(content.get("rig"), dict):
        raise SourceError(f"{run_folder / RUN_YAML}: holds no rig; run the dive again")
    return content
