"""From forces to efforts: thrusters have a dead band and a bent curve, controllers neither."""

import math
from dataclasses import dataclass
from enum import StrEnum

from aqualvs.errors import OptionError


class Layout(StrEnum):
    """How the level thrusters stand."""

    VECTORED = "vectored"
    """Askew, in two pairs: one does forward plus right, the other forward minus right."""
    STRAIGHT = "straight"
    """Forward and sideways have thrusters of their own, or there are none sideways."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ThrustMap:
    """Thrust over effort, and back.

    Beyond the dead band thrust is full * (linear x + (1 - linear) x²), x being the rest of the
    effort's travel.

    Attributes
    ----------
    forward, backward, right : float
        Thrust at effort 1 along the axis alone, in newtons; `right` is 0 where the vehicle cannot
        move sideways.
    dead_band : float
        Effort below which nothing happens.
    linear : float
        Share of the curve that is straight.
    layout : Layout
        Of the level thrusters.
    """

    forward: float
    backward: float
    right: float
    dead_band: float = 0.0
    linear: float = 1.0
    layout: Layout = Layout.VECTORED

    def __post_init__(self) -> None:
        """Refuse what cannot be turned round.

        Raises
        ------
        OptionError
            If a thrust is not positive or a share none.
        """
        if not (min(self.forward, self.backward) > 0.0 and self.right >= 0.0):
            raise OptionError(
                f"thrust: forward {self.forward:g}, backward {self.backward:g}, right "
                f"{self.right:g} N; the first two are positive, the last 0 or more"
            )
        if not (0.0 <= self.dead_band < 1.0 and 0.0 < self.linear <= 1.0):
            raise OptionError(
                f"thrust: dead band {self.dead_band:g}, linear {self.linear:g}; shares between 0 "
                "and 1"
            )

    def effort(self, share: float) -> float:
        """Return the effort for a share of the full thrust, both -1 to 1."""
        size = min(abs(share), 1.0)
        return math.copysign(self._past_dead_band(size), share) if size > 0.0 else 0.0

    def share(self, effort: float) -> float:
        """Return the share of the full thrust that an effort gives, both -1 to 1."""
        x = (min(abs(effort), 1.0) - self.dead_band) / (1.0 - self.dead_band)
        if x <= 0.0:
            return 0.0
        return math.copysign(x * (self.linear + (1.0 - self.linear) * x), effort)

    def shares(self, forward: float, right: float) -> tuple[float, float]:
        """Return shares of the full thrust of both pairs of thrusters for forces in newtons.

        What is beyond the thrusters is cut: sideways first, for distance matters more.
        """
        full = self.forward if forward > 0.0 else self.backward
        ahead = _clipped(forward / full, 1.0)
        aside = 0.0 if self.right == 0.0 else _clipped(right / self.right, 1.0)
        if self.layout is Layout.STRAIGHT:
            return ahead, aside
        aside = _clipped(aside, 1.0 - abs(ahead))
        return ahead + aside, ahead - aside

    def split(self, forward: float, right: float) -> tuple[float, float]:
        """Return the efforts of both pairs of thrusters for those forward and right."""
        if self.layout is Layout.STRAIGHT:
            return forward, right
        return forward + right, forward - right

    def joined(self, one: float, other: float) -> tuple[float, float]:
        """Return efforts forward and right for those of both pairs of thrusters."""
        if self.layout is Layout.STRAIGHT:
            return one, other
        return 0.5 * (one + other), 0.5 * (one - other)

    def forces(self, forward: float, right: float) -> tuple[float, float]:
        """Return the forces in newtons that two efforts give together."""
        if self.layout is Layout.STRAIGHT:
            ahead, aside = self.share(forward), self.share(right)
        else:
            one, other = map(self.share, self.split(forward, right))
            ahead, aside = 0.5 * (one + other), 0.5 * (one - other)
        return ahead * (self.forward if ahead > 0.0 else self.backward), aside * self.right

    def _past_dead_band(self, size: float) -> float:
        bent = 1.0 - self.linear
        # The root of bent x² + linear x = size in the form that holds for bent = 0.
        x = 2.0 * size / (self.linear + math.sqrt(self.linear**2 + 4.0 * bent * size))
        return self.dead_band + (1.0 - self.dead_band) * x


class DeadBandCrossing:
    """Efforts of one pair of thrusters: its dead band is crossed once, with hysteresis.

    Where the thrust asked for changes its sign, the effort waits at the edge of the dead band, with
    the thrusters about to start, until the impulse that it owes is great, or the thrust is. What
    is owed is taken off the thrust that follows on the side in force: so the mean thrust is the one
    asked for, and noise about zero neither crosses nor pushes.

    Parameters
    ----------
    thrust : ThrustMap
    impulse : float
        Share of the full thrust, times seconds.
    great : float
        Share of the full thrust that crosses at once.
    """

    def __init__(self, thrust: ThrustMap, impulse: float, great: float) -> None:
        self._thrust, self._impulse, self._great = thrust, impulse, great
        self.reset()

    def reset(self, effort: float = 0.0) -> None:
        """Begin with an effort that is in force; in the dead band, on the side asked for next."""
        beyond = abs(effort) > self._thrust.dead_band
        self._side, self._owed = math.copysign(1.0, effort) if beyond else 0.0, 0.0
        self._stood_s = math.inf

    @property
    def turns(self) -> bool:
        """Whether thrust waits to change its side, or has just done so."""
        waits = abs(self._owed) > _WAITING_SHARE * self._impulse
        return waits or (self._stood_s < _STANDS_S and self._impulse > 0.0)

    def effort(self, share: float, step: float) -> float:
        """Return the effort for a share of the full thrust, `step` seconds after the last one."""
        if not self._side and share:
            self._side = math.copysign(1.0, share)
        self._stood_s += step
        owed = self._owed + share * step
        if share * self._side <= 0.0 and not step > 0.0:
            return self._edge()
        if owed * self._side < 0.0:
            if abs(owed) <= self._impulse and abs(share) < self._great:
                self._owed = owed
                return self._edge()
            # What has waited is late: the loop asks for it anew where it is still needed.
            self._side, self._stood_s, owed = -self._side, 0.0, share * step
        self._owed = 0.0
        given = owed / step if step > 0.0 else share
        return self._thrust.effort(given) if given * self._side > 0.0 else self._edge()

    def _edge(self) -> float:
        return self._side * self._thrust.dead_band


# Noise of postures owes less than that share of the impulse; and so long thrust must stand on one
# side, in seconds, before it is more than a correction of the last one.
_WAITING_SHARE, _STANDS_S = 1.0 / 3.0, 2.0


def _clipped(value: float, most: float) -> float:
    return min(max(value, -most), most)
