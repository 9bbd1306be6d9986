"""The frames of a run: those of its window, and scans that stand for lost ones."""

import itertools
from collections.abc import Iterator

from aqualvs.app.run_inputs import FrameWindow
from aqualvs.errors import OptionError, SourceError
from aqualvs.live.sources import FrameSource
from aqualvs.scanning.posture import Reason, Refusal
from aqualvs.scanning.scan import Frame, Scan, ScanPoints


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
    """Yield each frame with the scans that stand for the lost frames right before it.

    Frames are counted from `first` on; None takes none of them for lost.
    """
    last_index, last_time_s = 0, 0.0
    for frame in frames:
        # Between two frames that came, the clock is taken to run evenly.
        step = (frame.time_s - last_time_s) / max(1, frame.index - last_index)
        lost = range(frame.index if first is None else first, frame.index)
        yield [_lost(i, last_time_s + (i - last_index) * step, n_water) for i in lost], frame
        first = None if first is None else frame.index + 1
        last_index, last_time_s = frame.index, frame.time_s


def _lost(index: int, time_s: float, n_water: float) -> Scan:
    """Return the scan of a frame that could not be decoded."""
    return Scan(index, time_s, Refusal(Reason.CORRUPT_FRAME), ScanPoints.none(), n_water)
