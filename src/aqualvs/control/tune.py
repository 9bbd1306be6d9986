"""Gains for a vehicle model: the fastest that stay stable in the worst case, and their margins.

Range: linearised about rest in still or moving water, the vehicle is 1 / (m s (s + b)) with the
drag's slope b over mass, behind its thrusters' lag and the delay of picture, link and sampling.
With the gains `speed` k1, `position` k0 and `integral` ki, and the band H about the swell's period,
the open loop is

    L(s) = ((g k1 (1 + 1.2 H(s)) + h ki / s) (s + k0) + b k0) / (s (s + b)) / (lag s + 1)
           exp(-delay s),

g = 1 + 0.8 b / k1, at most 2.2, and h = 1 + 1.2 b / k1, at most 6, being the controller's schedule
in moving water (`gain_schedule`). The ratios k0 = 0.3 k1, ki = 0.25 k1² and that of H were chosen
among some hundred: they pass little of swell and of changes of the current at given margins, over
all three vehicles. So one number is left; it is the greatest for which the modulus margin stays at
`least_modulus` with the usual delay, and at `least_late_modulus` with the greatest, in every
corner: mass and drag off by the factors asked for, water at rest and at the greatest current.

Yaw: the autopilot keeps turning rates with a lag, that of its shaping, its rate loop and the
thrusters; L(s) = (kp s + ki) / s² / (lag s + 1) exp(-delay s) with ki = 0.15 kp², and kp the
greatest for the same margin, the rate loop being as calculated or, in the thrusters' dead band,
several times slower.

`facts_of` states what a controller should know of a simulated vehicle. `Margins` are the distances
of a loop from instability, among them the delay and the gain that may still be added.
"""

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from aqualvs.control.gains import (
    ControlGains,
    Drag,
    Layout,
    RangeGains,
    ThrustMap,
    VehicleFacts,
    YawGains,
    gain_schedule,
)
from aqualvs.control.gains_file import load_gains
from aqualvs.control.sticks import StickChannel, StickShaping
from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.simulation.vehicle.models import FORWARD, RIGHT, YAW, VehicleModel


def facts_of(model: VehicleModel) -> VehicleFacts:
    """Return the properties of a simulated vehicle for its controller, with the pilot gain."""
    sticks, shaping = model.sticks, shaping_of_model(model)
    return VehicleFacts(
        name=model.name,
        mass=tidy(model.mass + model.added_mass[0]),
        forward_drag=Drag(model.linear_drag[0], model.quadratic_drag[0]),
        right_drag=Drag(model.linear_drag[1], model.quadratic_drag[1]),
        thrust=_thrust_map(model),
        turning_rate=math.radians(tidy(math.degrees(sticks.turning_rate * shaping.turning_share))),
        climb_rate=tidy(sticks.climb_rate * shaping.climbing_share),
        dome_forward=model.dome_position[0],
    )


def shaping_of_model(model: VehicleModel) -> StickShaping:
    """Return the stick shaping of a simulated vehicle, which a link must compensate."""
    sticks, own = model.sticks, StickShaping()
    yaw, forward, right = sticks.trims
    return StickShaping(
        gain=sticks.gain,
        throttle_dead_zone=sticks.throttle_dead_zone,
        throttle=own.throttle,
        yaw=StickChannel(trim=yaw, dead_zone=sticks.yaw_dead_zone),
        forward=StickChannel(trim=forward),
        right=StickChannel(trim=right),
    )


def _thrust_map(model: VehicleModel) -> ThrustMap:
    """Return thrust over effort: the thrusters' curve, as far as the pilot gain lets it."""
    curve, gain = model.curve, model.sticks.gain
    travel = (gain - curve.dead_band) / (1.0 - curve.dead_band)
    if not travel > 0.0:
        raise OptionError(
            f"vehicle {model.name}: pilot gain {gain:g} stays in the thrusters' dead band "
            f"{curve.dead_band:g}; raise the gain"
        )
    straight = curve.linear * travel
    bent = (1.0 - curve.linear) * travel * travel
    along, mixing = model.allocation(), model.mixing()
    askew = bool(np.any((mixing[:, FORWARD] != 0.0) & (mixing[:, RIGHT] != 0.0)))

    def most(axis: int, column: int, sign: float) -> float:
        drive = sign * along[axis] * mixing[:, column]
        runs_forward = sign * mixing[:, column] > 0.0
        each = np.where(runs_forward, curve.forward, curve.reverse)
        return tidy(float(np.sum(np.abs(drive) * each)) * (straight + bent))

    return ThrustMap(
        forward=most(0, FORWARD, 1.0),
        backward=most(0, FORWARD, -1.0),
        right=most(1, RIGHT, 1.0),
        dead_band=tidy(curve.dead_band / gain),
        linear=tidy(straight / (straight + bent)),
        layout=Layout.VECTORED if askew else Layout.STRAIGHT,
    )


def turning_lag(model: VehicleModel, slower: float = 1.0) -> float:
    """Return how late a model's autopilot follows a turning rate, in seconds.

    By the shaping of the stick, the thrusters' lag, and the rate loop, which may be slower by a
    factor: inertia over the moment that it gives for a rate.
    """
    curve = model.curve
    lever = float(np.abs(model.allocation()[5] @ model.mixing()[:, YAW]))
    each = 0.5 * (curve.forward + curve.reverse) * curve.linear / (1.0 - curve.dead_band)
    inertia = model.inertia[2] + model.added_mass[5]
    rate_loop = inertia / (model.autopilot.rate[2] * lever * each)
    return model.autopilot.input_time + curve.lag + slower * rate_loop


def tidy(value: float) -> float:
    """Return a number rounded to four digits, for readable files."""
    return float(f"{value:.4g}")


ComplexArray: TypeAlias = NDArray[np.complex128]

# Frequencies from a slow drift to the limit of the thrusters, in rad/s.
_OMEGA = np.geomspace(1e-2, 1e2, 1600)
_PADE = 4


@dataclass(frozen=True, slots=True)
class Loop:
    """An open loop: numerator over denominator, polynomials in s, and a delay."""

    # Coefficients, highest power first.
    above: FloatArray
    below: FloatArray
    delay: float  # In seconds.

    def at(self, omega: FloatArray) -> ComplexArray:
        """Return the response at frequencies in rad/s, shape (N,)."""
        s = 1j * omega
        ratio = np.polyval(self.above, s) / np.polyval(self.below, s)
        return np.asarray(ratio * np.exp(-self.delay * s), dtype=np.complex128)

    def poles(self) -> ComplexArray:
        """Return the poles of the closed loop, the delay as a Padé approximant of order 4.

        That approximant's phase is right within a degree up to 4 rad / delay; crossovers lie below.
        """
        lag = _pade(self.delay)
        lead = lag * (-1.0) ** np.arange(len(lag) - 1, -1, -1)
        closed = np.polyadd(np.convolve(self.below, lag), np.convolve(self.above, lead))
        return np.asarray(np.roots(closed), dtype=np.complex128)


@dataclass(frozen=True, slots=True)
class Margins:
    """Stability margins of one loop."""

    stable: bool  # The others mean nothing where it is False.
    # Highest frequency at which the loop's gain is 1, in rad/s; NaN if there is none.
    crossover: float
    phase: float  # Least phase that may still be lost at such a frequency, in radians.
    gain: float  # Factor by which the gain may grow.
    delay: float  # That may be added, in seconds.
    # Least distance of the loop from -1; 1 / modulus is the greatest amplification of a
    # disturbance.
    modulus: float


def margins(loop: Loop) -> Margins:
    """Return the margins of a loop."""
    along = loop.at(_OMEGA)
    size = np.abs(along)
    # Phase above -180 degrees, 0 to 2 pi: the margin where the gain is 1.
    left = np.mod(np.angle(along) + math.pi, 2.0 * math.pi)
    ones = np.flatnonzero((size[:-1] > 1.0) != (size[1:] > 1.0))
    return Margins(
        stable=bool(loop.poles().real.max() < 0.0),
        crossover=float(_OMEGA[ones[-1]]) if len(ones) else math.nan,
        phase=min((float(left[k]) for k in ones), default=math.inf),
        gain=_gain_margin(along),
        delay=min((float(left[k] / _OMEGA[k]) for k in ones), default=math.inf),
        modulus=float(np.min(np.abs(1.0 + along))),
    )


def worst(of: Iterable[Margins]) -> Margins:
    """Return the margins that are nearest to instability."""
    return min(of, key=lambda one: (one.stable, one.modulus))


def _gain_margin(along: ComplexArray) -> float:
    """Return the least factor above 1 that brings the curve to -1."""
    turns = np.flatnonzero((along.imag[:-1] < 0.0) != (along.imag[1:] < 0.0))
    crossings = -along.real[turns]
    factors = 1.0 / crossings[(crossings > 0.0) & (crossings < 1.0)]
    return float(factors.min()) if len(factors) else math.inf


def _pade(delay: float) -> FloatArray:
    """Return the denominator of exp(-delay s); the numerator is that of -s."""
    n = _PADE
    terms = [
        math.factorial(2 * n - k) / (math.factorial(k) * math.factorial(n - k)) * delay**k
        for k in range(n, -1, -1)
    ]
    # A vanishing delay leaves leading zeros, which are no powers of s.
    return np.trim_zeros(np.array(terms) / terms[-1], "f")


_POSITION_SHARE, _INTEGRAL_SHARE, _TURN_INTEGRAL_SHARE = 0.3, 0.25, 0.15
# Integral of the missing closing speed before thrust changes its sign, in metres. With 15 mm, the
# thrust of a BlueROV2 Heavy in calm water changes its sign more than 20 times a minute; with 21 mm,
# the step of a BlueROV2 takes twice the time. The second bounds it for weak thrusters, as share of
# their thrust times seconds: with 0.022 the step of a VideoRay-like vehicle takes twice the time.
_CROSSING, _MAX_CROSSING = 0.018, 0.0175


@dataclass(frozen=True, slots=True, kw_only=True)
class TuneOptions:
    """Conditions under which the loops must stay stable."""

    # From the exposure to the effort at the vehicle, in seconds: what it usually is.
    delay: float = 0.12
    # What it may become; performance may suffer there, stability must not.
    greatest_delay: float = 0.2
    # Seconds between frames; half of it counts as delay: efforts are held until the next frame.
    frame: float = 0.04
    # By which mass and drag may be off, either way.
    mass_factor: float = 1.2
    drag_factor: float = 2.0
    current: float = 0.5  # Greatest speed of the water, in m/s.
    # Least distance of the loop from -1 at the usual delay, in the worst corner, where mass, drag
    # and current are off at once.
    least_modulus: float = 0.35
    least_late_modulus: float = 0.2  # As much at the greatest delay.
    least_yaw_modulus: float = 0.45  # Of the yaw at the greatest delay; it has less to fight.

    def __post_init__(self) -> None:
        """Raise `OptionError` naming the value that is impossible."""
        # Greatest delays and frame intervals in seconds, and greatest current in m/s.
        max_s, max_current = 60.0, 10.0
        if not 0.0 <= self.delay <= self.greatest_delay <= max_s:
            raise OptionError(
                f"tune: delay {self.delay:g} s; choose 0 to the greatest, "
                f"{self.greatest_delay:g} s, and that up to {max_s:g} s"
            )
        if not (0.0 < self.frame <= max_s and min(self.mass_factor, self.drag_factor) >= 1.0):
            raise OptionError(
                f"tune: frame {self.frame:g} s, factors {self.mass_factor:g} and "
                f"{self.drag_factor:g}; the first is positive, up to {max_s:g} s, the others are "
                "at least 1"
            )
        moduli = (self.least_modulus, self.least_late_modulus, self.least_yaw_modulus)
        if not (0.0 <= self.current <= max_current and 0.0 < min(moduli) <= max(moduli) < 1.0):
            raise OptionError(
                f"tune: current {self.current:g} m/s, least moduli "
                f"{', '.join(f'{one:g}' for one in moduli)}; the first is 0 to {max_current:g}, "
                "the others between 0 and 1"
            )


@dataclass(frozen=True, slots=True)
class Tuned:
    """Result of tuning."""

    gains: ControlGains
    range_usual: Margins  # At the usual delay with the model as it is, in still water.
    range_corner: Margins  # At the usual delay in the worst corner.
    range_late: Margins  # At the greatest delay in the worst corner.
    yaw_usual: Margins  # As `range_usual`.
    yaw_late: Margins  # As `range_late`.


def tune(model: VehicleModel, options: TuneOptions | None = None) -> Tuned:
    """Return the fastest gains for a model that stay stable in every corner.

    Raises `OptionError` if there are none.
    """
    options = options or TuneOptions()
    facts = facts_of(model)
    lag, turn_lag = model.curve.lag, turning_lag(model)
    usual = options.delay + 0.5 * options.frame

    def of_range(k: float) -> RangeGains:
        return _range_gains(k, lag + usual, facts)

    def of_yaw(k: float) -> YawGains:
        return _yaw_gains(k, turn_lag + usual)

    m, d = options.mass_factor, options.drag_factor
    corners = [*itertools.product((1.0 / m, m), (1.0 / d, d), (0.0, options.current))]

    def range_worst(of: RangeGains, delay: float) -> Margins:
        whole = delay + 0.5 * options.frame
        return worst(
            margins(_range_loop(facts, lag, of, whole, current, mass, drag))
            for mass, drag, current in corners
        )

    def range_is_enough(k: float) -> bool:
        of = of_range(k)
        return _enough(range_worst(of, options.delay), options.least_modulus) and _enough(
            range_worst(of, options.greatest_delay), options.least_late_modulus
        )

    k1 = _greatest(model.name, range_is_enough)
    kp = _greatest(
        model.name,
        lambda k: _enough(_yaw_worst(model, of_yaw(k), options), options.least_yaw_modulus),
    )
    gains = ControlGains(vehicle=facts, range=of_range(k1), yaw=of_yaw(kp))
    return Tuned(
        gains,
        margins(_range_loop(facts, lag, gains.range, usual, 0.0)),
        range_worst(gains.range, options.delay),
        range_worst(gains.range, options.greatest_delay),
        margins(_yaw_loop(turn_lag, gains.yaw, usual)),
        _yaw_worst(model, gains.yaw, options),
    )


def usable_gains(source: Path | str) -> ControlGains:
    """Load gains and refuse those with which a loop would swing up.

    The vehicle is taken as the gains describe it: their `lag`, of the vehicle and the posture
    together, counts as a delay, at least that of `TuneOptions`.

    `source`: as `load_gains` takes it. Raises `OptionError` as `load_gains`; or with the axis, and
    what is left of its margins.
    """
    # Packaged gains have 0.40 to 0.55; 1.5 times these gains 0.28 to 0.37, twice these 0.13 to
    # 0.19.
    min_usable_modulus = 0.25
    gains = load_gains(source)
    usual = TuneOptions().delay
    loops = {
        "range": _range_loop(gains.vehicle, 0.0, gains.range, max(gains.range.lag, usual), 0.0),
        "yaw": _yaw_loop(0.0, gains.yaw, max(gains.yaw.lag, usual)),
    }
    for axis, loop in loops.items():
        found = margins(loop)
        if not _enough(found, min_usable_modulus):
            left = f"modulus {found.modulus:.2f}" if found.stable else "unstable"
            raise OptionError(
                f"{source}: the {axis} loop would swing up ({left}, at least "
                f"{min_usable_modulus:g} is needed); make gains with aqualvs tune"
            )
    return gains


def _range_gains(speed: float, lag: float, facts: VehicleFacts) -> RangeGains:
    # Speed of a new setpoint, in m/s. Towards the target it is less for a vehicle that would coast
    # farther than so many metres in so many seconds, where the picture has stood still for that
    # long until it is noticed and thrust ends.
    ramp_speed, coast, coast_s, unseen_s = 0.15, 0.3, 5.0, 0.6
    swell = 1.2
    crossing = _CROSSING * speed * facts.mass / facts.thrust.forward
    # While it sees nothing of its motion the loop pushes as from rest.
    unseen = 1.0 + speed * unseen_s
    coasting = facts.forward_drag.coasting_speed(coast, coast_s, facts.mass)
    return RangeGains(
        ramp_speed=ramp_speed,
        approach_speed=tidy(min(coasting / unseen, ramp_speed)),
        crossing_impulse=tidy(min(crossing, _MAX_CROSSING)),
        swell=swell,
        lag=tidy(lag),
        position=tidy(_POSITION_SHARE * speed),
        speed=tidy(speed),
        integral=tidy(_INTEGRAL_SHARE * speed * speed),
    )


def _yaw_gains(proportional: float, lag: float) -> YawGains:
    # Error of the yaw that begins a turn, in degrees: twice the noise of a posture. With 0.6 the
    # yaw effort of a BlueROV2 in calm water changes its sign 22 to 46 times a minute, with 0.8 8 to
    # 13 times. With 1.2 that of the Heavy does so still less, but its yaw is off by 0.25 degrees
    # there.
    quiet_error_deg = 0.8
    return YawGains(
        lag=tidy(lag),
        proportional=tidy(proportional),
        integral=tidy(_TURN_INTEGRAL_SHARE * proportional * proportional),
        quiet_rate=math.radians(round(quiet_error_deg * proportional, 1)),
    )


def _range_loop(
    facts: VehicleFacts,
    lag: float,
    gains: RangeGains,
    delay: float,
    current: float,
    mass: float = 1.0,
    drag: float = 1.0,
) -> Loop:
    """Return the open loop about rest in a current, with mass and drag off by factors."""
    slope = facts.forward_drag.linear + 2.0 * facts.forward_drag.quadratic * current
    damping = slope * drag / (facts.mass * mass)
    w, zeta = 2.0 * math.pi / gains.swell_period, gains.swell_damping
    swell = np.array([1.0, 2.0 * zeta * w, w * w])
    swings = gains.swell * np.array([2.0 * zeta * w, 0.0])
    known = slope / facts.mass
    of_speed, of_integral = gain_schedule(gains, known)
    speed, integral = of_speed * gains.speed, of_integral * gains.integral
    pushes = np.convolve([speed, integral], swell)
    pushes = np.polyadd(pushes, speed * np.convolve([1.0, 0.0], swings))
    above = np.convolve(pushes, [1.0, gains.position])
    # Drag is fed forward at the requested speed, which follows the position.
    ahead = known * gains.position
    above = np.polyadd(above, ahead * np.convolve([1.0, 0.0], swell)) / mass
    below = np.convolve(np.convolve([1.0, damping, 0.0, 0.0], [lag, 1.0]), swell)
    return Loop(np.asarray(above, np.float64), below, delay)


def _yaw_loop(lag: float, gains: YawGains, delay: float) -> Loop:
    above = np.array([gains.proportional, gains.integral])
    return Loop(above, np.array([lag, 1.0, 0.0, 0.0]), delay)


def _yaw_worst(model: VehicleModel, gains: YawGains, options: TuneOptions) -> Margins:
    # Factor by which the autopilot's lag behind a turning rate grows in the thrusters' dead band.
    sluggish = 4.0
    delay = options.greatest_delay + 0.5 * options.frame
    lags = (turning_lag(model, slower) for slower in (1.0, sluggish))
    return worst(margins(_yaw_loop(lag, gains, delay)) for lag in lags)


def _enough(found: Margins, least: float) -> bool:
    return found.stable and found.modulus >= least


def _greatest(name: str, enough: Callable[[float], bool]) -> float:
    """Return the greatest gain whose margins are enough, by bisection."""
    least, greatest = 0.05, 20.0  # Limits of the bisection of a gain, in 1/s.
    if not enough(least):
        raise OptionError(
            f"tune {name}: no gains leave the margins asked for; lower the delays, or the margins"
        )
    low, high = least, greatest
    while high > 1.005 * low:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if enough(middle) else (low, middle)
    return low
