"""Holds range and yaw to the target; the sea and a target that is not square stay out of it.

Signs: with the posture's yaw psi, n = (cos psi, sin psi) is the target's far normal along the
body's (forward, right). A vehicle that moves by (u, v) and turns at r, with its dome `a` ahead of
the centre it turns about, closes in by

    c = -d(range)/dt = u cos psi + (v + a r) sin psi,      d(psi)/dt = -r.

Range is held along the body's forward axis alone; motion to the side, and the dome's swing in a
turn, are made up for beforehand.
"""

import math

from aqualvs.control.controller_ramp import QuietZone, Ramp
from aqualvs.control.disturbance import SwellFilter
from aqualvs.control.gains import ControlGains, gain_schedule
from aqualvs.control.gains_thrust import DeadBandCrossing
from aqualvs.control.pid import Pid, PidOptions
from aqualvs.control.setpoint import Setpoint
from aqualvs.control.vehicle import Effort

# Beyond this yaw forward hardly changes the range, in radians.
_GREATEST_YAW = math.radians(60.0)
# Time constant in seconds with which a small integral fades while thrust changes its side.
_FORGETS_S = 1.0


class RangeYawController:
    """Efforts for a range, a yaw and a speed along the target.

    A cascade for the range: its error asks for a closing speed, the speed's error for an
    acceleration; the integral is the force that current, tether and trim take. Drag is put in
    beforehand at the speed asked for, relative to the water whose speed follows from that force:
    the loop is as fast in a current as at rest. A PI loop for the yaw asks for a turning rate,
    which the vehicle's own autopilot keeps.

    Parameters
    ----------
    gains : ControlGains
        For one vehicle.

    Notes
    -----
    Time is that of the frames. Two frames of one time, or one that is late, change nothing.
    """

    def __init__(self, gains: ControlGains) -> None:
        self.gains = gains
        thrust, mass = gains.vehicle.thrust, gains.vehicle.mass
        self._speed = Pid(
            PidOptions(
                proportional=gains.range.speed,
                integral=gains.range.integral,
                low=-thrust.backward / mass,
                high=thrust.forward / mass,
                output_rate=gains.range.jerk,
            )
        )
        self._turn = Pid(
            PidOptions(
                proportional=gains.yaw.proportional,
                integral=gains.yaw.integral,
                derivative=gains.yaw.derivative,
                derivative_time=gains.rate_time,
                low=-gains.yaw.greatest_rate,
                high=gains.yaw.greatest_rate,
                output_rate=gains.yaw.acceleration,
            )
        )
        near, turn = gains.range, gains.yaw
        self._range_ramp = Ramp(near.ramp_speed, near.ramp_acceleration, near.lag)
        self._yaw_ramp = Ramp(turn.ramp_rate, turn.ramp_acceleration, turn.lag)
        self._swell = SwellFilter(near.swell_period, near.swell_damping)
        self._swing_gain = near.speed * near.swell
        self._slope = _Slope(gains.rate_time)
        band = thrust, near.crossing_impulse, near.crossing_share
        self._pairs = (DeadBandCrossing(*band), DeadBandCrossing(*band))
        # A force whose impulse in that time does not cross the dead band is none.
        self._least = near.crossing_impulse * thrust.forward / mass / _FORGETS_S
        self._quiet = QuietZone(turn.quiet_rate)
        self.reset()

    def reset(self) -> None:
        """Forget everything; the next update starts from neutral, at the posture it finds."""
        self._speed.reset()
        self._turn.reset()
        self._slope.reset()
        self._swell.reset()
        self._let_go()
        self._time_s = math.nan
        self._stopped_s = math.nan
        self._running = False
        self._effort = Effort()

    def pause(self) -> None:
        """Stop: neutral until the next update, which goes on with what it knew of the current."""
        if self._running:
            self._stopped_s = self._time_s
        self._running = False
        self._speed.pause()
        self._turn.pause()
        self._slope.reset()
        self._swell.reset()
        self._let_go()

    def engage(self, time_s: float, range: float, yaw: float, effort: Effort) -> None:
        """Take over from somebody who steers, without a jump.

        Parameters
        ----------
        time_s : float
            Of the last frame.
        range, yaw : float
            Its posture, in metres and radians.
        effort : Effort
            What the vehicle does now.
        """
        vehicle = self.gains.vehicle
        forward, _ = vehicle.thrust.forces(effort.forward, effort.right)
        self.reset()
        self._start(time_s, range, yaw)
        parts = vehicle.thrust.split(effort.forward, effort.right)
        for pair, part in zip(self._pairs, parts, strict=True):
            pair.reset(part)
        self._quiet.reset(effort.yaw)
        self._speed.engage(time_s, 0.0, 0.0, forward / vehicle.mass)
        self._turn.engage(time_s, 0.0, 0.0, -effort.yaw * vehicle.turning_rate)

    def applied(self, effort: Effort) -> None:
        """Take in what was sent in place of the last effort."""
        vehicle = self.gains.vehicle
        forward, _ = vehicle.thrust.forces(effort.forward, effort.right)
        self._speed.applied(forward / vehicle.mass)
        self._turn.applied(-effort.yaw * vehicle.turning_rate)

    def update(
        self,
        time_s: float,
        range: float,
        yaw: float,
        range_rate: float | None,
        yaw_rate: float | None,
        setpoint: Setpoint,
        sway: float = 0.0,
        down: float = 0.0,
    ) -> Effort:
        """Return the effort for one frame.

        Parameters
        ----------
        time_s : float
            Of the frame.
        range, yaw : float
            Its posture, in metres and radians; finite.
        range_rate, yaw_rate : float or None
            Where a filter knows them, in m/s and rad/s; else they are filtered from differences.
        setpoint : Setpoint
            What to hold; changes come in at bounded speed.
        sway : float
            Speed through the water along the target, to the right positive, in m/s.
        down : float
            Speed of descent, in m/s.
        """
        step = time_s - self._time_s
        longest = self._speed.options.longest_step
        if self._running and -longest <= step <= 0.0:
            return self._effort
        if not (self._running and 0.0 < step <= longest):
            self._start(time_s, range, yaw)
            step = 0.0
        rate = self._slope.update(step, range, range_rate)
        self._time_s = time_s
        self._range_ramp.step(setpoint.range, step)
        self._yaw_ramp.step(setpoint.yaw, step)
        turn = self._turning(time_s, yaw, yaw_rate)
        forward, right = self._forces(step, range, yaw, rate, sway, turn)
        self._effort = self._as_effort(step, forward, right, turn, down)
        return self._effort

    def _let_go(self) -> None:
        """Begin with thrusters and turning at rest."""
        for pair in self._pairs:
            pair.reset()
        self._quiet.reset()

    def _start(self, time_s: float, range: float, yaw: float) -> None:
        """Begin at a posture, with what is still known of the disturbance."""
        if not 0.0 <= time_s - self._stopped_s <= self.gains.memory:
            self._speed.reset()
            self._turn.reset()
        self._speed.pause()
        self._turn.pause()
        self._slope.reset()
        self._swell.reset()
        self._range_ramp.start(range)
        self._yaw_ramp.start(yaw)
        self._time_s, self._running = time_s, True

    def _turning(self, time_s: float, yaw: float, yaw_rate: float | None) -> float:
        """Return the turning rate asked for, clockwise."""
        ramp = self._yaw_ramp
        # The derivative acts on the measurement; what the ramp itself asks for is given back.
        forward = ramp.rate + self.gains.yaw.derivative * ramp.seen_rate
        return -self._turn.update(time_s, ramp.seen, yaw, yaw_rate, forward)

    def _forces(
        self, step: float, range: float, yaw: float, rate: float, sway: float, turn: float
    ) -> tuple[float, float]:
        """Return the forces forward and right, in newtons."""
        vehicle, ramp = self.gains.vehicle, self._range_ramp
        psi = min(max(yaw, -_GREATEST_YAW), _GREATEST_YAW)
        c, s = math.cos(psi), math.sin(psi)
        side = sway * c if vehicle.can_sway else 0.0
        aside = (side + vehicle.dome_forward * turn) * s
        mending = self._mending(range)
        # Speeds and accelerations as seen along the forward axis.
        ahead = (mending - ramp.rate - aside) / c
        asked, found = (mending - ramp.seen_rate) / c, -rate / c
        turns = self._turns(step)
        swing = self._swell.update(step, asked - found) * (not turns)
        push, schedule = self._against_drag(ahead)
        push += schedule[0] * self._swing_gain * swing - ramp.change / c
        force = vehicle.mass * self._speed.update(
            self._time_s,
            asked,
            found,
            forward=push,
            schedule=(schedule[0], 0.0) if turns else schedule,
        )
        return force, vehicle.right_drag.force(side)

    def _turns(self, step: float) -> bool:
        """Return whether thrust goes to and fro about nothing; then the integral fades.

        In the dead band's hysteresis the loop's gain is low, and with an integral a loop is stable
        above some gain only: it would swing by itself for ever. Where thrust changes its side, and
        no swell is met, no force is needed that an integral had to know.
        """
        swell = self._swing_gain * self._swell.amplitude
        small = max(abs(self._speed.integral), swell) < self._least
        if not (small and all(pair.turns for pair in self._pairs)):
            return False
        self._speed.fade(math.exp(-max(step, 0.0) / _FORGETS_S))
        return True

    def _mending(self, range: float) -> float:
        """Return the closing speed that mends the range's error."""
        gains = self.gains.range
        wanted = gains.position * (range - self._range_ramp.seen)
        return min(max(wanted, -gains.greatest_speed), gains.greatest_speed)

    def _against_drag(self, ahead: float) -> tuple[float, tuple[float, float]]:
        """Return the acceleration that keeps a speed, beyond what the integral gives.

        The integral keeps the vehicle in its place: it tells how fast the water passes there. With
        it come the factors on the gains in that water: drag damps the vehicle as the speed's gain
        does, and lets gain and integral be greater.
        """
        vehicle = self.gains.vehicle
        held = vehicle.mass * self._speed.integral
        passing = vehicle.forward_drag.speed(held)
        drag = vehicle.forward_drag
        damping = drag.slope(passing) / vehicle.mass
        push = (drag.force(ahead + passing) - held) / vehicle.mass
        return push, gain_schedule(self.gains.range, damping)

    def _as_effort(
        self, step: float, forward: float, right: float, turn: float, down: float
    ) -> Effort:
        vehicle = self.gains.vehicle
        shares = vehicle.thrust.shares(forward, right)
        one, other = (
            pair.effort(share, step) for pair, share in zip(self._pairs, shares, strict=True)
        )
        ahead, aside = vehicle.thrust.joined(one, other)
        turn = self._quiet.rate(turn)
        return Effort(
            forward=ahead,
            right=aside,
            down=min(max(down / vehicle.climb_rate, -1.0), 1.0),
            yaw=min(max(turn / vehicle.turning_rate, -1.0), 1.0),
        )


class _Slope:
    """The range's rate: measured, or from differences through a first-order filter."""

    def __init__(self, time: float) -> None:
        self._time = time
        self.reset()

    def reset(self) -> None:
        self._last, self._rate = math.nan, 0.0

    def update(self, step: float, value: float, rate: float | None) -> float:
        if rate is not None:
            self._rate = rate
        elif step > 0.0 and not math.isnan(self._last):
            share = step / (step + self._time)
            self._rate += share * ((value - self._last) / step - self._rate)
        self._last = value
        return self._rate
