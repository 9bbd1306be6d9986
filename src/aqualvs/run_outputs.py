"""Outputs of a run: the files of its folder, its report, and the comparison with the truth.

`RunWriters` writes all files frame by frame. Its parts, beside the folder itself:

- `RunBareLens`: `posture_bare.csv`, the posture without the dome model.
- `RunOverlay`: `overlay.mp4`, the video of what the scanner detected.
- `RunMcap`: `dive.mcap`, the recording, on request.
- `RunRerun`: a file of Rerun, on request.
- `NetPass`: the state of the net, on request.
"""

import statistics
import time
from array import array
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from aqualvs.closing import Closing
from aqualvs.errors import OptionError, OutputError
from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import rig_to_mapping
from aqualvs.report.overlay import OverlayWriter, draw_overlay
from aqualvs.results.files import Claim, writing
from aqualvs.results.folder import (
    DIVE_MCAP,
    NET_MAP_PNG,
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
from aqualvs.scanner import ScannerOptions
from aqualvs.scanning.posture import Posture
from aqualvs.scanning.scan import Frame, Scan
from aqualvs.sources import FrameSource
from aqualvs.sources.base import bgr_of
from aqualvs.special_files import refuse_special
from aqualvs.terminal import StopSignals, Tick
from aqualvs.workers.frame_results import FrameResult, ScanInputs

if TYPE_CHECKING:
    from aqualvs.recording.sample import LiveSample


class RunMcap(Closing):
    """Writer of `dive.mcap` during a run; a context manager.

    Parameters
    ----------
    rig : Rig
        For frames that were lost.
    options : ScannerOptions
        That the run measures with.

    Raises
    ------
    OutputError
        From every method, if the file cannot be written.
    """

    def __init__(self, folder: Path, rig: Rig, options: ScannerOptions) -> None:
        # Few runs write one.
        from aqualvs.recording import RecorderOptions, Recording

        self._path, self._rig = folder / DIVE_MCAP, rig
        self._began_ns = time.time_ns()
        with writing(self._path):
            self._recording = Recording(self._path, RecorderOptions(scanner=options))

    def write(self, result: FrameResult) -> None:
        """Record the next scan, with the rig and the stripes that it was computed from.

        A frame that was lost has no stripes.
        """
        inputs = result.inputs or ScanInputs(self._rig, {})
        with writing(self._path):
            self._recording.write(_sample(self._began_ns, result.scan, inputs))

    def close(self) -> None:
        """Close the file; readable in any case."""
        with writing(self._path):
            self._recording.close()


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


class RunRerun(Closing):
    """Writer of a file of Rerun during a run; a context manager.

    Raises `OutputError` if the file cannot be written. Raises `OptionError` if rerun-sdk is not
    installed.
    """

    def __init__(self, path: Path, rig: Rig) -> None:
        from aqualvs.recording import rerun_log

        self._rig = rig
        self._log = rerun_log.RerunLog()
        with writing(path):
            self._log.save(path)

    def write(self, frame: Frame | None, scan: Scan) -> None:
        """Log the result of a frame."""
        self._log.write(_sample(0, scan, ScanInputs(self._rig, {}), frame))

    def close(self) -> None:
        """Finish the file."""
        self._log.close()


def check_source_stays(folder: Path, source: str) -> None:
    """Make sure that a run does not replace its own source.

    Raises `OptionError` if the run's own source would be replaced.
    """
    path = Path(source)
    is_ours = path.is_file() and path.name in RUN_FILES
    if is_ours and path.resolve().parent == folder.resolve():
        raise OptionError(f"{path}: is what the run reads; write to another folder")


class RunOverlay(Closing):
    """Writer of `overlay.mp4` during a run; a context manager.

    `source`: gives size and rate of the video. Raises `OutputError` from every method, if the video
    cannot be written.
    """

    def __init__(self, folder: Path, rig: Rig, source: FrameSource) -> None:
        self._path = folder / OVERLAY_MP4
        self._rig = rig
        fps_without_clock = 25.0
        fps = source.fps or fps_without_clock
        self._writer = OverlayWriter(self._path, source.size_px, fps)

    def write(self, frame: Frame | None, scan: Scan) -> None:
        """Append a picture; a lost frame gives a black one, so that frames keep their number."""
        width, height = self._rig.size_px
        image = np.zeros((height, width, 3), np.uint8)
        if frame is not None:
            shown = bgr_of(frame)
            image[: len(shown)] = shown
        with writing(self._path):
            self._writer.write(draw_overlay(image, scan.points, scan.posture, self._rig))

    def close(self) -> None:
        """Finish the video."""
        with writing(self._path):
            self._writer.close()


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


@dataclass(frozen=True, slots=True)
class RunWriters:
    """Everything that a run writes frame by frame; None for what was not requested."""

    folder: RunOutputs
    bare_lens: RunBareLens
    overlay: RunOverlay | None
    mcap: RunMcap | None
    rerun: RunRerun | None
    net: NetPass | None

    def write(self, *results: FrameResult) -> None:
        """Write the results of frames, and scans of lost ones, in their order."""
        self.folder.write(*(result.scan for result in results))
        self.bare_lens.write(*results)
        for result in results:
            if self.overlay is not None:
                self.overlay.write(result.frame, result.scan)
            if self.rerun is not None:
                self.rerun.write(result.frame, result.scan)
            if self.mcap is not None:
                self.mcap.write(result)
            if self.net is not None and not result.is_lost:
                self.net.add(result.scan)


def claim_outputs(request: RunRequest) -> ExitStack:
    """Make sure that the run can be written, and return its claims, to be closed at its end.

    Raises `OutputError` if it cannot, or its folder holds another that may not be replaced. Raises
    `OptionError` if a file of Rerun is requested but cannot be.
    """
    check_source_stays(request.out, request.source)
    with ExitStack() as claims:
        if request.rerun is not None:
            claims.callback(_claim_rerun(request.rerun, overwrite=request.overwrite).close)
        claims.callback(prepare_folder(request.out, overwrite=request.overwrite).close)
        return claims.pop_all()


def _claim_rerun(path: Path, *, overwrite: bool) -> Claim:
    from aqualvs.recording.rerun_log import RRD, rerun_sdk

    if path.suffix != RRD:
        raise OptionError(f"--rerun {path}: give a file that ends in {RRD}")
    rerun_sdk()
    refuse_special(path, OutputError, f"give a file that ends in {RRD}")
    return Claim("run", [path], overwrite=overwrite)


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
    with (
        folder,
        RunOverlay(request.out, rig, source) if request.overlay else nullcontext() as overlay,
        RunBareLens(request.out, rig) as bare_lens,
        RunMcap(request.out, rig, request.scanner) if request.mcap else nullcontext() as mcap,
        RunRerun(request.rerun, rig) if request.rerun else nullcontext() as rerun,
    ):
        yield RunWriters(folder, bare_lens, overlay, mcap, rerun, net)


def write_all(
    blocks: Iterable[list[FrameResult]], writers: RunWriters, stop: StopSignals, tick: Tick
) -> None:
    """Write all results until they end, or a signal stops the run."""
    for block in blocks:
        writers.write(*block)
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
    result = net.write(request.out, video)
    return [*result.lines, f"map of the net: {request.out / NET_MAP_PNG}"]
