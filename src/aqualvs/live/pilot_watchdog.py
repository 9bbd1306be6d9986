"""Stops the thrusters when the loop that steers them does not come round."""

import logging
import threading
import time

from aqualvs.control.vehicle import NEUTRAL, Effort, VehicleLink

_LOOK_S = 0.02
_log = logging.getLogger(__name__)


class Watchdog:
    """Passes efforts on, and sends neutral after one that nobody renews.

    Neither a frame that takes seconds to measure nor a controller that hangs must leave thrust
    standing; the vehicle's own fail-safe comes later, and does not act while others send it sticks.

    Parameters
    ----------
    vehicle : VehicleLink
    patience_s : float
        So long an effort may stand.

    Attributes
    ----------
    n_barks : int
        How often it had to act.
    """

    def __init__(self, vehicle: VehicleLink, patience_s: float) -> None:
        self._vehicle, self._patience_s = vehicle, patience_s
        # Only ever held for a call that returns at once, so that nothing can keep neutral back.
        self._sending = threading.Lock()
        self._known_s = float("-inf")
        self._thrusting = threading.Event()
        self._closing = threading.Event()
        self.n_barks = 0
        self._thread = threading.Thread(target=self._run, name="pilot watchdog", daemon=True)
        self._thread.start()

    def send(self, effort: Effort, known_s: float) -> Effort:
        """Send an effort, or neutral in its place if it is too old already; return what was sent.

        Parameters
        ----------
        effort : Effort
        known_s : float
            When what it rests on was known, by `time.monotonic`.

        Raises
        ------
        OSError, ValueError
            As `VehicleLink.send`.
        """
        with self._sending:
            if time.monotonic() - known_s > self._patience_s:
                effort = NEUTRAL
            self._known_s = known_s
            # Before it is sent: one that went out in spite of an error is stopped all the same.
            if effort == NEUTRAL:
                self._thrusting.clear()
            else:
                self._thrusting.set()
            self._vehicle.send(effort)
        return effort

    def close(self) -> None:
        """End the thread; further calls do nothing."""
        self._closing.set()
        self._thrusting.set()
        self._thread.join(1.0)

    def _run(self) -> None:
        self._thrusting.wait()
        while not self._closing.wait(_LOOK_S):
            self._look()
            self._thrusting.wait()

    def _look(self) -> None:
        """Stop the thrusters if their effort has stood for too long."""
        with self._sending:
            late_s = time.monotonic() - self._known_s
            if not self._thrusting.is_set() or late_s <= self._patience_s:
                return
            try:
                self._vehicle.send(NEUTRAL)
            except OSError:
                # Tried again in a moment.
                return
            self._thrusting.clear()
            self.n_barks += 1
        _log.warning("no new posture for %.2f s: neutral", late_s)
