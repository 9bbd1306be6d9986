"""Stopping in good order: Ctrl-C and SIGTERM end the run after the current frame."""

import signal
import threading
from types import FrameType
from typing import Any, Self

from aqualvs.closing import Closing

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StopSignals(Closing):
    """Note a request to stop instead of dying from it; a context manager.

    The second request is no longer caught, so that whoever insists gets out. Outside of the main
    thread, where Python allows no handlers, nothing is caught.

    Attributes
    ----------
    caught : Signals or None
        The signal that asked to stop.
    """

    def __init__(self) -> None:
        self.caught: signal.Signals | None = None
        self._previous: dict[signal.Signals, Any] = {}

    @property
    def exit_code(self) -> int:
        """Exit code by the shell's convention: 128 + signal, 0 if there was none."""
        return 0 if self.caught is None else 128 + self.caught

    def __enter__(self) -> Self:
        """Catch the signals from here on."""
        if threading.current_thread() is threading.main_thread():
            self._previous = {s: signal.signal(s, self._note) for s in _SIGNALS}
        return self

    def close(self) -> None:
        """Put the previous handlers back."""
        self._restore()

    def _note(self, number: int, _frame: FrameType | None) -> None:
        self.caught = signal.Signals(number)
        self._restore()

    def _restore(self) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous = {}
