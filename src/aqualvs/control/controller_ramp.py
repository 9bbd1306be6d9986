"""Setpoints that change at a bounded speed, and turning rates that rest at zero."""

import math


class Ramp:
    """Follows a goal with bounded speed and acceleration, and stops on it.

    Parameters
    ----------
    speed, acceleration : float
        Greatest, per second and per second squared.
    lag : float
        Time constant in seconds with which a measurement follows, at best.

    Attributes
    ----------
    value, rate, change : float
        Where it is, its speed and its acceleration.
    seen, seen_rate : float
        Where a measurement is to be by now, and its speed.
    """

    def __init__(self, speed: float, acceleration: float, lag: float = 0.0) -> None:
        self._speed, self._most, self._lag = speed, acceleration, lag
        self.start(0.0)

    def start(self, value: float) -> None:
        """Begin at a value, at rest."""
        self.value = self.seen = value
        self.rate = self.seen_rate = self.change = 0.0

    def step(self, goal: float, dt: float) -> None:
        """Move on by `dt` seconds towards the goal; not at all if `dt` is not positive."""
        if not dt > 0.0:
            self.change = 0.0
            return
        left = goal - self.value
        most = self._most * dt
        # The speed from which one more step, and then braking, ends on the goal.
        brake = math.sqrt(0.25 * most * most + 2.0 * self._most * abs(left)) - 0.5 * most
        wanted = math.copysign(min(self._speed, max(brake, 0.0), abs(left) / dt), left)
        before = self.rate
        self.rate = min(max(wanted, before - most), before + most)
        self.value += self.rate * dt
        self.change = (self.rate - before) / dt
        share = dt / (dt + self._lag)
        self.seen_rate += share * (self.rate - self.seen_rate)
        self.seen += share * (self.value - self.seen)


class QuietZone:
    """Leaves small turning rates out, so that the vehicle's own heading hold has its say.

    From rest a rate must exceed `quiet`; one that has begun ends when it changes its sign.

    Parameters
    ----------
    quiet : float
        In rad/s.
    """

    def __init__(self, quiet: float) -> None:
        self._quiet = quiet
        self.reset()

    def reset(self, rate: float = 0.0) -> None:
        """Begin at rest, or with a rate that is in force."""
        self._side = math.copysign(1.0, rate) if rate else 0.0

    def rate(self, asked: float) -> float:
        """Return the turning rate to ask of the vehicle."""
        if abs(asked) > self._quiet:
            self._side = math.copysign(1.0, asked)
        elif asked * self._side <= 0.0:
            self._side = 0.0
        return asked if self._side else 0.0
