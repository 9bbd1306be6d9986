"""Results for the frames of a run, measured by one process or by several.

Frames are those of the run's window; scans with a refusal stand for lost frames (`with_losses`).
"""

import itertools
from collections.abc import Generator, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Self

from aqualvs.closing import Closing
from aqualvs.errors import OptionError, SourceError
from aqualvs.optics.rig import Rig
from aqualvs.results.run_request import FrameWindow
from aqualvs.scanning.posture import Reason, Refusal
from aqualvs.scanning.scan import Frame, Scan, ScanPoints
from aqualvs.sources import FrameSource, ImageSource, VideoSource
from aqualvs.workers.frame_results import (
    FrameResult,
    Meter,
    ScansFrames,
    in_blocks,
    measured_blocks,
    read_ahead,
)
from aqualvs.workers.pool import Crew, CrewWork
from aqualvs.workers.replay import Replay


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
    for frame in frames:
        # Times of lost frames are interpolated linearly.
        step = (frame.time_s - last_time_s) / max(1, frame.index - last_index)
        lost = range(frame.index if first is None else first, frame.index)
        yield [_lost(i, last_time_s + (i - last_index) * step, n_water) for i in lost], frame
        first = None if first is None else frame.index + 1
        last_index, last_time_s = frame.index, frame.time_s


def _lost(index: int, time_s: float, n_water: float) -> Scan:
    """Return the scan of a frame that could not be decoded."""
    return Scan(index, time_s, Refusal(Reason.CORRUPT_FRAME), ScanPoints.none(), n_water)


class RunMeasuring(Closing):
    """Measurement of a dive's frames; a context manager, within which processes are at work.

    Parameters
    ----------
    source : FrameSource or Replay
        Open, and not yet read from.
    rig : Rig
    window : FrameWindow
        Of the frames to measure.
    work : CrewWork or None
        How processes may share the dive; None has this process measure it.
    n_processes : int
    """

    def __init__(
        self,
        source: FrameSource,
        rig: Rig,
        window: FrameWindow,
        work: CrewWork | None,
        n_processes: int,
    ) -> None:
        self._source, self._rig, self._window = source, rig, window
        self._crew = None if work is None else Crew(work, n_processes)
        self._head: list[FrameResult] | None = None
        self._shared: Iterator[list[FrameResult]] = iter(())
        self._frames: Iterator[Frame] = iter(())
        self._stack = ExitStack()

    def blocks(
        self, scanner: ScansFrames, *, one_by_one: bool
    ) -> Generator[list[FrameResult], None, None]:
        """Yield the results, in the order of the dive; to be closed before the source is.

        Parameters
        ----------
        scanner : ScansFrames
            For what this process measures.
        one_by_one : bool
            Whether nothing may be measured before what was found in the frame before is yielded.

        Raises
        ------
        SourceError
            From the source, at the end of what it has.
        """
        if self._head is not None and self._crew is not None:
            yield self._head
            yield from self._shared
            if self._crew.is_done:
                return
            # The effect of damage depends on the whole video; earlier results stay valid.
            self._window = replace(self._window, first=self._crew.next_frame)
            self._frames = window_of(self._source, self._window)
        # A recording contains its lost frames; frames that it lacks were skipped on purpose.
        first = None if isinstance(self._source, Replay) else self._window.first
        pairs = with_losses(self._frames, first, self._rig.n_water)
        ahead = _is_at_hand(self._source) and not one_by_one
        meter = Meter(self._rig, scanner)
        frames = in_blocks(pairs, meter.block_length if ahead else 1)
        yield from measured_blocks(read_ahead(frames) if ahead else frames, meter)

    def await_first(self) -> None:
        """Wait for the first frame; to be called before `blocks`.

        Raises
        ------
        SourceError, OptionError
            If there is none.
        """
        self._head = next(self._shared, None)
        if self._head is None:
            frames = window_of(self._source, self._window)
            self._frames = ready(frames, self._source, self._window)

    def __enter__(self) -> Self:
        """Start the processes."""
        if self._crew is not None:
            self._shared = self._stack.enter_context(self._crew).blocks()
        return self

    def close(self) -> None:
        """End the processes."""
        self._stack.close()


def _is_at_hand(source: FrameSource) -> bool:
    """Return whether frames come as fast as they are asked for."""
    return isinstance(source, VideoSource | ImageSource) and Path(source.name).exists()
