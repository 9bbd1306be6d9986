"""Missions: what the controllers are to hold, updated step by step; hold, follow and survey."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import StrEnum

from aqualvs.control.vehicle import Setpoint, VehicleState, clipped
from aqualvs.errors import OptionError, check_positive
from aqualvs.scanning.posture import Posture


class Stage(StrEnum):
    """Stage of a mission; the value is what logs write in `stage`."""

    IDLE = "idle"
    """Nobody steers."""
    HOLDING = "holding"
    FOLLOWING = "following"
    CHANGING_DEPTH = "changing_depth"
    WAITING = "waiting"
    """Without the target: neutral, it may come back."""
    OVER = "over"
    """All done: holding where it ended, until the pilot takes over."""
    GAVE_UP = "gave_up"
    """The target stayed away for too long."""

    @property
    def halts(self) -> bool:
        """Whether there must be no thrust."""
        return self in (Stage.IDLE, Stage.WAITING, Stage.GAVE_UP)


@dataclass(frozen=True, slots=True, kw_only=True)
class Guidance:
    """Present request of a mission."""

    setpoint: Setpoint | None  # Range and yaw; None where nothing is to be held.
    sway: float = 0.0  # Speed through the water along the target, to the right positive, in m/s.
    down: float = 0.0  # Speed of descent, in m/s; 0 keeps the depth.
    stage: Stage = Stage.HOLDING


@dataclass(frozen=True, slots=True, kw_only=True)
class LossOptions:
    """Behaviour without the target."""

    after: float = 0.15  # Seconds without a posture after which the mission waits.
    steady: float = 0.1  # Seconds of consecutive postures before it continues.
    give_up: float = 10.0  # Seconds of waiting after which it ends.

    def __post_init__(self) -> None:
        """Raise `OptionError` if a value is impossible."""
        if not (self.after > 0.0 and self.steady >= 0.0 and self.give_up > self.after):
            raise OptionError(
                f"loss: after {self.after:g} s, steady {self.steady:g} s, give up "
                f"{self.give_up:g} s; the first is positive, the last greater than it"
            )


class LossWatch:
    """State of the target: present, waited for, or lost."""

    # Longer steps are gaps (a stopped process, a mission that was halted), not time spent.
    LONGEST_STEP_S = 1.0

    def __init__(self, options: LossOptions | None = None) -> None:
        self.options = options or LossOptions()
        self.restart()

    def restart(self) -> None:
        """Start anew with the target there."""
        # WAITING, GAVE_UP, or None while the target is there.
        self.stage: Stage | None = None
        # Time since the last update that counts as spent with the target, in seconds.
        self.spent_s = 0.0
        self._last_s, self._away_s, self._back_s = math.nan, 0.0, 0.0

    def update(self, now_s: float, there: bool) -> Stage | None:
        """Update by the presence of a posture at this time; return the stage."""
        step = now_s - self._last_s
        step = step if 0.0 < step <= self.LONGEST_STEP_S else 0.0
        self._last_s = now_s
        if self.stage is not Stage.GAVE_UP:
            self._count(step, there)
        self.spent_s = step if self.stage is None and there else 0.0
        return self.stage

    def _count(self, step: float, there: bool) -> None:
        self._back_s = self._back_s + step if there else 0.0
        if there and (self.stage is None or self._back_s >= self.options.steady):
            self.stage, self._away_s = None, 0.0
            return
        self._away_s += step
        if self._away_s >= self.options.give_up:
            self.stage = Stage.GAVE_UP
        elif self._away_s >= self.options.after:
            self.stage = Stage.WAITING


class Mission(ABC):
    """Plan that is updated by the states of vehicle and target.

    `setpoint`: range and yaw to hold, which may be changed at any time. `loss`: what to do without
    the target.
    """

    sways = True  # Whether it needs a vehicle that can move sideways.

    def __init__(self, setpoint: Setpoint | None, loss: LossOptions | None = None) -> None:
        self.setpoint = setpoint
        self._watch = LossWatch(loss)

    @abstractmethod
    def update(self, now_s: float, posture: Posture | None, state: VehicleState) -> Guidance:
        """Return the present guidance.

        Parameters
        ----------
        now_s : float
            Monotonic, in seconds. Only steps forward of up to a second count as time spent.
        posture : Posture or None
            The present one; None where there is none. While disengaged there are no updates.
        state : VehicleState
            Depth and heading are used where they are known.
        """

    def restart(self) -> None:
        """Begin with the next update to go on after a stop: time spent so far stays."""
        self._watch.restart()


class HoldMission(Mission):
    """Hold a range and yaw, for some time or for good; after that time it holds on.

    `duration`: seconds with the target after which it is `Stage.OVER`; endless if left out.
    """

    sways = False

    def __init__(
        self,
        setpoint: Setpoint | None,
        *,
        duration: float = math.inf,
        loss: LossOptions | None = None,
    ) -> None:
        if not duration > 0.0:
            raise OptionError(f"hold: duration {duration:g} s; must be positive")
        super().__init__(setpoint, loss)
        self._duration = duration
        self._spent_s = 0.0

    def update(
        self,
        now_s: float,
        posture: Posture | None,
        state: VehicleState,  # noqa: ARG002
    ) -> Guidance:
        """Return the setpoint, at rest."""
        lost = self._watch.update(now_s, posture is not None)
        self._spent_s += self._watch.spent_s
        over = self._spent_s >= self._duration
        return guidance_along(self.setpoint, 0.0, lost, over, going=Stage.HOLDING)


@dataclass(frozen=True, slots=True)
class Sector:
    """Bearings of the net from `begin` clockwise to `end`, in radians."""

    begin: float
    end: float

    def holds(self, bearing: float) -> bool:
        """Return whether a bearing lies in it."""
        full = 2.0 * math.pi
        return (bearing - self.begin) % full <= (self.end - self.begin) % full


@dataclass(frozen=True, slots=True, kw_only=True)
class LegOptions:
    """End of a leg along the net: time, distance or sector, whichever comes first."""

    time: float = math.inf  # Seconds with the target in sight.
    # Metres, by the speed through the water: a current along the net counts for or against it.
    distance: float = math.inf
    # Of the net's bearing: heading plus the posture's yaw. A leg ends where it leaves the sector
    # after it has been inside.
    sector: Sector | None = None

    def __post_init__(self) -> None:
        """Raise `OptionError` if a time or distance is not positive."""
        if not (self.time > 0.0 and self.distance > 0.0):
            raise OptionError(
                f"leg: time {self.time:g} s, distance {self.distance:g} m; must be positive"
            )


def bearing_of(posture: Posture | None, state: VehicleState) -> float | None:
    """Return the compass direction of the target's far normal, in [0, 2 pi); None if unknown."""
    if posture is None or state.heading is None or not math.isfinite(state.heading + posture.yaw):
        return None
    return (state.heading + posture.yaw) % (2.0 * math.pi)


class Leg:
    """One way along the net, with the time and distance covered."""

    def __init__(self, options: LegOptions) -> None:
        self._options = options
        self._time = self._distance = 0.0
        self._inside = False
        self.done = False  # Whether it has come to its end.

    def go(self, spent_s: float, speed: float, bearing: float | None) -> None:
        """Count seconds at a speed, and look where the net faces."""
        self._time += spent_s
        self._distance += spent_s * abs(speed)
        self.done |= self._time >= self._options.time
        self.done |= self._distance >= self._options.distance
        sector = self._options.sector
        if sector is None or bearing is None:
            return
        inside = sector.holds(bearing)
        self.done |= self._inside and not inside
        self._inside |= inside


class FollowMission(Mission):
    """Go along the net in one direction, at a constant distance and speed.

    `sway`: speed through the water, to the right positive, in m/s. `leg`: where it ends; never if
    left out. Raises `OptionError` if the speed is 0.
    """

    def __init__(
        self,
        setpoint: Setpoint,
        sway: float,
        *,
        leg: LegOptions | None = None,
        loss: LossOptions | None = None,
    ) -> None:
        if not (sway != 0.0 and math.isfinite(sway)):
            raise OptionError(f"follow: speed {sway:g} m/s; choose one, or hold instead")
        super().__init__(setpoint, loss)
        self._sway = sway
        self._leg = Leg(leg or LegOptions())

    def update(self, now_s: float, posture: Posture | None, state: VehicleState) -> Guidance:
        """Return setpoint and speed."""
        lost = self._watch.update(now_s, posture is not None)
        self._leg.go(self._watch.spent_s, self._sway, bearing_of(posture, state))
        return guidance_along(self.setpoint, self._sway, lost, self._leg.done)


def guidance_along(
    setpoint: Setpoint | None,
    sway: float,
    lost: Stage | None,
    done: bool,
    going: Stage = Stage.FOLLOWING,
) -> Guidance:
    """Return the guidance along the net, or at its end, or without the target."""
    if lost is Stage.GAVE_UP:
        return Guidance(setpoint=None, stage=lost)
    if lost is not None or done:
        return Guidance(setpoint=setpoint, stage=lost or Stage.OVER)
    return Guidance(setpoint=setpoint, sway=sway, stage=going)


# Speed of descent by a depth's error, in m/s per m, and the tolerance of a depth.
_DESCENT_GAIN, _DEPTH_REACHED = 0.8, 0.07


class Turn(StrEnum):
    """Action at the end of a leg."""

    BACK = "back"
    """The next leg goes the other way: a part of a net."""
    ON = "on"
    """The next leg goes on the same way: round a cage."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyOptions:
    """The lawn and the mower."""

    depths: tuple[float, ...]  # One leg at each, in this order; metres, down positive.
    sway: float  # Speed of the first leg through the water, to the right positive, in m/s.
    leg: LegOptions  # Where each leg ends.
    turn: Turn = Turn.BACK  # Whether the next leg goes back or on.
    descent: float = 0.1  # Greatest speed between depths, in m/s.
    # Seconds that a change of depth may take beyond what it should before the next leg begins all
    # the same: something is in the way.
    patience: float = 20.0

    def __post_init__(self) -> None:
        """Raise `OptionError` naming the value if a survey has no end or direction."""
        if not self.depths or not all(depth >= 0.0 for depth in self.depths):
            raise OptionError(f"survey: depths {list(self.depths)} m; give one or more, 0 or more")
        if not (self.sway != 0.0 and math.isfinite(self.sway)):
            raise OptionError(f"survey: speed {self.sway:g} m/s; choose one, or hold instead")
        if self.leg == LegOptions():
            raise OptionError("survey: legs have no end; give a time, a distance or bearings")
        check_positive("survey", self, "descent", "patience")


class SurveyMission(Mission):
    """Legs along the net, one at each depth.

    The vehicle's own depth hold keeps the depth on the way; between legs it is asked to sink or
    rise, holding range and yaw. Without a known depth, changes wait.
    """

    def __init__(
        self, setpoint: Setpoint, options: SurveyOptions, *, loss: LossOptions | None = None
    ) -> None:
        super().__init__(setpoint, loss)
        self._options = options
        self.i_leg = 0  # The leg gone now, or whose depth is sought; counts from 0.
        self._leg: Leg | None = None
        self._begin_change()

    @property
    def depth(self) -> float:
        """Depth of the present leg, in metres."""
        return self._options.depths[min(self.i_leg, len(self._options.depths) - 1)]

    def update(self, now_s: float, posture: Posture | None, state: VehicleState) -> Guidance:
        """Return the guidance of the leg or the change of depth."""
        lost = self._watch.update(now_s, posture is not None)
        over = self.i_leg >= len(self._options.depths)
        if over or lost is not None:
            return guidance_along(self.setpoint, 0.0, lost, over)
        if self._leg is None and not self._depth_reached(state):
            down = 0.0
            if state.depth is not None and math.isfinite(state.depth):
                down = clipped(_DESCENT_GAIN * (self.depth - state.depth), self._options.descent)
            return Guidance(setpoint=self.setpoint, down=down, stage=Stage.CHANGING_DEPTH)
        return self._along(posture, state)

    def _along(self, posture: Posture | None, state: VehicleState) -> Guidance:
        """Go on with the leg; at its end take the next."""
        leg = self._leg = self._leg or Leg(self._options.leg)
        back = self._options.turn is Turn.BACK and self.i_leg % 2 == 1
        sway = -self._options.sway if back else self._options.sway
        leg.go(self._watch.spent_s, sway, bearing_of(posture, state))
        if not leg.done:
            return guidance_along(self.setpoint, sway, None, False)
        self.i_leg += 1
        self._begin_change()
        return guidance_along(self.setpoint, 0.0, None, self.i_leg >= len(self._options.depths))

    def _begin_change(self) -> None:
        self._leg = None
        self._changing_s = self._steady_s = 0.0
        self._allowed_s = math.inf

    def _depth_reached(self, state: VehicleState) -> bool:
        # Seconds that a depth must be kept before the next leg, longer than a wave.
        depth_steady_s = 1.0
        if state.depth is None or not math.isfinite(state.depth):
            return False
        left = abs(self.depth - state.depth)
        if math.isinf(self._allowed_s):
            self._allowed_s = left / self._options.descent + self._options.patience
        self._changing_s += self._watch.spent_s
        near = left <= _DEPTH_REACHED
        self._steady_s = self._steady_s + self._watch.spent_s if near else 0.0
        return self._steady_s >= depth_steady_s or self._changing_s >= self._allowed_s
