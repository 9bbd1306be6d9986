"""Following the water's index beside a live run, so that no frame waits for it."""

import queue
import threading

from aqualvs.app.run_water import WaterFollowingScanner
from aqualvs.scanning.pipeline import Scanner
from aqualvs.scanning.scan import Frame

_PATIENCE_S = 3.0


class WaterFollower:
    """Supplies the scanner for the water as it is known, from a thread that reads the target.

    Parameters
    ----------
    following : WaterFollowingScanner
        Looks at the target; used by the thread alone from here on.
    """

    def __init__(self, following: WaterFollowingScanner) -> None:
        self._following = following
        self._frames: queue.Queue[Frame | None] = queue.Queue(1)
        self._scanner, self._sigma = following.scanner, following.sigma_n_water
        self._thread = threading.Thread(target=self._look, name="water", daemon=True)
        self._thread.start()

    @property
    def scanner(self) -> Scanner:
        """The one to use for the next frame."""
        return self._scanner

    @property
    def sigma_n_water(self) -> float:
        """Standard deviation of its index; NaN until the target has been seen."""
        return self._sigma

    def offer(self, frame: Frame) -> None:
        """Have a frame looked at when it is due and nobody is looking."""
        if self._following.is_due(frame) and self._frames.empty():
            self._frames.put_nowait(frame)

    def close(self) -> None:
        """End the thread."""
        if not self._thread.is_alive():
            return
        while not self._frames.empty():
            self._frames.get_nowait()
        self._frames.put(None)
        self._thread.join(_PATIENCE_S)

    def _look(self) -> None:
        while (frame := self._frames.get()) is not None:
            self._following.look(frame)
            self._scanner = self._following.scanner
            self._sigma = self._following.sigma_n_water
