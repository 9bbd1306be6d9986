"""`aqualvs run`: from a dive to posture, points and report."""

import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from aqualvs.app.outputs import POSTURE_CSV, RunOutputs, prepare_folder
from aqualvs.app.progress import progress
from aqualvs.app.report import write_report
from aqualvs.app.run_agreement import agreement_of
from aqualvs.app.run_bare_lens import RunBareLens
from aqualvs.app.run_inputs import (
    FrameWindow,
    Water,
    check_fits,
    prepared_rig,
    scanner_facts,
    source_facts,
)
from aqualvs.app.run_overlay import RunOverlay
from aqualvs.app.run_water import WaterFollowingScanner
from aqualvs.app.runfile import Status
from aqualvs.app.stopping import StopSignals
from aqualvs.app.tally import Tally
from aqualvs.app.truth import TruthComparison, compare_with_truth, read_truth
from aqualvs.errors import AqualvsError, OptionError, SourceError
from aqualvs.live.sources import FrameSource, open_source
from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import rig_to_mapping
from aqualvs.scanning.pipeline import Scanner, ScannerOptions
from aqualvs.scanning.posture import Reason, Refusal
from aqualvs.scanning.scan import Frame, Scan, ScanPoints


@dataclass(frozen=True, slots=True, kw_only=True)
class RunRequest:
    """What to run.

    Attributes
    ----------
    source : str
        Path or address, as `open_source` takes it.
    rig : Path
    out : Path
        Folder to write.
    overwrite : bool
        Whether a run that is already there may be replaced.
    water : Water
    no_dome : bool
        Leave refraction at the dome out, for comparison.
    frames : FrameWindow
    fps : float or None
        Frame rate of image folders.
    scanner : ScannerOptions
    overlay, report : bool
        Whether to write `overlay.mp4` and `report.html`.
    truth : Path or None
        Truth to compare with.
    index_target : Path or None
        Markers on the vehicle that tell the water's index, followed frame by frame.
    """

    source: str
    rig: Path
    out: Path
    overwrite: bool = False
    water: Water = field(default_factory=Water)
    no_dome: bool = False
    frames: FrameWindow = field(default_factory=FrameWindow)
    fps: float | None = None
    scanner: ScannerOptions = field(default_factory=ScannerOptions)
    overlay: bool = False
    report: bool = True
    truth: Path | None = None
    index_target: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RunResult:
    """How a run went.

    Attributes
    ----------
    exit_code : int
        0, or 128 + signal.
    stopped_by : str
        Name of the signal that stopped it, or empty.
    tally : Tally
    dome_lines : list of str
        What the dome model is worth, in words.
    water_lines : list of str
        What was found of the water's index, in words; empty where it was given.
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
    elapsed_s: float
    report: Path | None
    comparison: TruthComparison | None
    fault: AqualvsError | None


class ScansFrames(Protocol):
    """What a run needs of a scanner."""

    def process(self, frame: Frame) -> Scan:
        """Return the scan of one frame."""


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
    rig = prepared_rig(request.rig, request.water, no_dome=request.no_dome)
    if request.truth is not None:
        read_truth(request.truth)
    fault: AqualvsError | None = None
    with open_source(request.source, fps=request.fps) as source:
        check_fits(source, rig)
        following = _following(request, rig)
        scanner = following or scanner_for(rig, request.scanner)
        agreement = None if request.no_dome else agreement_of(rig, request.rig)
        frames = _ready(_window(source, request.frames), source, request.frames)
        prepare_folder(request.out, overwrite=request.overwrite)
        started = time.perf_counter()
        try:
            with (
                _outputs(request, rig, source) as outputs,
                RunOverlay(request.out, rig, source, wanted=request.overlay) as overlay,
                RunBareLens(request.out, rig) as bare_lens,
                StopSignals() as stop,
                progress(source.name, request.frames.n_frames(source.n_frames)) as tick,
            ):
                outputs.tally.agreement = agreement
                for lost, frame in _with_losses(frames, request.frames.first, rig.n_water):
                    for scan in lost:
                        outputs.write(scan)
                        bare_lens.write(scan)
                        overlay.write(None, scan)
                    scan = scanner.process(frame)
                    outputs.write(scan)
                    bare_lens.write(scan)
                    overlay.write(frame, scan)
                    tick(1 + len(lost))
                    if stop.caught:
                        outputs.status = Status.INTERRUPTED
                        break
        except SourceError as broken_off:
            fault = broken_off
    return RunResult(
        exit_code=stop.exit_code,
        stopped_by=stop.caught.name if stop.caught else "",
        tally=outputs.tally,
        dome_lines=bare_lens.lines(),
        water_lines=following.lines() if following else [],
        elapsed_s=time.perf_counter() - started,
        report=_report(request),
        comparison=_comparison(request),
        fault=fault,
    )


def run_and_tell(request: RunRequest, tell: Callable[[str], object]) -> int:
    """Run a dive, tell how it went line by line, and return the exit code.

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
    """Return what the command prints at the end."""
    lines = [f"{request.source}: {result.tally.n_frames} frames in {result.elapsed_s:.1f} s"]
    lines += result.tally.lines()
    lines += result.water_lines
    lines += result.dome_lines
    if result.comparison is not None:
        lines += result.comparison.lines()
    if result.stopped_by:
        lines.append(
            f"stopped by {result.stopped_by} after {result.tally.n_frames} frames; "
            f"what was measured is complete in {request.out}"
        )
    lines.append(f"report: {result.report}" if result.report else f"results: {request.out}")
    return lines


def _following(request: RunRequest, rig: Rig) -> WaterFollowingScanner | None:
    if request.index_target is None:
        return None
    if rig.dome is None:
        raise OptionError("--index-target: without a dome the water's index cannot be seen")
    return WaterFollowingScanner(rig, request.scanner, request.index_target, request.water)


def _window(source: FrameSource, window: FrameWindow) -> Iterator[Frame]:
    """Yield the frames of a source that lie in a window."""
    for frame in source:
        if window.stop is not None and frame.index >= window.stop:
            return
        if frame.index >= window.first:
            yield frame


def _ready(frames: Iterator[Frame], source: FrameSource, window: FrameWindow) -> Iterator[Frame]:
    """Return the frames once the first of them has been decoded, or say that there is none."""
    first = next(frames, None)
    if first is not None:
        return itertools.chain([first], frames)
    if window == FrameWindow():
        raise SourceError(f"{source.name}: holds no frame that can be decoded; record it again")
    held = "" if source.n_frames is None else f", which has {source.n_frames}"
    stop = "" if window.stop is None else window.stop
    raise OptionError(
        f"--frames {window.first}:{stop}: no such frames in {source.name}{held}; "
        "choose frames that it has"
    )


def _with_losses(
    frames: Iterator[Frame], first: int, n_water: float
) -> Iterator[tuple[list[Scan], Frame]]:
    """Yield each frame with the scans that stand for the lost frames right before it."""
    last_index, last_time_s = 0, 0.0
    for frame in frames:
        # Between two frames that came, the clock is taken to run evenly.
        step = (frame.time_s - last_time_s) / max(1, frame.index - last_index)
        lost = range(first, frame.index)
        yield [_lost(i, last_time_s + (i - last_index) * step, n_water) for i in lost], frame
        first, last_index, last_time_s = frame.index + 1, frame.index, frame.time_s


def _lost(index: int, time_s: float, n_water: float) -> Scan:
    """Return the scan of a frame that could not be decoded."""
    none = np.empty(0)
    nothing = ScanPoints(
        laser=np.empty(0, np.int8),
        pixels=np.empty((0, 2)),
        points_in_dome=np.empty((0, 3)),
        sigma=none,
        intensity=none,
        width=none,
        quality=none,
        label=np.empty(0, np.uint8),
        used=np.empty(0, np.bool_),
    )
    return Scan(index, time_s, Refusal(Reason.CORRUPT_FRAME), nothing, n_water)


def _outputs(request: RunRequest, rig: Rig, source: FrameSource) -> RunOutputs:
    return RunOutputs(
        request.out, source=source_facts(source), rig=rig_to_mapping(rig), options=_options(request)
    )


def _options(request: RunRequest) -> dict[str, Any]:
    """Return the options as `run.yaml` holds them."""
    found = {"rig_file": str(request.rig), "no_dome": request.no_dome}
    found |= asdict(request.water)
    found |= {"first_frame": request.frames.first, "stop_frame": request.frames.stop}
    found["index_target"] = None if request.index_target is None else str(request.index_target)
    return found | {"scanner": scanner_facts(request.scanner)}


def _report(request: RunRequest) -> Path | None:
    return write_report(request.out, truth=request.truth) if request.report else None


def _comparison(request: RunRequest) -> TruthComparison | None:
    if request.truth is None:
        return None
    return compare_with_truth(request.out / POSTURE_CSV, request.truth)
