"""What a mission asks of the controllers, update by update; and the simplest one: hold."""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

from aqualvs.control.setpoint import Setpoint
from aqualvs.control.vehicle import VehicleState
from aqualvs.errors import OptionError
from aqualvs.scanning.posture import Posture


class Stage(StrEnum):
    """Where a mission is; the value is what logs say in `stage`."""

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
    def ended(self) -> bool:
        """Whether the mission never goes on by itself."""
        return self in (Stage.OVER, Stage.GAVE_UP)

    @property
    def halts(self) -> bool:
        """Whether there must be no thrust."""
        return self in (Stage.IDLE, Stage.WAITING, Stage.GAVE_UP)


@dataclass(frozen=True, slots=True, kw_only=True)
class Guidance:
    """What a mission wants now.

    Attributes
    ----------
    setpoint : Setpoint or None
        Range and yaw; None where nothing is to be held.
    sway : float
        Speed through the water along the target, to the right positive, in m/s.
    down : float
        Speed of descent, in m/s; 0 keeps the depth.
    stage : Stage
    """

    setpoint: Setpoint | None
    sway: float = 0.0
    down: float = 0.0
    stage: Stage = Stage.HOLDING


class Mission(Protocol):
    """A plan that unfolds by what the vehicle and the lasers tell."""

    @property
    def sways(self) -> bool:
        """Whether it needs a vehicle that can move sideways."""

    def update(self, now_s: float, posture: Posture | None, state: VehicleState) -> Guidance:
        """Return what to do now.

        Parameters
        ----------
        now_s : float
            Monotonic, in seconds. Only steps forward of up to a second count as time spent.
        posture : Posture or None
            The present one; None where there is none. While nobody steers there are no updates.
        state : VehicleState
            Depth and heading are used where they are known.
        """

    def restart(self) -> None:
        """Begin with the next update to go on after a stop: time spent so far stays."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LossOptions:
    """What to do without the target.

    Attributes
    ----------
    after : float
        Seconds without a posture after which the mission waits.
    steady : float
        Seconds of postures in a row before it goes on.
    give_up : float
        Seconds of waiting after which it ends.
    """

    after: float = 0.15
    steady: float = 0.1
    give_up: float = 10.0

    def __post_init__(self) -> None:
        """Refuse what makes no sense.

        Raises
        ------
        OptionError
            If one is not positive.
        """
        if not (self.after > 0.0 and self.steady >= 0.0 and self.give_up > self.after):
            raise OptionError(
                f"loss: after {self.after:g} s, steady {self.steady:g} s, give up "
                f"{self.give_up:g} s; the first is positive, the last greater than it"
            )


class LossWatch:
    """Tells whether the target is there, waited for, or gone.

    Attributes
    ----------
    stage : Stage or None
        WAITING, GAVE_UP, or None while the target is there.
    spent_s : float
        Time since the last update that counts as spent with the target, in seconds.
    """

    # Longer steps are gaps (a stopped process, a mission that was halted), not time spent.
    LONGEST_STEP_S = 1.0

    def __init__(self, options: LossOptions | None = None) -> None:
        self.options = options or LossOptions()
        self.stage: Stage | None = None
        self.spent_s = 0.0
        self._last_s = math.nan
        self._away_s = 0.0
        self._back_s = 0.0

    def restart(self) -> None:
        """Start anew with the target there."""
        self.stage, self.spent_s = None, 0.0
        self._last_s, self._away_s, self._back_s = math.nan, 0.0, 0.0

    def update(self, now_s: float, there: bool) -> Stage | None:
        """Take in whether there is a posture at this time; return the stage."""
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


class HoldMission:
    """Hold a range and yaw, for some time or for good; after that time it holds on.

    Parameters
    ----------
    setpoint : Setpoint or None
        Kept in `setpoint`, which may be set anew at any time.
    duration : float, optional
        Seconds with the target after which it is `Stage.OVER`; endless if left out.
    loss : LossOptions, optional
        What to do without the target.
    """

    def __init__(
        self,
        setpoint: Setpoint | None,
        *,
        duration: float = math.inf,
        loss: LossOptions | None = None,
    ) -> None:
        if not duration > 0.0:
            raise OptionError(f"hold: duration {duration:g} s; must be positive")
        self.setpoint = setpoint
        self._duration = duration
        self._watch = LossWatch(loss)
        self._spent_s = 0.0

    @property
    def sways(self) -> bool:
        """Whether it needs a vehicle that can move sideways: never."""
        return False

    def restart(self) -> None:
        """Go on after a stop."""
        self._watch.restart()

    def update(
        self,
        now_s: float,
        posture: Posture | None,
        state: VehicleState,  # noqa: ARG002
    ) -> Guidance:
        """Return the setpoint, at rest."""
        lost = self._watch.update(now_s, posture is not None)
        self._spent_s += self._watch.spent_s
        if lost is Stage.GAVE_UP:
            return Guidance(setpoint=None, stage=lost)
        here = Stage.OVER if self._spent_s >= self._duration else Stage.HOLDING
        return Guidance(setpoint=self.setpoint, stage=lost or here)
