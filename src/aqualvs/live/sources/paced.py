"""A recording as a live feed."""

import threading
import time
from collections.abc import Iterator

from aqualvs.live.health import PartHealth, State
from aqualvs.live.sources.base import FrameSource
from aqualvs.scanning.scan import Frame


class PacedFeed:
    """Frames of a file or folder, by their own clock or as fast as they are taken.

    Parameters
    ----------
    source : FrameSource
        Closed at the end.
    realtime : bool
        Whether each frame waits for its time. A consumer that is late is not made later: frames
        that are due come at once.

    Attributes
    ----------
    name : str
        Of the source.
    """

    def __init__(self, source: FrameSource, *, realtime: bool) -> None:
        self.name = source.name
        self._source = source
        self._realtime = realtime
        self._closed = threading.Event()
        self._state, self._words = State.OK, "not begun"
        self._n_lost, self._last_index = 0, -1

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames until the source ends or `close` is called.

        Raises
        ------
        SourceError
            At the end, if the recording is cut short.
        """
        with self._source as source:
            began = time.monotonic()
            for frame in source:
                if not self._is_due(began + frame.time_s):
                    break
                self._note(frame)
                yield frame
        self._state, self._words = State.OFF, "closed" if self._closed.is_set() else "at its end"

    def health(self) -> PartHealth:
        """Return how far it is."""
        return PartHealth(self.name, self._state, self._words, self._n_lost)

    def close(self) -> None:
        """End the iteration."""
        self._closed.set()

    def _is_due(self, when: float) -> bool:
        """Wait for a frame's time; False if closed meanwhile."""
        if self._realtime:
            return not self._closed.wait(max(0.0, when - time.monotonic()))
        return not self._closed.is_set()

    def _note(self, frame: Frame) -> None:
        self._n_lost += frame.index - self._last_index - 1
        self._last_index = frame.index
        total = f" of {self._source.n_frames}" if self._source.n_frames else ""
        self._words = f"frame {frame.index + 1}{total}, {frame.time_s:.1f} s"
