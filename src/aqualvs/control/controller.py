"""Controller of range and yaw to the target, and its parts: PID, swell filter, ramp and quiet zone.

Signs: with the posture's yaw psi, n = (cos psi, sin psi) is the target's far normal along the
body's (forward, right). A vehicle that moves by (u, v) and turns at r, with its dome `a` ahead of
the centre it turns about, closes in by

    c = -d(range)/dt = u cos psi + (v + a r) sin psi,      d(psi)/dt = -r.

`RangeYawController` holds the range along the body's forward axis alone; motion to the side, and
the dome's swing in a turn, are compensated in advance. It rejects disturbances by the sea and by a
target that is not square.
"""

import math
from dataclasses import dataclass

from aqualvs.control.gains import ControlGains, DeadBandCrossing, gain_schedule
from aqualvs.control.vehicle import Effort, Setpoint, clipped


@dataclass(frozen=True, slots=True, kw_only=True)
class PidOptions:
    """Gains and limits; units follow from those of measurement and output."""

    # Output per error, per error and second, per error's rate. 0 or more.
    proportional: float
    integral: float = 0.0
    derivative: float = 0.0
    # Time constant of the first-order filter on the derivative, in seconds; used where no rate is
    # measured.
    derivative_time: float = 0.1
    # Limits of the output.
    low: float = -math.inf
    high: float = math.inf
    output_rate: float = math.inf  # Greatest change of the output per second.
    # Seconds between two updates beyond which nothing is integrated and the derivative starts anew.
    longest_step: float = 0.5


class Pid:
    """Controller of a loop that is closed over frames: proportional, integral, derivative.

    The derivative acts on the measurement alone; the measurement brings its time.

    Output = P (setpoint - measurement) + integral - D rate + feed-forward, within the limits. The
    integral stands still while it would push the output further beyond a limit, that of its rate
    included (clamping; Åström and Hägglund 2006, Advanced PID control, section 3.5). What is not a
    finite number, and a time that stands still or steps back, changes nothing: the last output is
    returned. A time that steps back by more than `longest_step` is that of another stream.
    """

    def __init__(self, options: PidOptions) -> None:
        self.options = options
        self._slope = _Slope(options.derivative_time)
        self.reset()

    def reset(self) -> None:
        """Forget everything; the next update starts with output 0."""
        self.integral = 0.0  # The integral's share of the output.
        self.pause()

    def pause(self) -> None:
        """Expect the next update after a stop: output 0 till then, the integral stays."""
        self._output, self._time_s = 0.0, math.nan
        self._slope.reset()

    def applied(self, output: float) -> None:
        """Correct the last output by the value that the actuator applied, where it is limited."""
        if math.isfinite(output):
            self._output = output

    def update(
        self,
        time_s: float,
        setpoint: float,
        measured: float,
        rate: float | None = None,
        forward: float = 0.0,
        schedule: tuple[float, float] = (1.0, 1.0),
    ) -> float:
        """Return the output for a measurement.

        Parameters
        ----------
        setpoint, measured : float
            In one unit.
        rate : float, optional
            The measurement's rate, where it is known; else it is filtered from differences.
        forward : float
            Added to the output.
        schedule : (float, float)
            Factors on proportional and integral gain, for a plant that is known to change.
        """
        step = time_s - self._time_s
        values = (time_s, setpoint, measured, forward, *schedule, 0.0 if rate is None else rate)
        longest = self.options.longest_step
        if not all(map(math.isfinite, values)) or -longest <= step <= 0.0:
            return self._output
        if not 0.0 < step <= longest:
            step = 0.0
            self._slope.reset()
        rate = self._slope.update(step, measured, rate)
        self._time_s = time_s
        self._output = self._moved(step, setpoint - measured, rate, forward, schedule)
        return self._output

    def _moved(
        self, step: float, error: float, rate: float, forward: float, schedule: tuple[float, float]
    ) -> float:
        """Return the output, and integrate unless that drives it further beyond its limits."""
        options = self.options
        growth = options.integral * schedule[1] * error * step
        straight = options.proportional * schedule[0] * error
        rest = straight - options.derivative * rate + forward
        wanted = rest + self.integral + growth
        allowed = self._allowed(wanted, step)
        if (wanted - allowed) * growth > 0.0:
            return self._allowed(rest + self.integral, step)
        self.integral += growth
        return allowed

    def _allowed(self, wanted: float, step: float) -> float:
        """Return the output within its limits, and those of its change."""
        first_step_s = 0.04
        # The first update has no time step; its output may change as much as in a short one.
        most = self.options.output_rate * (step or first_step_s)
        wanted = min(max(wanted, self._output - most), self._output + most)
        return min(max(wanted, self.options.low), self.options.high)


class SwellFilter:
    """Band-pass filter about one period, that of the swell.

    In parallel to a proportional gain it raises the loop's gain about that period alone (internal
    model principle; Francis and Wonham 1976, doi:10.1016/0005-1098(76)90006-6):

        H(s) = 2 zeta w s / (s² + 2 zeta w s + w²),   w = 2 pi / period.

    At the period H is 1, far from it 0. Its memory is that of a damped pendulum: bounded by its
    input, so that it does not wind up.

    Parameters
    ----------
    period : float
        In seconds.
    damping : float
        zeta; half of the width of the band over its middle.
    """

    def __init__(self, period: float, damping: float) -> None:
        self._omega, self._damping = 2.0 * math.pi / period, damping
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._output = self._sum = 0.0

    @property
    def amplitude(self) -> float:
        """Present amplitude of the filter's output."""
        return math.hypot(self._output, self._sum)

    def update(self, step: float, value: float) -> float:
        """Return the swinging part of `value`; unchanged if `step` seconds are not positive.

        Backward Euler: any step is stable.
        """
        if not step > 0.0:
            return self._output
        w = self._omega
        # y' = 2 zeta w (value - y) - w q,  q' = w y.
        above = self._output + step * w * (2.0 * self._damping * value - self._sum)
        below = 1.0 + 2.0 * self._damping * w * step + (w * step) ** 2
        self._output = above / below
        self._sum += step * w * self._output
        return self._output


class Ramp:
    """Setpoint that follows a goal with bounded speed and acceleration, and stops on it.

    Parameters
    ----------
    speed, acceleration : float
        Greatest, per second and per second squared.
    lag : float
        Time constant in seconds with which a measurement follows, at best.
    falling : float
        Greatest speed towards lower values, where that is less.

    Attributes
    ----------
    value, rate, change : float
        Where it is, its speed and its acceleration.
    seen, seen_rate : float
        Where a measurement is to be by now, and its speed.
    """

    def __init__(
        self, speed: float, acceleration: float, lag: float = 0.0, falling: float = math.inf
    ) -> None:
        self._rising, self._falling = speed, min(speed, falling)
        self._most, self._lag = acceleration, lag
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
        # Speed at which one more step and then braking end on the goal.
        brake = math.sqrt(0.25 * most * most + 2.0 * self._most * abs(left)) - 0.5 * most
        speed = self._rising if left > 0.0 else self._falling
        wanted = math.copysign(min(speed, max(brake, 0.0), abs(left) / dt), left)
        before = self.rate
        self.rate = min(max(wanted, before - most), before + most)
        self.value += self.rate * dt
        self.change = (self.rate - before) / dt
        share = dt / (dt + self._lag)
        self.seen_rate += share * (self.rate - self.seen_rate)
        self.seen += share * (self.value - self.seen)


class QuietZone:
    """Suppression of small turning rates, so that the vehicle's own heading hold can act.

    From rest a rate must exceed `quiet`; a turn ends when the rate changes its sign.

    `quiet`: in rad/s.
    """

    def __init__(self, quiet: float) -> None:
        self._quiet = quiet
        self.reset()

    def reset(self) -> None:
        """Begin at rest."""
        self._side = 0.0

    def rate(self, asked: float) -> float:
        """Return the turning rate to ask of the vehicle."""
        if abs(asked) > self._quiet:
            self._side = math.copysign(1.0, asked)
        elif asked * self._side <= 0.0:
            self._side = 0.0
        return asked if self._side else 0.0


# Beyond this yaw, in radians, forward motion hardly changes the range.
_MAX_YAW = math.radians(60.0)
# Time constant in seconds of a small integral's decay while thrust changes its sign.
_FORGETS_S = 1.0


class RangeYawController:
    """Controller of range, yaw and speed along the target, by efforts.

    A cascade for the range: its error asks for a closing speed, the speed's error for an
    acceleration; the integral is the force that current, tether and trim take. Drag is put in
    beforehand at the speed asked for, relative to the water whose speed follows from that force:
    the loop is as fast in a current as at rest. A PI loop for the yaw asks for a turning rate,
    which the vehicle's own autopilot keeps.

    Time is that of the frames. Two frames of one time, or one that is late, change nothing.
    """

    def __init__(self, gains: ControlGains) -> None:
        self.gains = gains
        thrust, mass = gains.vehicle.thrust, gains.vehicle.mass
        near, turn = gains.range, gains.yaw
        self._speed = Pid(
            PidOptions(
                proportional=near.speed,
                integral=near.integral,
                low=-thrust.backward / mass,
                high=thrust.forward / mass,
                output_rate=near.jerk,
            )
        )
        self._turn = Pid(
            PidOptions(
                proportional=turn.proportional,
                integral=turn.integral,
                derivative=turn.derivative,
                derivative_time=gains.rate_time,
                low=-turn.greatest_rate,
                high=turn.greatest_rate,
                output_rate=turn.acceleration,
            )
        )
        self._range_ramp = Ramp(
            near.ramp_speed, near.ramp_acceleration, near.lag, near.approach_speed
        )
        self._yaw_ramp = Ramp(turn.ramp_rate, turn.ramp_acceleration, turn.lag)
        self._swell = SwellFilter(near.swell_period, near.swell_damping)
        self._swing_gain = near.speed * near.swell
        self._slope = _Slope(gains.rate_time)
        band = thrust, near.crossing_impulse, near.crossing_share
        self._pairs = (DeadBandCrossing(*band), DeadBandCrossing(*band))
        # A force whose impulse in that time does not cross the dead band counts as zero.
        self._least = near.crossing_impulse * thrust.forward / mass / _FORGETS_S
        self._quiet = QuietZone(turn.quiet_rate)
        self.reset()

    def reset(self) -> None:
        """Forget everything; the next update starts from neutral, at the posture it finds."""
        self._time_s = self._stopped_s = math.nan
        self._running = False
        self._effort = Effort()
        self._speed.reset()
        self._turn.reset()
        self.pause()

    def pause(self) -> None:
        """Stop: neutral until the next update, which starts with the known current."""
        if self._running:
            self._stopped_s = self._time_s
        self._running = False
        self._forget_motion()
        # Thrusters and turning begin at rest.
        for part in (*self._pairs, self._quiet):
            part.reset()

    def applied(self, effort: Effort) -> None:
        """Correct the last effort by the one that was sent in its place."""
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
        # The derivative acts on the measurement; the ramp's own rate is added back.
        ramp = self._yaw_ramp
        ahead = ramp.rate + self.gains.yaw.derivative * ramp.seen_rate
        turn = -self._turn.update(time_s, ramp.seen, yaw, yaw_rate, ahead)
        forward, right = self._forces(step, range, yaw, rate, sway, turn)
        self._effort = self._as_effort(step, forward, right, turn, down)
        return self._effort

    def _forget_motion(self) -> None:
        self._speed.pause()
        self._turn.pause()
        self._slope.reset()
        self._swell.reset()

    def _start(self, time_s: float, range: float, yaw: float) -> None:
        """Begin at a posture, with the remembered part of the disturbance."""
        if not 0.0 <= time_s - self._stopped_s <= self.gains.memory:
            self._speed.reset()
            self._turn.reset()
        self._forget_motion()
        self._range_ramp.start(range)
        self._yaw_ramp.start(yaw)
        self._time_s, self._running = time_s, True

    def _forces(
        self, step: float, range: float, yaw: float, rate: float, sway: float, turn: float
    ) -> tuple[float, float]:
        """Return the forces forward and right, in newtons."""
        vehicle, ramp = self.gains.vehicle, self._range_ramp
        psi = clipped(yaw, _MAX_YAW)
        c, s = math.cos(psi), math.sin(psi)
        side = sway * c if vehicle.can_sway else 0.0
        aside = (side + vehicle.dome_forward * turn) * s
        # Closing speed that corrects the range's error.
        gains = self.gains.range
        mending = clipped(gains.position * (range - ramp.seen), gains.greatest_speed)
        # Speeds and accelerations along the forward axis.
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
        self._speed.integral *= math.exp(-max(step, 0.0) / _FORGETS_S)
        return True

    def _against_drag(self, ahead: float) -> tuple[float, tuple[float, float]]:
        """Return the acceleration that keeps a speed, in addition to the integral.

        The integral keeps the vehicle in its place, so it gives the speed of the water there. With
        it come the factors on the gains in that water: drag damps the vehicle as the speed's gain
        does, and lets gain and integral be greater.
        """
        vehicle = self.gains.vehicle
        drag, held = vehicle.forward_drag, vehicle.mass * self._speed.integral
        passing = drag.speed(held)
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
            down=clipped(down / vehicle.climb_rate),
            yaw=clipped(turn / vehicle.turning_rate),
        )


class _Slope:
    """Rate of a quantity: measured, or from differences through a first-order filter."""

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
