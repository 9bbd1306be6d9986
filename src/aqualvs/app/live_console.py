"""What a live run says in the terminal: one line that stays, or a line now and then in a log."""

import math
import sys
import time
from typing import TextIO

from aqualvs.live.health import PartHealth, State
from aqualvs.live.sample import LiveSample
from aqualvs.scanning.posture import Posture

_SCREEN_EVERY_S, _LOG_EVERY_S = 0.2, 10.0


class Console:
    """An output for whoever started the run.

    Parameters
    ----------
    stream : file, optional
        Standard error if left out.
    """

    name = "console"
    inline = False
    keeps_all = False

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._on_screen = self._stream.isatty()
        self._next_s = -math.inf
        self._parts: dict[str, tuple[State, str]] = {}

    def send(self, sample: LiveSample) -> None:
        """Tell of parts that have changed at once, and of the posture when it is time."""
        self._tell_changes(sample)
        now_s = time.monotonic()
        if now_s < self._next_s:
            return
        self._next_s = now_s + (_SCREEN_EVERY_S if self._on_screen else _LOG_EVERY_S)
        self._write(status_line(sample), stays=False)

    def health(self) -> PartHealth:
        """Return that all is well: the terminal shows by itself if not."""
        return PartHealth(self.name, State.OK)

    def close(self) -> None:
        """Leave the line that stayed."""
        if self._on_screen and math.isfinite(self._next_s):
            self._stream.write("\n")
            self._stream.flush()

    def _tell_changes(self, sample: LiveSample) -> None:
        health = sample.health
        for part in (health.source, *health.lasers, *health.outputs):
            before = self._parts.get(part.name, (State.OFF, ""))[0]
            self._parts[part.name] = part.state, part.detail
            alarming = part.state in (State.WARN, State.FAULT)
            if part.state is not before and (alarming or before in (State.WARN, State.FAULT)):
                self._write(f"{part.name}: {part.state.value}: {part.detail}", stays=True)

    def _write(self, line: str, *, stays: bool) -> None:
        if self._on_screen:
            self._stream.write(f"\r\x1b[K{line}" + ("\n" if stays else ""))
        else:
            self._stream.write(f"{line}\n")
        self._stream.flush()


def status_line(sample: LiveSample) -> str:
    """Return posture and health of a sample in one line."""
    posture, health = sample.scan.posture, sample.health
    if isinstance(posture, Posture):
        sigma = posture.total_covariance.diagonal() ** 0.5
        told = (
            f"range {posture.range:.3f} ± {sigma[0]:.3f} m  "
            f"yaw {math.degrees(posture.yaw):+.1f} ± {math.degrees(sigma[2]):.1f} deg  "
            f"pitch {math.degrees(posture.pitch):+.1f} ± {math.degrees(sigma[1]):.1f} deg"
        )
    else:
        told = f"no posture: {posture.detail or posture.reason.value}"
    total = health.delays[-1] if health.delays else None
    delay = "" if total is None else f"  {1e3 * total.median_s:.1f} ms"
    dropped = f"  {health.n_dropped} dropped" if health.n_dropped else ""
    return f"{told}  | {health.rate_hz:.0f} Hz{delay}{dropped}"
