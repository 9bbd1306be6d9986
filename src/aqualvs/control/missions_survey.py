"""Survey a net as one mows a lawn: along it, down a step, and back."""

import math
from dataclasses import dataclass
from enum import StrEnum

from aqualvs.control.mission import Guidance, LossOptions, LossWatch, Stage
from aqualvs.control.missions_follow import Leg, LegOptions, bearing_of, paced
from aqualvs.control.setpoint import Setpoint
from aqualvs.control.vehicle import VehicleState
from aqualvs.errors import OptionError
from aqualvs.scanning.posture import Posture

# Descent asked for by a depth's error, in m/s per m, and how near a depth must be come to.
_DESCENT_GAIN, _DEPTH_REACHED = 0.8, 0.07
# Seconds that a depth must be kept before the next leg, so that a wave does not count.
_DEPTH_STEADY_S = 1.0


class Turn(StrEnum):
    """What happens at the end of a leg."""

    BACK = "back"
    """The next leg goes the other way: a part of a net."""
    ON = "on"
    """The next leg goes on the same way: round a cage."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyOptions:
    """The lawn and the mower.

    Attributes
    ----------
    depths : tuple of float
        One leg at each, in this order; metres, down positive.
    sway : float
        Speed of the first leg through the water, to the right positive, in m/s.
    leg : LegOptions
        Where each leg ends.
    turn : Turn
        Whether the next leg goes back or on.
    descent : float
        Greatest speed between depths, in m/s.
    patience : float
        Seconds that a change of depth may take beyond what it should before the next leg begins
        all the same: something is in the way.
    """

    depths: tuple[float, ...]
    sway: float
    leg: LegOptions
    turn: Turn = Turn.BACK
    descent: float = 0.1
    patience: float = 20.0

    def __post_init__(self) -> None:
        """Refuse what has no end or no direction.

        Raises
        ------
        OptionError
            Naming the value.
        """
        if not self.depths or not all(depth >= 0.0 for depth in self.depths):
            raise OptionError(f"survey: depths {list(self.depths)} m; give one or more, 0 or more")
        if not (self.sway != 0.0 and math.isfinite(self.sway)):
            raise OptionError(f"survey: speed {self.sway:g} m/s; choose one, or hold instead")
        if not self.leg.ends:
            raise OptionError("survey: legs have no end; give a time, a distance or bearings")
        if not (self.descent > 0.0 and self.patience > 0.0):
            raise OptionError(
                f"survey: descent {self.descent:g} m/s, patience {self.patience:g} s; must be "
                "positive"
            )


class SurveyMission:
    """Legs along the net, one at each depth.

    The vehicle's own depth hold keeps the depth on the way; between legs it is asked to sink or
    rise, holding range and yaw. Without a known depth, changes wait.

    Parameters
    ----------
    setpoint : Setpoint
        Range and yaw on the way.
    options : SurveyOptions
        The lawn.
    loss : LossOptions, optional
        What to do without the target.

    Attributes
    ----------
    i_leg : int
        The leg gone now, or whose depth is sought; counts from 0.
    """

    def __init__(
        self, setpoint: Setpoint, options: SurveyOptions, *, loss: LossOptions | None = None
    ) -> None:
        self.setpoint = setpoint
        self._options = options
        self._watch = LossWatch(loss)
        self.i_leg = 0
        self._leg: Leg | None = None
        self._begin_change()

    @property
    def sways(self) -> bool:
        """Whether it needs a vehicle that can move sideways: always."""
        return True

    @property
    def depth(self) -> float:
        """Of the present leg, in metres."""
        return self._options.depths[min(self.i_leg, len(self._options.depths) - 1)]

    def restart(self) -> None:
        """Go on after a stop."""
        self._watch.restart()

    def update(self, now_s: float, posture: Posture | None, state: VehicleState) -> Guidance:
        """Return what leg or change of depth asks for."""
        lost = self._watch.update(now_s, posture is not None)
        if self.i_leg >= len(self._options.depths) or lost is not None:
            over = self.i_leg >= len(self._options.depths)
            return paced(self.setpoint, 0.0, lost, over)
        if self._leg is None and not self._depth_reached(state):
            return Guidance(
                setpoint=self.setpoint, down=self._descent(state), stage=Stage.CHANGING_DEPTH
            )
        return self._along(posture, state)

    def _along(self, posture: Posture | None, state: VehicleState) -> Guidance:
        """Go on with the leg; at its end take the next."""
        leg = self._leg = self._leg or Leg(self._options.leg)
        back = self._options.turn is Turn.BACK and self.i_leg % 2 == 1
        sway = -self._options.sway if back else self._options.sway
        leg.go(self._watch.spent_s, sway, None if posture is None else bearing_of(posture, state))
        if not leg.done:
            return paced(self.setpoint, sway, None, False)
        self.i_leg += 1
        self._begin_change()
        return paced(self.setpoint, 0.0, None, self.i_leg >= len(self._options.depths))

    def _begin_change(self) -> None:
        self._leg = None
        self._changing_s = self._steady_s = 0.0
        self._allowed_s = math.inf

    def _descent(self, state: VehicleState) -> float:
        """Return the speed of descent towards the leg's depth."""
        if state.depth is None or not math.isfinite(state.depth):
            return 0.0
        wanted = _DESCENT_GAIN * (self.depth - state.depth)
        return min(max(wanted, -self._options.descent), self._options.descent)

    def _depth_reached(self, state: VehicleState) -> bool:
        if state.depth is None or not math.isfinite(state.depth):
            return False
        left = abs(self.depth - state.depth)
        if math.isinf(self._allowed_s):
            self._allowed_s = left / self._options.descent + self._options.patience
        self._changing_s += self._watch.spent_s
        near = left <= _DEPTH_REACHED
        self._steady_s = self._steady_s + self._watch.spent_s if near else 0.0
        return self._steady_s >= _DEPTH_STEADY_S or self._changing_s >= self._allowed_s
