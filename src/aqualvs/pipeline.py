"""The command `aqualvs run`: from a dive to posture, points and report.

`agreement_of` sets up the check of the lasers against each other during the run.
"""

import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

from aqualvs.errors import AqualvsError, OptionError, RigError, SourceError
from aqualvs.nets.target_file import net_check
from aqualvs.optics.rig import Rig
from aqualvs.results.run_request import RunRequest, check_fits, prepared_rig
from aqualvs.results.summary import Tally, TruthComparison, read_truth
from aqualvs.scanner import Scanner, ScannerOptions
from aqualvs.scanning.agreement import LaserAgreement
from aqualvs.sources import FrameSource, open_source
from aqualvs.terminal import StopSignals, progress
from aqualvs.workers.frame_results import ScansFrames
from aqualvs.workers.pool import CrewWork, crew_work
from aqualvs.workers.run_frames import Replay, RunMeasuring, replay_of
from aqualvs.workers.water_index import WaterFollowingScanner


def agreement_of(rig: Rig, path: Path) -> LaserAgreement | None:
    """Return the check of a rig's lasers against each other, None if there is nothing to check.

    One laser agrees with itself; and where refraction at the dome is left out, the lasers disagree
    for that reason alone.

    Parameters
    ----------
    rig : Rig
        As the run uses it.
    path : Path
        Its file, for messages.

    Raises
    ------
    RigError
        If the rig's uncertainty cannot be parsed.
    """
    if len(rig.lasers) < 2:
        return None
    try:
        return LaserAgreement(rig)
    except RigError as error:
        raise RigError(f"{path}: {error}") from None


@dataclass(frozen=True, slots=True, kw_only=True)
class RunResult:
    """Result of a run.

    Attributes
    ----------
    exit_code : int
        0, or 128 + signal.
    stopped_by : str
        Name of the signal that stopped it, or empty.
    tally : Tally
    dome_lines : list of str
        Effect of the dome model, as lines of text.
    water_lines : list of str
        Result for the water's index, as lines of text; empty where it was given.
    net_lines : list of str
        State of the net, as lines of text; empty if not requested.
    elapsed_s : float
        From the first frame to the complete folder, without the report.
    report : Path or None
    comparison : TruthComparison or None
    fault : AqualvsError or None
        What ended the run early; everything up to there is in the folder.
    """

    exit_code: int
    stopped_by: str
    tally: Tally
    dome_lines: list[str]
    water_lines: list[str]
    net_lines: list[str]
    elapsed_s: float
    report: Path | None
    comparison: TruthComparison | None
    fault: AqualvsError | None


def run(
    request: RunRequest,
    *,
    scanner_for: Callable[[Rig, ScannerOptions], ScansFrames] = Scanner,
) -> RunResult:
    """Run a dive and write its folder.

    A source that breaks off is no exception but the result's `fault`: what came before it has been
    measured and reported.

    Raises
    ------
    AqualvsError
        If an input cannot be used, or an output not be written; what exists stays readable.
    """
    replay = _replay(request)
    if replay is None:
        rig = prepared_rig(request.rig, request.water, no_dome=request.no_dome)
    else:
        rig, request = replay.rig, replace(request, scanner=replay.options)
    if request.truth is not None:
        read_truth(request.truth)
    fault: AqualvsError | None = None
    with replay or open_source(request.source, fps=request.fps) as source:
        check_fits(source, rig)
        alone = replay is not None or scanner_for is not Scanner
        work = None if alone else _crew_work(request, source, rig)
        with RunMeasuring(source, rig, request.frames, work, request.n_processes) as measuring:
            # While other processes measure the first frames, this one gets ready to write.
            from aqualvs import run_outputs as folder
            from aqualvs.run_outputs import RunNet

            following = following_for(request, rig)
            scanner = following or replay or scanner_for(rig, request.scanner)
            net, agreement = RunNet(rig, request.net), agreement_for(request, rig)
            check = net_check(request.target, rig)
            measuring.await_first()
            claim = folder.prepare(request)
            started = time.perf_counter()
            try:
                with (
                    folder.writers(request, rig, source, net) as writers,
                    StopSignals() as stop,
                    progress(source.name, request.frames.n_frames(source.n_frames)) as tick,
                ):
                    writers.tally.agreement, writers.tally.net_check = agreement, check
                    scanner = writers.recorded(scanner)
                    with closing(measuring.blocks(scanner, one_by_one=request.mcap)) as blocks:
                        folder.write_all(blocks, writers, stop, tick)
            except SourceError as broken_off:
                fault = broken_off
    result = RunResult(
        exit_code=stop.exit_code,
        stopped_by=stop.caught.name if stop.caught else "",
        tally=writers.tally,
        dome_lines=writers.dome_lines(),
        water_lines=following.lines() if following else [],
        net_lines=writers.net_lines(request.out, request.source),
        elapsed_s=time.perf_counter() - started,
        report=folder.report(request),
        comparison=folder.comparison(request),
        fault=fault,
    )
    claim.close()
    return result


def run_and_tell(request: RunRequest, tell: Callable[[str], object]) -> int:
    """Run a dive, print its results line by line, and return the exit code.

    Raises
    ------
    AqualvsError
        As `run`, and the result's `fault`.
    """
    result = run(request)
    for line in summary_lines(request, result):
        tell(line)
    if result.fault is not None:
        raise result.fault
    return result.exit_code


def summary_lines(request: RunRequest, result: RunResult) -> list[str]:
    """Return the lines that the command prints at the end."""
    lines = [f"{request.source}: {result.tally.n_frames} frames in {result.elapsed_s:.1f} s"]
    lines += result.tally.lines()
    lines += result.water_lines
    lines += result.dome_lines
    lines += result.net_lines
    if result.comparison is not None:
        lines += result.comparison.lines()
    if result.stopped_by:
        lines.append(
            f"stopped by {result.stopped_by} after {result.tally.n_frames} frames; "
            f"what was measured is complete in {request.out}"
        )
    lines.append(f"report: {result.report}" if result.report else f"results: {request.out}")
    return lines


def _replay(request: RunRequest) -> Replay | None:
    replay = replay_of(request)
    if replay is not None and request.fps is not None:
        raise OptionError(f"--fps: {request.source} has its own clock; leave the frame rate out")
    return replay


def following_for(request: RunRequest, rig: Rig) -> WaterFollowingScanner | None:
    """Return the scanner that tracks the water's index, None if that is not requested.

    Raises
    ------
    AqualvsError
        If the target for the water's index cannot be used.
    """
    if request.index_target is None:
        return None
    if rig.dome is None:
        raise OptionError("--index-target: without a dome the water's index cannot be seen")
    return WaterFollowingScanner(rig, request.scanner, request.index_target, request.water)


def _crew_work(request: RunRequest, source: FrameSource, rig: Rig) -> CrewWork | None:
    """Return how processes can share the dive; None where one process must measure all of it."""
    alone = request.overlay or request.mcap or request.index_target is not None
    if alone or request.n_processes < 2:
        return None
    return crew_work(source, request.frames, rig, request.scanner)


def agreement_for(request: RunRequest, rig: Rig) -> LaserAgreement | None:
    """Return the check of a dive's lasers against each other, None if there is none.

    Raises
    ------
    RigError
        If the rig's uncertainty cannot be parsed.
    """
    if request.no_dome:
        return None
    return agreement_of(rig, request.rig or Path(request.source))
