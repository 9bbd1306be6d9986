"""The command `aqualvs run`: from a dive to posture, points and report.

`run` does all of it; `open_dive` and `summary_for` are shared with `aqualvs batch`.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

from aqualvs.closing import Closing
from aqualvs.errors import AqualvsError, OptionError, RigError, SourceError
from aqualvs.nets.target_file import net_check
from aqualvs.optics.rig import Rig
from aqualvs.results.agreement import LaserAgreement
from aqualvs.results.run_request import RunRequest, check_fits, prepared_rig
from aqualvs.results.summary import RunSummary, TruthComparison, compare_with_truth, read_truth
from aqualvs.scanner import Scanner, ScannerOptions
from aqualvs.sources import FrameSource, VideoSource, open_source
from aqualvs.sources.fields import FieldEvidence, first_pairs, source_of_frames, source_of_pictures
from aqualvs.sources.opening import existing_path, is_address
from aqualvs.sources.video import sampled_pictures
from aqualvs.terminal import Echo, StopSignals, progress
from aqualvs.text import count_text
from aqualvs.workers.frame_results import FrameScanner
from aqualvs.workers.pool import PoolJob, pool_job
from aqualvs.workers.run_frames import DiveProcessor, Replay, WaterFollowingScanner, replay_of

ScannerFor = Callable[[Rig, ScannerOptions], FrameScanner]
"""Constructor of a scanner."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunResult:
    """Result of a run.

    Attributes
    ----------
    exit_code : int
        0, or 128 + signal.
    stopped_by : str
        Name of the signal that stopped it, or empty.
    summary : RunSummary
    lines : list of str
        Results on the water's index, the dome's effect and the net, as far as requested.
    elapsed_s : float
        From the first frame to the complete folder, without the report.
    report : Path or None
    comparison : TruthComparison or None
    fault : AqualvsError or None
        What ended the run early; everything up to there is in the folder.
    """

    exit_code: int
    stopped_by: str
    summary: RunSummary
    lines: list[str]
    elapsed_s: float
    report: Path | None
    comparison: TruthComparison | None
    fault: AqualvsError | None


def run(request: RunRequest, *, scanner_for: ScannerFor = Scanner) -> RunResult:
    """Run a dive and write its folder.

    A source that breaks off is no exception but the result's `fault`: what came before it has been
    measured and reported.

    Parameters
    ----------
    request : RunRequest
    scanner_for : callable
        Makes the scanner from rig and options: a subclass of `Scanner`, or anything else whose
        `process` takes a `Frame` and returns a `Scan`. Only `Scanner` itself uses several processes
        and has its stripes in a recording.

    Raises
    ------
    AqualvsError
        If an input cannot be used, or an output not be written; what exists stays readable.
    """
    with (
        open_dive(request) as dive,
        DiveProcessor(
            dive.source, dive.rig, request.frames, _pool_job(dive, scanner_for), request.n_processes
        ) as processor,
    ):
        # While other processes measure the first frames, this one gets ready to write.
        from aqualvs import run_outputs as outputs
        from aqualvs.report.run_page import write_report
        from aqualvs.results.folder import POSTURE_CSV
        from aqualvs.results.net_survey import NetPass

        scanner, summary = dive.scanner(scanner_for), summary_for(dive)
        net = None if request.net is None else NetPass(dive.rig, request.net)
        processor.wait_for_first()
        claims = outputs.claim_outputs(request)
        started, fault = time.perf_counter(), None
        try:
            with (
                outputs.open_writers(dive.request, dive.rig, dive.source, net, summary) as writers,
                StopSignals() as stop,
                progress(dive.source.name, request.frames.n_frames(dive.source.n_frames)) as tick,
                closing(processor.blocks(scanner)) as blocks,
            ):
                outputs.write_all(blocks, writers, stop, tick)
        except SourceError as broken_off:
            fault = broken_off
    lines = scanner.lines() if isinstance(scanner, WaterFollowingScanner) else []
    lines += writers.bare_lens.lines()
    if net is not None:
        lines += outputs.write_net(net, request)
    result = RunResult(
        exit_code=stop.exit_code,
        stopped_by=stop.caught.name if stop.caught else "",
        summary=summary,
        lines=lines,
        elapsed_s=time.perf_counter() - started,
        # Before the comparison: a truth that cannot be used must not cost the report.
        report=write_report(request.out) if request.report else None,
        comparison=compare_with_truth(request.out / POSTURE_CSV, request.truth)
        if request.truth
        else None,
        fault=fault,
    )
    claims.close()
    return result


def run_and_print(request: RunRequest, echo: Echo) -> int:
    """Run a dive, print its results line by line, and return the exit code.

    Raises `AqualvsError` as `run`, and the result's `fault`.
    """
    result = run(request)
    for line in summary_lines(request, result):
        echo(line)
    if result.fault is not None:
        raise result.fault
    return result.exit_code


def summary_lines(request: RunRequest, result: RunResult) -> list[str]:
    """Return the lines that the command prints at the end."""
    n_frames = result.summary.n_frames
    lines = [f"{request.source}: {count_text(n_frames, 'frame')} in {result.elapsed_s:.1f} s"]
    lines += [*result.summary.lines(), *result.lines]
    if result.comparison is not None:
        lines += result.comparison.lines()
    if result.stopped_by:
        lines.append(
            f"stopped by {result.stopped_by} after {count_text(n_frames, 'frame')}; "
            f"what was measured is complete in {request.out}"
        )
    lines.append(f"report: {result.report}" if result.report else f"results: {request.out}")
    return lines


@dataclass(slots=True)
class OpenDive(Closing):
    """A dive that is ready to be measured; a context manager that closes its source."""

    source: FrameSource
    rig: Rig  # In the water of the dive.
    request: RunRequest  # With the options that count, which a recording may bring itself.

    @property
    def is_replay(self) -> bool:
        """True if the source is a recording."""
        return isinstance(self.source, Replay)

    def scanner(self, scanner_for: ScannerFor = Scanner) -> FrameScanner:
        """Return the scanner of the frames, which is the source itself if it is a recording.

        Raises `AqualvsError` if the target for the water's index cannot be used.
        """
        request, rig = self.request, self.rig
        if request.index_target is not None:
            return WaterFollowingScanner(rig, request.scanner, request.index_target, request.water)
        if isinstance(self.source, Replay):
            return self.source
        return scanner_for(rig, request.scanner)

    def close(self) -> None:
        """Close the source."""
        self.source.__exit__(None, None, None)


def open_dive(request: RunRequest) -> OpenDive:
    """Open the source of a dive and load its rig.

    Raises `AqualvsError` if one of them, or the truth, cannot be used, or they do not belong
    together.
    """
    replay = replay_of(request)
    if replay is not None and request.fps is not None:
        raise OptionError(f"--fps: {request.source} has its own clock; leave the frame rate out")
    if replay is None and request.rig is None and not is_address(request.source):
        # A mistyped path lacks no rig.
        existing_path(request.source)
    rig = (
        replay.rig if replay else prepared_rig(request.rig, request.water, no_dome=request.no_dome)
    )
    if request.truth is not None:
        read_truth(request.truth)
    if replay:
        dive = OpenDive(replay, rig, replace(request, scanner=replay.options))
    else:
        pictures = open_source(request.source, fps=request.fps)
        dive = OpenDive(source_of_frames(pictures, rig.shutter), rig, request)
    try:
        check_fits(dive.source, rig)
    except BaseException:
        dive.close()
        raise
    return dive


def summary_for(dive: OpenDive) -> RunSummary:
    """Return an empty summary with the checks that a run of the dive makes.

    The agreement of the lasers is not checked for one laser, nor without refraction at the dome,
    which alone makes lasers disagree.

    Raises `AqualvsError` if the uncertainty of the rig, or the target file, cannot be used.
    """
    request, rig = dive.request, dive.rig
    agreement = None
    if len(rig.lasers) > 1 and not request.no_dome:
        try:
            agreement = LaserAgreement(rig)
        except RigError as error:
            raise RigError(f"{request.rig or request.source}: {error}") from None
    return RunSummary(
        agreement=agreement,
        net_check=net_check(request.target, rig),
        warnings=list(_source_warnings(dive)),
    )


def _source_warnings(dive: OpenDive) -> Iterator[str]:
    """Yield a warning of several tracks, and of fields that contradict the rig's shutter."""
    path, pictures = Path(dive.request.source), source_of_pictures(dive.source)
    if isinstance(pictures, VideoSource):
        if pictures.n_tracks > 1:
            yield (
                f"the video holds {pictures.n_tracks} tracks, the first is measured; for another, "
                "copy it to a file of its own (ffmpeg -map 0:v:1 -c copy)"
            )
        # A stream cannot be read twice.
        groups, first_field = sampled_pictures(path) if path.is_file() else ([], None)
        evidence = FieldEvidence.of(groups, first_field)
    elif dive.is_replay:
        # Of most recordings there are stripes alone.
        return
    else:
        evidence = FieldEvidence.of(first_pairs(pictures))
    wrong = evidence.contradiction(dive.rig.shutter, pictures.fps)
    if wrong:
        yield wrong


def _pool_job(dive: OpenDive, scanner_for: ScannerFor) -> PoolJob | None:
    """Return the job for a pool of processes; None if one process must measure the whole dive."""
    request = dive.request
    shows_pictures = request.overlay or request.rerun is not None
    alone = shows_pictures or request.mcap or request.index_target is not None
    if alone or dive.is_replay or scanner_for is not Scanner or request.n_processes < 2:
        return None
    return pool_job(dive.source, request.frames, dive.rig, request.scanner)
