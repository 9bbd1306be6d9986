"""What pilot and controller agree on: the range and yaw to hold."""

import math
import threading
from dataclasses import dataclass

from aqualvs.errors import OptionError


@dataclass(frozen=True, slots=True)
class Setpoint:
    """Wanted posture to the target.

    Attributes
    ----------
    range : float
        Metres.
    yaw : float
        Radians, as `Posture.yaw`; 0 is square to the target.
    """

    range: float
    yaw: float = 0.0


class SetpointHolder:
    """One setpoint for all threads; None until somebody sets it.

    Parameters
    ----------
    working_range : (float, float)
        A range outside of it cannot be measured, so it cannot be held, in metres.
    """

    MAX_YAW = math.radians(45.0)
    """Beyond this the lasers leave the target, in radians."""

    def __init__(self, working_range: tuple[float, float]) -> None:
        self.working_range = working_range
        self._lock = threading.Lock()
        self._setpoint: Setpoint | None = None

    @property
    def setpoint(self) -> Setpoint | None:
        """The setpoint in force."""
        with self._lock:
            return self._setpoint

    def put(self, setpoint: Setpoint | None) -> None:
        """Set, or take back.

        Raises
        ------
        OptionError
            If it cannot be held; the one in force stays.
        """
        if setpoint is not None:
            self._check(setpoint)
        with self._lock:
            self._setpoint = setpoint

    def _check(self, setpoint: Setpoint) -> None:
        near, far = self.working_range
        if not near <= setpoint.range <= far:
            raise OptionError(
                f"setpoint: range {setpoint.range:g} m is outside the working range; "
                f"choose {near:.2f} to {far:.2f} m"
            )
        if not abs(setpoint.yaw) <= self.MAX_YAW:
            raise OptionError(
                f"setpoint: yaw {math.degrees(setpoint.yaw):g} deg; choose at most "
                f"{math.degrees(self.MAX_YAW):.0f} deg to either side"
            )
