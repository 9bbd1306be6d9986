"""Runs one output so that whatever happens to it disturbs nothing else."""

import logging
import threading
from collections import deque
from dataclasses import replace

from aqualvs.live.health import PartHealth, State
from aqualvs.live.outputs.base import Output
from aqualvs.live.sample import LiveSample

# Samples that a recorder may be behind, which keep their pictures: 300 MB at 1920x1080.
_QUEUE = 100
_PATIENCE_S = 5.0
_log = logging.getLogger(__name__)


class OutputWorker:
    """Hands samples to an output, in a thread of its own unless the output never waits.

    Parameters
    ----------
    output : Output
        Owned from here on.
    """

    def __init__(self, output: Output) -> None:
        self._output = output
        self._trouble = ""
        self._n_dropped = 0
        self._waiting: deque[LiveSample] = deque()
        self._room = _QUEUE if output.keeps_all else 1
        self._changed = threading.Condition()
        self._closing = False
        self._thread: threading.Thread | None = None
        if not output.inline:
            self._thread = threading.Thread(target=self._work, name=output.name, daemon=True)
            self._thread.start()

    @property
    def name(self) -> str:
        """Name of the output."""
        return self._output.name

    def offer(self, sample: LiveSample) -> None:
        """Pass a sample on; returns at once."""
        if self._thread is None:
            self._send(sample)
            return
        with self._changed:
            if len(self._waiting) >= self._room:
                self._waiting.popleft()
                self._n_dropped += 1
            self._waiting.append(sample)
            self._changed.notify()

    def health(self) -> PartHealth:
        """Return how the output is, with what could not be handed to it."""
        try:
            found = self._output.health()
        except Exception as fault:
            return PartHealth(self.name, State.FAULT, f"{fault}", self._n_dropped)
        trouble = self._trouble
        if trouble:
            found = PartHealth(found.name, State.FAULT, trouble, found.n_dropped)
        elif self._output.keeps_all and self._n_dropped and found.state is State.OK:
            found = replace(found, state=State.WARN)
        return replace(found, n_dropped=found.n_dropped + self._n_dropped)

    def close(self) -> None:
        """Let what waits go out, for a few seconds at most, and close the output."""
        if self._thread is not None:
            with self._changed:
                self._closing = True
                self._changed.notify()
            self._thread.join(_PATIENCE_S)
            if self._thread.is_alive():
                _log.warning("%s: did not end in time", self.name)
        try:
            self._output.close()
        except Exception:
            _log.exception("%s: closing failed", self.name)

    def _work(self) -> None:
        while (sample := self._next()) is not None:
            self._send(sample)

    def _next(self) -> LiveSample | None:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._closing)
            return self._waiting.popleft() if self._waiting else None

    def _send(self, sample: LiveSample) -> None:
        try:
            self._output.send(sample)
        except Exception as fault:
            told = f"{fault}" or type(fault).__name__
            if told != self._trouble:
                _log.warning("%s: %s", self.name, told)
            self._trouble = told
        else:
            self._trouble = ""
