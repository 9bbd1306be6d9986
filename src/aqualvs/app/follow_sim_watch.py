"""What is told while a loop is simulated, and when it ends."""

import math
from collections.abc import Callable

from aqualvs.app.follow_sim import SimulatedLoop
from aqualvs.app.stopping import StopSignals
from aqualvs.control.mission import Stage
from aqualvs.control.safety import Reason

_TELL_EVERY_S = 10.0
# A plan that is over goes on to hold: long enough to see that it does.
_HOLDS_ON_S = 5.0
# A report needs some rows.
_LEAST_S = 1.0


class RunWatch:
    """Called before each frame; returns whether to go on.

    Parameters
    ----------
    loop : SimulatedLoop
    seconds : float
        Of the whole run.
    tell : callable
        Takes one line.
    stop : StopSignals
    slow : bool
        Whether a second takes seconds, so that the way is told.
    """

    def __init__(
        self,
        loop: SimulatedLoop,
        seconds: float,
        tell: Callable[[str], object],
        stop: StopSignals,
        *,
        slow: bool,
    ) -> None:
        self._loop, self._seconds, self._tell, self._stop = loop, seconds, tell, stop
        self._told_s = 0.0 if slow else math.inf
        self._over_s = math.inf

    def __call__(self, now_s: float) -> bool:
        """Tell what has changed; False ends the run."""
        if now_s - self._told_s >= _TELL_EVERY_S:
            self._told_s = now_s
            self._tell(f"simulated {now_s:.0f} of {self._seconds:g} s")
        if not self._loop.steering.engaged:
            self._tell(f"at {now_s:.1f} s: {self._last_words()}; here a pilot takes over")
            return False
        if self._over_s == math.inf and self._is_over():
            self._over_s = now_s
            self._tell(f"at {now_s:.1f} s: {Reason.MISSION_OVER.words}")
        stopped = self._stop.caught is not None and now_s >= _LEAST_S
        return not stopped and now_s < self._over_s + _HOLDS_ON_S

    def _is_over(self) -> bool:
        rows = self._loop.log.rows
        return bool(rows) and rows[-1].stage == Stage.OVER.value

    def _last_words(self) -> str:
        reason = self._loop.steering.gate.latched
        return "disengaged" if reason is None else reason.words
