"""A PID controller for loops that are closed over frames: time comes with the measurement."""

import math
from dataclasses import dataclass

from aqualvs.errors import OptionError


@dataclass(frozen=True, slots=True, kw_only=True)
class PidOptions:
    """Gains and limits; units follow from those of measurement and output.

    Attributes
    ----------
    proportional, integral, derivative : float
        Output per error, per error and second, per error's rate. 0 or more.
    derivative_time : float
        Time constant of the first-order filter on the derivative, in seconds; used where no rate
        is measured.
    low, high : float
        Limits of the output.
    output_rate : float
        Greatest change of the output per second.
    longest_step : float
        Seconds between two updates beyond which nothing is integrated and the derivative starts
        anew.
    """

    proportional: float
    integral: float = 0.0
    derivative: float = 0.0
    derivative_time: float = 0.1
    low: float = -math.inf
    high: float = math.inf
    output_rate: float = math.inf
    longest_step: float = 0.5

    def __post_init__(self) -> None:
        """Refuse what cannot work.

        Raises
        ------
        OptionError
            If a gain is negative or a limit is none.
        """
        for name in ("proportional", "integral", "derivative", "derivative_time"):
            value = getattr(self, name)
            if not (value >= 0.0 and math.isfinite(value)):
                raise OptionError(f"controller, {name} {value:g}: must be 0 or more")
        for name in ("output_rate", "longest_step"):
            if not getattr(self, name) > 0.0:
                raise OptionError(f"controller, {name} {getattr(self, name):g}: must be positive")
        if not self.low < self.high:
            raise OptionError(
                f"controller, limits {self.low:g} to {self.high:g}: the first must be the lower"
            )


class Pid:
    """Proportional, integral, derivative; the derivative acts on the measurement alone.

    Output = P (setpoint - measurement) + integral - D rate + feed-forward, within the limits. The
    integral stands still while it would push the output further beyond a limit, that of its rate
    included (clamping; Åström and Hägglund 2006, Advanced PID control, section 3.5). What is not a
    finite number, and a time that stands still or steps back, changes nothing: the last output is
    returned. A time that steps back by more than `longest_step` is that of another stream.

    Parameters
    ----------
    options : PidOptions
        Gains and limits.
    """

    def __init__(self, options: PidOptions) -> None:
        self.options = options
        self.reset()

    @property
    def output(self) -> float:
        """The last output."""
        return self._output

    @property
    def integral(self) -> float:
        """The integral's share of the output."""
        return self._integral

    def reset(self) -> None:
        """Forget everything; the next update starts with output 0."""
        self._integral = self._output = self._rate = 0.0
        self._time_s = math.nan
        self._measured = math.nan

    def pause(self) -> None:
        """Expect the next update after a stop: output 0 till then, the integral stays."""
        self._output = self._rate = 0.0
        self._time_s = self._measured = math.nan

    def engage(
        self, time_s: float, setpoint: float, measured: float, output: float, forward: float = 0.0
    ) -> None:
        """Start such that the output goes on from `output`: the integral takes what is missing.

        Parameters
        ----------
        time_s : float
            Now; the next update comes later.
        setpoint, measured : float
            As of now, at rest.
        output : float
            What the actuator does now.
        forward : float
            The feed-forward that the next update will come with.
        """
        values = (time_s, setpoint, measured, output, forward)
        if not all(map(math.isfinite, values)):
            self.reset()
            return
        self._time_s, self._measured, self._rate = time_s, measured, 0.0
        self._output = self._limited(output)
        straight = self.options.proportional * (setpoint - measured) + forward
        self._integral = self._output - straight if self.options.integral > 0.0 else 0.0

    def fade(self, kept: float) -> None:
        """Forget all but a share of the integral."""
        self._integral *= kept

    def applied(self, output: float) -> None:
        """Take in what the actuator really did with the last output, where others limit it."""
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
        time_s : float
            Of the measurement.
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
        counts = 0.0 < step <= longest
        self._rate = self._rate_after(step if counts else math.nan, measured, rate)
        self._time_s, self._measured = time_s, measured
        self._output = self._moved(step if counts else 0.0, setpoint - measured, forward, schedule)
        return self._output

    def _rate_after(self, step: float, measured: float, rate: float | None) -> float:
        if rate is not None:
            return rate
        if math.isnan(step):
            return 0.0
        # Backward Euler: any step is stable.
        slope = (measured - self._measured) / step
        share = step / (step + self.options.derivative_time)
        return self._rate + share * (slope - self._rate)

    def _moved(
        self, step: float, error: float, forward: float, schedule: tuple[float, float]
    ) -> float:
        """Return the output, and integrate unless that drives it further beyond its limits."""
        options = self.options
        growth = options.integral * schedule[1] * error * step
        straight = options.proportional * schedule[0] * error
        rest = straight - options.derivative * self._rate + forward
        wanted = rest + self._integral + growth
        allowed = self._limited(self._near_last(wanted, step))
        if (wanted - allowed) * growth > 0.0:
            return self._limited(self._near_last(rest + self._integral, step))
        self._integral += growth
        return allowed

    def _near_last(self, wanted: float, step: float) -> float:
        # A first update has no step; it may move as far as in a short one.
        most = self.options.output_rate * (step or _FIRST_STEP_S)
        return min(max(wanted, self._output - most), self._output + most)

    def _limited(self, output: float) -> float:
        return min(max(output, self.options.low), self.options.high)


_FIRST_STEP_S = 0.04
