"""How a stream is received, for the pilot."""

import threading
import time
from collections import deque

from aqualvs.live.health import PartHealth, State

_WINDOW_S = 5.0
"""Rates and losses are told for so long."""

_SILENT_S = 0.5
"""Longer silence is a fault."""


class Reception:
    """What arrived and when; written by the source, read from another thread.

    Parameters
    ----------
    name : str
        Of the part.
    content : str
        What arrives, such as "RTP H.264"; may be set later.
    """

    def __init__(self, name: str, content: str = "") -> None:
        self.name = name
        self._lock = threading.Lock()
        self._content = content
        self._trouble = ""
        self._size = (0, 0)
        self._began = time.monotonic()
        self._heard: float | None = None
        self._frames: deque[float] = deque()
        self._losses: deque[tuple[float, int]] = deque()
        self._last_frame: float | None = None
        self._n_lost = 0
        self._n_held = 0
        self._over = ""

    def hear(self, content: str = "") -> None:
        """Note that something came; ends a trouble.

        Parameters
        ----------
        content : str
            What it is; empty if that is known.
        """
        with self._lock:
            self._heard = time.monotonic()
            self._content = content or self._content
            self._trouble = ""

    def complain(self, words: str) -> None:
        """Note why nothing of use comes, until something does.

        Parameters
        ----------
        words : str
            Empty if the reason is gone.
        """
        with self._lock:
            self._trouble = words

    def deliver(self, size_px: tuple[int, int], n_lost: int) -> None:
        """Note a frame that goes out.

        Parameters
        ----------
        size_px : (int, int)
            Width and height.
        n_lost : int
            Frames lost before it.
        """
        now = time.monotonic()
        with self._lock:
            self._size = size_px
            self._frames.append(now)
            self._last_frame = now
            self._n_held = 0
            if n_lost:
                self._losses.append((now, n_lost))
                self._n_lost += n_lost
            self._forget(now)

    def hold(self, n: int) -> None:
        """Note how many pictures are not delivered, since the last one that was, after a loss.

        Parameters
        ----------
        n : int
        """
        with self._lock:
            self._n_held = n

    def end(self, words: str) -> None:
        """Note that nothing more will come.

        Parameters
        ----------
        words : str
        """
        with self._lock:
            self._over = words

    def health(self) -> PartHealth:
        """Return the state in words."""
        now = time.monotonic()
        with self._lock:
            self._forget(now)
            state, words = self._state(now)
            return PartHealth(self.name, state, words, self._n_lost + self._n_held)

    def _forget(self, now: float) -> None:
        while self._frames and self._frames[0] < now - _WINDOW_S:
            self._frames.popleft()
        while self._losses and self._losses[0][0] < now - _WINDOW_S:
            self._losses.popleft()

    def _state(self, now: float) -> tuple[State, str]:
        if self._over:
            return State.OFF, self._over
        if self._trouble:
            return State.FAULT, self._trouble
        if self._heard is None:
            return State.FAULT, f"waiting for the stream for {now - self._began:.0f} s"
        if now - self._heard > self._patience():
            return State.FAULT, f"silent for {now - self._heard:.1f} s; waiting for its return"
        since = self._began if self._last_frame is None else self._last_frame
        if now - since > self._patience():
            why = "damaged or lost packets, no sound picture" if self._n_held else "no key frame"
            return State.FAULT, f"{self._content}: {why} for {now - since:.1f} s"
        return self._running()

    def _running(self) -> tuple[State, str]:
        span = self._frames[-1] - self._frames[0] if self._frames else 0.0
        rate = (len(self._frames) - 1) / max(span, 1.0)
        words = f"{self._content} {self._size[0]}x{self._size[1]} px, {rate:.1f} frames/s"
        n_lost = sum(n for _, n in self._losses)
        if not n_lost:
            return State.OK, words.strip()
        share = 100 * n_lost / (n_lost + len(self._frames))
        return State.WARN, f"{words}, {share:.1f} % lost".strip()

    def _patience(self) -> float:
        """Return the silence that is no fault: longer for a stream of few frames."""
        if len(self._frames) < 2:
            return max(_SILENT_S, 2.0 if self._last_frame is None else 0.0)
        return max(_SILENT_S, 3 * (self._frames[-1] - self._frames[0]) / (len(self._frames) - 1))
