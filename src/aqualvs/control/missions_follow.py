"""Follow a net: constant distance, square to it, at a constant speed along it."""

import math
from dataclasses import dataclass

from aqualvs.control.mission import Guidance, LossOptions, LossWatch, Stage
from aqualvs.control.setpoint import Setpoint
from aqualvs.control.vehicle import VehicleState
from aqualvs.errors import OptionError
from aqualvs.scanning.posture import Posture


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
    """How far one goes along the net before turning round or ending; whichever comes first.

    Attributes
    ----------
    time : float
        Seconds with the target in sight.
    distance : float
        Metres, by the speed through the water: a current along the net counts for or against it.
    sector : Sector or None
        Of the net's bearing: heading plus the posture's yaw. A leg ends where it leaves the sector
        after it has been inside.
    """

    time: float = math.inf
    distance: float = math.inf
    sector: Sector | None = None

    def __post_init__(self) -> None:
        """Refuse what makes no sense.

        Raises
        ------
        OptionError
            If a time or distance is not positive.
        """
        if not (self.time > 0.0 and self.distance > 0.0):
            raise OptionError(
                f"leg: time {self.time:g} s, distance {self.distance:g} m; must be positive"
            )

    @property
    def ends(self) -> bool:
        """Whether there is an end at all."""
        return math.isfinite(min(self.time, self.distance)) or self.sector is not None


def bearing_of(posture: Posture, state: VehicleState) -> float | None:
    """Return the compass direction of the target's far normal, in [0, 2 pi); None if unknown."""
    if state.heading is None or not math.isfinite(state.heading + posture.yaw):
        return None
    return (state.heading + posture.yaw) % (2.0 * math.pi)


class Leg:
    """One way along the net: counts what has been gone.

    Parameters
    ----------
    options : LegOptions
        Where it ends.
    """

    def __init__(self, options: LegOptions) -> None:
        self._options = options
        self._time = self._distance = 0.0
        self._inside = False
        self._done = False

    @property
    def done(self) -> bool:
        """Whether it has come to its end."""
        return self._done

    def go(self, spent_s: float, speed: float, bearing: float | None) -> None:
        """Count seconds at a speed, and look where the net faces."""
        self._time += spent_s
        self._distance += spent_s * abs(speed)
        self._done |= self._time >= self._options.time
        self._done |= self._distance >= self._options.distance
        sector = self._options.sector
        if sector is None or bearing is None:
            return
        inside = sector.holds(bearing)
        self._done |= self._inside and not inside
        self._inside |= inside


class FollowMission:
    """Go along the net in one direction.

    Parameters
    ----------
    setpoint : Setpoint
        Range and yaw on the way.
    sway : float
        Speed through the water, to the right positive, in m/s.
    leg : LegOptions, optional
        Where it ends; never if left out.
    loss : LossOptions, optional
        What to do without the target.

    Raises
    ------
    OptionError
        If the speed is 0.
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
        self.setpoint, self._sway = setpoint, sway
        self._leg = Leg(leg or LegOptions())
        self._watch = LossWatch(loss)

    @property
    def sways(self) -> bool:
        """Whether it needs a vehicle that can move sideways: always."""
        return True

    def restart(self) -> None:
        """Go on after a stop."""
        self._watch.restart()

    def update(self, now_s: float, posture: Posture | None, state: VehicleState) -> Guidance:
        """Return setpoint and speed."""
        lost = self._watch.update(now_s, posture is not None)
        bearing = None if posture is None else bearing_of(posture, state)
        self._leg.go(self._watch.spent_s, self._sway, bearing)
        return paced(self.setpoint, self._sway, lost, self._leg.done)


def paced(setpoint: Setpoint, sway: float, lost: Stage | None, done: bool) -> Guidance:
    """Return the guidance along the net, or at its end, or without the target."""
    if lost is Stage.GAVE_UP:
        return Guidance(setpoint=None, stage=lost)
    if lost is not None or done:
        return Guidance(setpoint=setpoint, stage=lost or Stage.OVER)
    return Guidance(setpoint=setpoint, sway=sway, stage=Stage.FOLLOWING)
