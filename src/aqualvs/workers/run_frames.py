"""Results for the frames of a run, measured by one process or by several.

Frames are those of the run's window; scans with a refusal stand for lost frames (`with_losses`).
`Replay` measures the stripes of a recording again, bit for bit. The water's refractive index is
tracked during a run by a target on the vehicle (paper, 2.2). Modules that read recordings or
calibrate are imported where they are used, because few runs need them.
"""

import itertools
from collections.abc import Generator, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from aqualvs.closing import Closing
from aqualvs.errors import OptionError, SourceError
from aqualvs.optics.rig import Rig, common_wavelength
from aqualvs.optics.solved import rig_uncertainty
from aqualvs.optics.water import Dispersion
from aqualvs.results.run_request import FrameWindow, RunRequest, Water, in_water, prepared_rig
from aqualvs.scanner import Scanner, ScannerOptions
from aqualvs.scanning.posture import Reason, Refusal
from aqualvs.scanning.scan import Frame, ImagePlane, Scan, ScanPoints
from aqualvs.sources import FrameSource, ImageSource, VideoSource
from aqualvs.sources.fields import field_of, source_of_pictures, whole_luma
from aqualvs.text import count_text
from aqualvs.workers.frame_results import (
    FrameProcessor,
    FrameResult,
    FrameScanner,
    RecordableScanner,
    ScanInputs,
    corrected_rows,
    in_blocks,
    read_ahead,
    result_blocks,
)
from aqualvs.workers.pool import PoolJob, WorkerPool

if TYPE_CHECKING:
    from aqualvs.calibration.water_index.state import IndexReading
    from aqualvs.recording import DiveRecording, RecordedFrame


@dataclass(frozen=True, slots=True)
class ReplayedFrame(Frame):
    """A frame from a recording; black where the recording has no picture."""

    # Never None; only a base class with defaults asks for one.
    recorded: "RecordedFrame | None" = None


class Replay(Closing, RecordableScanner):
    """A recording that is measured again; both `FrameSource` and scanner of a run.

    Rig, water and the `chosen` options of the request stand for the recorded ones; an overlay needs
    pictures even if stripes are not looked for again. Raises `SourceError`, `RigError` or
    `OptionError` if the recording or the rig cannot be used, or the recording lacks the pictures
    that the request needs.
    """

    def __init__(self, path: Path, request: RunRequest) -> None:
        from aqualvs.recording import DiveRecording

        self._recording = recording = DiveRecording(path)
        self.name = str(path)
        # Options and rig to measure with.
        self.options, no_dome = request.scanner, request.no_dome
        if request.chosen is not None and recording.options is not None:
            own = {name: getattr(request.scanner, name) for name in request.chosen}
            self.options = replace(recording.options, **own)
        if request.rig is not None:
            self.rig = prepared_rig(request.rig, request.water, no_dome=no_dome)
        else:
            self.rig = in_water(recording.need_rig(), request.water, no_dome=no_dome)
        self.size_px, self.fps = (recording.rig or self.rig).size_px, recording.fps
        self.n_frames = recording.n_frames
        self._follows = request.rig is None and request.water == Water()
        self._detects = _detects(recording, request, self.options)
        self._pictures = self._detects or request.overlay
        self._scanner = Scanner(self.rig, self.options)
        width, height = self.size_px
        self._black: ImagePlane = np.zeros((height, width), np.uint8)

    def __iter__(self) -> Iterator[ReplayedFrame]:
        """Yield the recorded frames.

        Raises `SourceError` at the end, if parts of the recording were torn.
        """
        for recorded in self._recording.frames(with_pictures=self._pictures):
            frame = recorded.picture or Frame(recorded.index, recorded.time_s, self._black)
            field = self.rig.shutter.field_of(recorded.index)
            # A picture for viewers has each row of a field twice.
            if field is not None and len(frame.luma) == self.size_px[1]:
                frame = field_of(frame, field)
            yield ReplayedFrame(
                recorded.index,
                recorded.time_s,
                frame.luma,
                frame.chroma,
                field=field,
                recorded=recorded,
            )
        if self._recording.n_torn:
            raise SourceError(
                f"{self.name}: {self._recording.n_torn} of its parts are damaged, as by a loss of "
                "power, and were left out; the others were measured"
            )

    def process_with_inputs(self, frame: Frame) -> tuple[Scan, ScanInputs]:
        """Return the scan of a frame of this source, with its rig and stripes."""
        recorded = frame.recorded if isinstance(frame, ReplayedFrame) else None
        if recorded is None:
            raise ValueError("a replay measures its own frames only")
        if recorded.refusal is not None:
            nothing = ScanPoints.none()
            scan = Scan(frame.index, frame.time_s, recorded.refusal, nothing, recorded.n_water)
            return scan, ScanInputs(self.rig, {})
        # The water as the dive's run knew it.
        if self._follows and recorded.n_water != self._scanner.rig.n_water:
            self._scanner = Scanner(self.rig.in_water(recorded.n_water), self.options)
        scanner, peaks = self._scanner, recorded.peaks
        if self._detects:
            peaks, scan = scanner.scan(frame)
        else:
            scan = scanner.measure(frame.index, frame.time_s, peaks)
        return replace(scan, turning=recorded.turning), ScanInputs(scanner.rig, peaks)


def replay_of(request: RunRequest) -> Replay | None:
    """Return the replay of a request's source, None where it is no recording.

    Raises `AqualvsError` as `Replay` does.
    """
    path = Path(request.source)
    if path.suffix.lower() != ".mcap":
        return None
    from aqualvs.recording import is_recording

    return Replay(path, request) if is_recording(path) else None


def _detects(recording: "DiveRecording", request: RunRequest, options: ScannerOptions) -> bool:
    """Return whether stripes must be looked for again, in the recorded pictures."""
    if recording.options is not None and options.detector != recording.options.detector:
        wanted = "--detector: this detector needs the pictures, which"
    elif request.index_target is not None:
        wanted = "--index-target: the target is looked for in the pictures, which"
    else:
        return False
    if not recording.has_pictures:
        raise OptionError(
            f"{wanted} {recording.path} does not hold; leave it out, or run the video"
        )
    return True


def window_of(source: FrameSource, window: FrameWindow) -> Iterator[Frame]:
    """Yield the frames of a source that lie in a window."""
    for frame in source:
        if window.stop is not None and frame.index >= window.stop:
            return
        if frame.index >= window.first:
            yield frame


def ready(frames: Iterator[Frame], source: FrameSource, window: FrameWindow) -> Iterator[Frame]:
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


def with_losses(
    frames: Iterator[Frame], first: int | None, n_water: float
) -> Iterator[tuple[list[Scan], Frame]]:
    """Yield each frame with the scans of the lost frames right before it.

    Frames are counted from `first` on; None takes none of them for lost.
    """
    last_index, last_time_s = 0, 0.0
    refusal, nothing = Refusal(Reason.CORRUPT_FRAME), ScanPoints.none()
    for frame in frames:
        # Times of lost frames are interpolated linearly.
        step = (frame.time_s - last_time_s) / max(1, frame.index - last_index)
        lost = range(frame.index if first is None else first, frame.index)
        times = [(i, last_time_s + (i - last_index) * step) for i in lost]
        yield [Scan(*at, refusal, nothing, n_water) for at in times], frame
        first = None if first is None else frame.index + 1
        last_index, last_time_s = frame.index, frame.time_s


class DiveProcessor(Closing):
    """Measurement of a dive's frames; a context manager, within which processes measure.

    `source` is open, and not yet read from. `window` is that of the frames to measure, and `job`
    how processes may share the dive; None has this process measure it.
    """

    def __init__(
        self,
        source: FrameSource,
        rig: Rig,
        window: FrameWindow,
        job: PoolJob | None,
        n_processes: int,
    ) -> None:
        self._source, self._rig, self._window = source, rig, window
        self._pool = None if job is None else WorkerPool(job, n_processes)
        self._first_block: list[FrameResult] | None = None
        self._pool_blocks: Iterator[list[FrameResult]] = iter(())
        self._frames: Iterator[Frame] = iter(())
        self._stack = ExitStack()

    def blocks(self, scanner: FrameScanner) -> Generator[list[FrameResult], None, None]:
        """Yield the results, in the order of the dive; to be closed before the source is.

        Those of a rolling shutter are corrected.

        `scanner`: measures what the pool does not. Raises `SourceError` from the source, after the
        results of all frames before the fault.
        """
        return corrected_rows(self._measured(scanner), self._rig)

    def _measured(self, scanner: FrameScanner) -> Generator[list[FrameResult], None, None]:
        if self._first_block is not None and self._pool is not None:
            yield self._first_block
            yield from self._pool_blocks
            if self._pool.is_done:
                return
            # The effect of damage depends on the whole video; earlier results stay valid.
            self._window = replace(self._window, first=self._pool.next_frame)
            self._frames = window_of(self._source, self._window)
        # A recording contains its lost frames; frames that it lacks were skipped on purpose.
        first = None if isinstance(self._source, Replay) else self._window.first
        pairs = with_losses(self._frames, first, self._rig.n_water)
        # Whether frames come as fast as they are asked for.
        is_file = isinstance(source_of_pictures(self._source), VideoSource | ImageSource)
        ahead = is_file and Path(self._source.name).exists()
        processor = FrameProcessor(self._rig, scanner)
        frames = in_blocks(pairs, processor.block_length if ahead else 1)
        yield from result_blocks(read_ahead(frames) if ahead else frames, processor)

    def wait_for_first(self) -> None:
        """Wait for the first frame; to be called before `blocks`.

        Raises `SourceError` or `OptionError` if there is none.
        """
        self._first_block = next(self._pool_blocks, None)
        if self._first_block is None:
            frames = window_of(self._source, self._window)
            self._frames = ready(frames, self._source, self._window)

    def __enter__(self) -> Self:
        """Start the processes."""
        if self._pool is not None:
            self._pool_blocks = self._stack.enter_context(self._pool).blocks()
        return self

    def close(self) -> None:
        """End the processes."""
        self._stack.close()


# Reading the target's markers takes longer than measuring a frame; the index hardly changes.
_FIRST_FRAMES, _EVERY_S = 5, 0.4


class WaterFollowingScanner(RecordableScanner):
    """Scanner that measures each frame in the water as tracked by the index target.

    `rig` is in the water to begin with, and `target` holds the markers on the vehicle
    (target.yaml). Temperature and salinity of `water`, if given, are a prior. Raises
    `CalibrationError` if the target's file cannot be used.
    """

    def __init__(self, rig: Rig, options: ScannerOptions, target: Path, water: Water) -> None:
        from aqualvs.calibration.targets.target_files import load_target
        from aqualvs.calibration.water_index.estimator import IndexEstimator
        from aqualvs.calibration.water_index.state import IndexOptions, IndexPrior

        if rig.housing is None:
            raise OptionError("--index-target: without a housing the water's index cannot be seen")
        self._rig, self._options, self._target = rig, options, target
        self.scanner = Scanner(rig, options)  # For the water as it is known.
        self._markers = load_target(target)
        prior = None
        if water.seawater is not None:
            prior = IndexPrior.seawater(*water.seawater, n_air=rig.n_air)
        # Only the index is tracked.
        self._estimator = IndexEstimator(
            rig, uncertainty=rig_uncertainty(rig), prior=prior, options=IndexOptions.of_target()
        )
        # The target is seen in green or white light.
        self._light = Dispersion.of(common_wavelength(rig.lasers), rig.n_air)
        self._next_s = -np.inf
        self._n_read = 0
        self._last: IndexReading | None = None

    def process_with_inputs(self, frame: Frame) -> tuple[Scan, ScanInputs]:
        """Measure a frame, and return the rig and the stripes that it was measured with."""
        if self.is_due(frame):
            self.look(frame)
        peaks, scan = self.scanner.scan(frame)
        return scan, ScanInputs(self.scanner.rig, peaks)

    @property
    def sigma_n_water(self) -> float:
        """Standard deviation of the index; NaN until the target has been seen."""
        last = self._last
        return float("nan") if last is None else self._light.sigma(last.n, last.sigma)

    def lines(self) -> list[str]:
        """Return the lines of the run's summary about the water."""
        last = self._last
        if last is None:
            return [
                f"{self._target}: the target was never seen; measured with index "
                f"{self._rig.n_water:.4f}"
            ]
        found = [
            f"water index {self._light.from_green(last.n):.5f} ± {self.sigma_n_water:.5f} from "
            f"{count_text(self._n_read, 'frame')}"
        ]
        if not last.observable:
            found.append("the pictures alone do not determine the index; see aqualvs check")
        return found + [step.text() for step in self._estimator.steps]

    def is_due(self, frame: Frame) -> bool:
        """Return whether the target should be read in this frame."""
        return self._n_read < _FIRST_FRAMES or frame.time_s >= self._next_s

    def look(self, frame: Frame) -> None:
        """Read the target in a frame; makes another scanner if the water has changed."""
        from aqualvs.calibration.detection.detection import detect_markers
        from aqualvs.calibration.targets.targets import View

        self._next_s = frame.time_s + _EVERY_S
        view = detect_markers(whole_luma(frame), self._markers, f"frame {frame.index}")
        if not isinstance(view, View):
            return
        reading = self._estimator.add(frame.time_s, view)
        if not reading:
            return
        self._last, self._n_read = reading, self._n_read + 1
        # Smaller changes of the index change the range by less than 0.003 % and need no new
        # scanner.
        worth = 2e-4
        min_sigma_to_follow = 4e-3
        trusted = reading.sigma < min_sigma_to_follow
        n_water = self._light.from_green(reading.n)
        if trusted and abs(n_water - self.scanner.rig.n_water) > worth:
            self.scanner = Scanner(self._rig.in_water(max(n_water, 1.0)), self._options)
