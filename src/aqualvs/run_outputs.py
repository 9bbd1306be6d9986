"""Outputs of a run: the files of its folder, its report, and the comparison with the truth.

`RunWriters` holds what writes its files frame by frame: the folder itself, `posture_bare.csv`, and
on request the overlay, a recording, a file of Rerun, and the state of the net.
"""

import statistics
import time
from array import array
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from aqualvs.closing import Closing
from aqualvs.errors import OptionError, OutputError
from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import rig_to_mapping
from aqualvs.report.overlay import OverlayWriter, draw_overlay
from aqualvs.results.files import Claim, writing
from aqualvs.results.folder import (
    DIVE_MCAP,
    OVERLAY_MP4,
    POSTURE_BARE_CSV,
    RUN_FILES,
    PostureCsv,
    RunOutputs,
    prepare_folder,
)
from aqualvs.results.net_survey import NetPass
from aqualvs.results.run_request import RunRequest, Status, source_dict
from aqualvs.results.summary import RunSummary
from aqualvs.scanning.posture import Posture
from aqualvs.scanning.scan import Frame, Scan
from aqualvs.sources import FrameSource
from aqualvs.sources.base import bgr_of
from aqualvs.special_files import refuse_special
from aqualvs.terminal import StopSignals, Tick
from aqualvs.workers.frame_results import FrameResult, ScanInputs

if TYPE_CHECKING:
    from aqualvs.recording.sample import LiveSample

WriteResult: TypeAlias = Callable[[FrameResult], None]
"""Writer of the result of a frame."""


@contextmanager
def _mcap(request: RunRequest, rig: Rig) -> Iterator[WriteResult]:
    """Write `dive.mcap`, with the rig and the stripes that each scan was computed from.

    A frame that was lost has no stripes. Raises `OutputError` if the file cannot be written.
    """
    # Few runs write one.
    from aqualvs.recording import RecorderOptions, Recording

    path, began_ns = request.out / DIVE_MCAP, time.time_ns()
    with writing(path):
        recording = Recording(path, RecorderOptions(scanner=request.scanner))

    def write(result: FrameResult) -> None:
        inputs = result.inputs or ScanInputs(rig, {})
        with writing(path):
            recording.write(_sample(began_ns, result.scan, inputs))

    try:
        yield write
    finally:
        with writing(path):
            recording.close()


def _sample(
    began_ns: int, scan: Scan, inputs: ScanInputs, frame: Frame | None = None
) -> "LiveSample":
    """Return the sample of a frame, with times as if the dive had started with the run."""
    from aqualvs.recording.sample import Instants, LiveSample
    from aqualvs.sources.base import Health

    at_ns = round(1e9 * scan.time_s)
    return LiveSample(
        rig=inputs.rig,
        scan=scan,
        peaks=inputs.peaks,
        frame=frame,
        utc_ns=began_ns + at_ns,
        instants=Instants(at_ns, at_ns, at_ns),
        filtered=None,
        health=Health(),
    )


@contextmanager
def _rerun(path: Path, rig: Rig) -> Iterator[WriteResult]:
    """Write a file of Rerun. Raises `OutputError` if it cannot be written."""
    from aqualvs.recording.rerun_log import RerunLog

    with closing(RerunLog()) as log:
        with writing(path):
            log.save(path)
        yield lambda one: log.write(_sample(0, one.scan, ScanInputs(rig, {}), one.frame))


@contextmanager
def _overlay(request: RunRequest, rig: Rig, source: FrameSource) -> Iterator[WriteResult]:
    """Write `overlay.mp4`; a lost frame gives a black picture, so that frames keep their number.

    Raises `OutputError` if the video cannot be written.
    """
    path, (width, height) = request.out / OVERLAY_MP4, rig.size_px
    fps_without_clock = 25.0
    video = OverlayWriter(path, source.size_px, source.fps or fps_without_clock)

    def write(result: FrameResult) -> None:
        image = np.zeros((height, width, 3), np.uint8)
        if result.frame is not None:
            shown = bgr_of(result.frame)
            image[: len(shown)] = shown
        with writing(path):
            video.write(draw_overlay(image, result.scan.points, result.scan.posture, rig))

    try:
        yield write
    finally:
        with writing(path):
            video.close()


class RunBareLens(Closing):
    """Writer of `posture_bare.csv` during a run; of nothing for a rig without a housing.

    Raises `OutputError` from every method, if the file cannot be written.
    """

    def __init__(self, folder: Path, rig: Rig) -> None:
        self._path = folder / POSTURE_BARE_CSV
        self._housing = "dome" if rig.flat_port is None else "flat port"
        self._ratios = array("d")
        self._file: PostureCsv | None = None
        if rig.housing is not None:
            with writing(self._path):
                self._file = PostureCsv(self._path, rig.shutter)

    def write(self, *results: FrameResult) -> None:
        """Append the rows of frames."""
        if self._file is None:
            return
        rows = []
        for result in results:
            scan, posture = result.scan, result.bare
            if isinstance(posture, Posture) and isinstance(scan.posture, Posture):
                self._ratios.append(posture.range / scan.posture.range)
            if posture is not None:
                rows.append(replace(scan, posture=posture))
        with writing(self._path):
            self._file.write(*rows)

    def lines(self) -> list[str]:
        """Return the effect of the housing's model as lines of text."""
        if not self._ratios:
            return []
        percent = 100.0 * (statistics.median(self._ratios) - 1.0)
        return [f"without the {self._housing} model the range would read {percent:+.1f} % (median)"]

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()


class RunWriters(NamedTuple):
    """Everything that a run writes frame by frame."""

    folder: RunOutputs
    bare_lens: RunBareLens
    others: tuple[WriteResult, ...]  # What was requested besides.


def claim_outputs(request: RunRequest) -> ExitStack:
    """Make sure that the run can be written, and return its claims, to be closed at its end.

    Raises `OutputError` if it cannot, or its folder holds another that may not be replaced. Raises
    `OptionError` if its own source would be replaced, or a file of Rerun is requested but cannot be
    written.
    """
    source, rerun = Path(request.source), request.rerun
    is_ours = source.is_file() and source.name in RUN_FILES
    if is_ours and source.resolve().parent == request.out.resolve():
        raise OptionError(f"{source}: is what the run reads; write to another folder")
    with ExitStack() as claims:
        if rerun is not None:
            from aqualvs.recording.rerun_log import RRD, rerun_sdk

            if rerun.suffix != RRD:
                raise OptionError(f"--rerun {rerun}: give a file that ends in {RRD}")
            rerun_sdk()
            refuse_special(rerun, OutputError, f"give a file that ends in {RRD}")
            claims.callback(Claim("run", [rerun], overwrite=request.overwrite).close)
        claims.callback(prepare_folder(request.out, overwrite=request.overwrite).close)
        return claims.pop_all()


@contextmanager
def open_writers(
    request: RunRequest, rig: Rig, source: FrameSource, net: NetPass | None, summary: RunSummary
) -> Iterator[RunWriters]:
    """Open everything that the run writes; it is completed however the run ends."""
    folder = RunOutputs(
        request.out,
        source=source_dict(source),
        rig=rig_to_mapping(rig),
        options=request.to_dict(),
        summary=summary,
        shutter=rig.shutter,
    )
    with ExitStack() as stack:
        stack.enter_context(folder)
        others: list[WriteResult] = []
        if request.overlay:
            others.append(stack.enter_context(_overlay(request, rig, source)))
        bare_lens = stack.enter_context(RunBareLens(request.out, rig))
        if request.mcap:
            others.append(stack.enter_context(_mcap(request, rig)))
        if request.rerun:
            others.append(stack.enter_context(_rerun(request.rerun, rig)))
        if net is not None:
            others.append(lambda result: None if result.is_lost else net.add(result.scan))
        yield RunWriters(folder, bare_lens, tuple(others))


def write_all(
    blocks: Iterable[list[FrameResult]], writers: RunWriters, stop: StopSignals, tick: Tick
) -> None:
    """Write all results until they end, or a signal stops the run."""
    for block in blocks:
        writers.folder.write(*(result.scan for result in block))
        writers.bare_lens.write(*block)
        for result in block:
            for write in writers.others:
                write(result)
        tick(len(block))
        if stop.caught:
            writers.folder.status = Status.INTERRUPTED
            return


def write_net(net: NetPass, request: RunRequest) -> list[str]:
    """Write the files on the state of the net, and return its summary as lines of text.

    Raises `OutputError` if a file cannot be written.
    """
    # The clock of a video may help to align the vehicle's log with it.
    video = Path(request.source) if Path(request.source).is_file() else None
    return net.write(request.out, video).lines
