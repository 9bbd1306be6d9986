"""Posture to the autopilot and to the pilot's station by MAVLink."""

import math
from typing import Any

from aqualvs.control.time_filter import FilteredPosture
from aqualvs.control.vehicle import VehicleState
from aqualvs.live.mavlink.ardusub import DepthChoice, attitude_of, gyro_rates_of
from aqualvs.live.mavlink.link import LinkOptions, MavlinkLink
from aqualvs.live.mavlink.ports import Address
from aqualvs.live.outputs.base import Output
from aqualvs.recording.sample import LiveSample
from aqualvs.scanning.posture import Posture, Refusal, deviations
from aqualvs.scanning.scan import GyroRates, ScanPoints
from aqualvs.sources.base import PartHealth

# The scanner accepts ranges up to one percent beyond the working range.
_RANGE_TOLERANCE = 0.01
_MAX_CM = 65_535
_UNKNOWN_VARIANCE = 255
_UNKNOWN_QUALITY, _INVALID_QUALITY, _WORST_QUALITY, _BEST_QUALITY = 0, 1, 2, 100
_INVALID_CM = 0
"""Below any least distance: ArduPilot and PX4 then have no distance, while one that is too large
would mean to PX4 that the way is free."""

_NAN = float("nan")

NAMES = (
    *("aq_valid", "aq_range", "aq_pitch", "aq_yaw"),
    *("aq_s_range", "aq_s_pitch", "aq_s_yaw", "aq_n"),
)
"""`NAMED_VALUE_FLOAT` of every sample: 1 or 0; range (mm) and angles (degrees), their standard
deviations by frame and rig together, and the water's refractive index. NaN where there is no
posture."""

FILTERED_NAMES = ("aqf_valid", "aqf_range", "aqf_pitch", "aqf_yaw", "aqf_speed")
"""The same from the time filter, while it is switched on: 1 or 0, mm, degrees, and the rate of the
range in mm/s. NaN where the filter has no value."""


class MavlinkOutput(Output):
    """Output by `DISTANCE_SENSOR` and `NAMED_VALUE_FLOAT`; the link sends the heartbeat.

    `link`: one that others use too, which is not closed here, or what `MavlinkLink` takes together
    with `options`. Raises `OptionError` if the address makes no sense, or pymavlink is not
    installed.
    """

    inline = True

    def __init__(
        self, link: MavlinkLink | Address | str, options: LinkOptions | None = None
    ) -> None:
        self._owns_link = not isinstance(link, MavlinkLink)
        self.link = link if isinstance(link, MavlinkLink) else MavlinkLink(link, options)
        self.name = f"mavlink {self.link.url}"
        self._n_dropped = 0
        self._depth = DepthChoice(self.link)
        self._distance = _distance_message(self.link.dialect)
        self._values = _value_messages(self.link.dialect, NAMES)
        self._filtered_values = _value_messages(self.link.dialect, FILTERED_NAMES)
        self._was_filtered = False

    def send(self, sample: LiveSample) -> None:
        """Send one sample without waiting; drop messages that cannot be sent."""
        time_boot_ms = boot_ms(sample.posture_ns)
        _fill_distance(self._distance, time_boot_ms, sample)
        numbers = _numbers(sample.scan.posture, sample.scan.n_water)
        messages = _fill(self._values, time_boot_ms, numbers)
        self._was_filtered |= sample.filtered is not None
        if self._was_filtered:
            filtered = _filtered_numbers(sample.filtered)
            messages = messages + _fill(self._filtered_values, time_boot_ms, filtered)
        # The autopilot's distance goes first, even if a slow line has no room for the rest.
        sent = self.link.send(self._distance, urgent=True)
        sent &= self.link.send(*messages)
        self._n_dropped += not sent

    def health(self) -> PartHealth:
        """Return how the link is, and how many samples did not go out as a whole."""
        found = self.link.health()
        return PartHealth(self.name, found.state, found.detail, self._n_dropped)

    def vehicle_state(self) -> VehicleState:
        """Return depth and heading as far as the autopilot tells them."""
        return VehicleState(depth=self._depth.read(), heading=attitude_of(self.link)[2])

    def turning(self, at_ns: int) -> GyroRates | None:
        """Return the vehicle's turning at a time, as far as the autopilot tells it."""
        return gyro_rates_of(self.link, at_ns)

    def close(self) -> None:
        """Close the link if it was made here; further calls do nothing."""
        if self._owns_link:
            self.link.close()


def boot_ms(monotonic_ns: int) -> int:
    """Return milliseconds since the start of the system, as 32 bits: they wrap after 49.7 days."""
    return (monotonic_ns // 1_000_000) & 0xFFFF_FFFF


def distance_limits_cm(working_range: tuple[float, float]) -> tuple[int, int]:
    """Return the least and greatest distance that is ever sent, in whole centimetres outwards.

    `working_range`: in metres.
    """
    near, far = working_range
    least = math.floor(100.0 * near * (1.0 - _RANGE_TOLERANCE))
    most = math.ceil(100.0 * far * (1.0 + _RANGE_TOLERANCE))
    return min(max(1, least), _MAX_CM), min(max(1, most), _MAX_CM)


def variance_cm2(variance: float) -> int:
    """Return a variance in m² as `DISTANCE_SENSOR` wants it: whole cm², never less than it is.

    255, which means unknown, where the number has no room for it.
    """
    if not 0.0 <= variance < 0.0255:
        return _UNKNOWN_VARIANCE
    return math.ceil(1e4 * variance)


def signal_quality(points: ScanPoints) -> int:
    """Return the mean quality of the stripes that a posture rests on, from 2 to 100; 0 if unknown.

    1 is left to invalid measurements.
    """
    qualities = points.quality[points.used]
    mean = float(qualities.mean()) if len(qualities) else _NAN
    if not math.isfinite(mean):
        return _UNKNOWN_QUALITY
    return min(max(_WORST_QUALITY, round(100.0 * mean)), _BEST_QUALITY)


def _distance_message(dialect: Any) -> Any:
    return dialect.MAVLink_distance_sensor_message(
        time_boot_ms=0,
        min_distance=1,
        max_distance=1,
        current_distance=_INVALID_CM,
        type=dialect.MAV_DISTANCE_SENSOR_LASER,
        id=0,
        orientation=dialect.MAV_SENSOR_ROTATION_NONE,
        covariance=_UNKNOWN_VARIANCE,
        signal_quality=_INVALID_QUALITY,
    )


def _fill_distance(message: Any, time_boot_ms: int, sample: LiveSample) -> None:
    message.time_boot_ms = time_boot_ms
    message.min_distance, message.max_distance = distance_limits_cm(sample.rig.working_range)
    posture = sample.scan.posture
    current_cm = round(100.0 * posture.range) if posture and math.isfinite(posture.range) else 0
    values = _INVALID_CM, _UNKNOWN_VARIANCE, _INVALID_QUALITY
    if posture and 0 < current_cm <= _MAX_CM:
        variance = variance_cm2(float(posture.total_covariance[0, 0]))
        values = current_cm, variance, signal_quality(sample.scan.points)
    message.current_distance, message.covariance, message.signal_quality = values


def _value_messages(dialect: Any, names: tuple[str, ...]) -> tuple[Any, ...]:
    kind = dialect.MAVLink_named_value_float_message
    return tuple(kind(0, name.encode("ascii"), _NAN) for name in names)


def _fill(messages: tuple[Any, ...], time_boot_ms: int, numbers: tuple[float, ...]) -> Any:
    float_max = 3.4e38
    for message, number in zip(messages, numbers, strict=True):
        message.time_boot_ms = time_boot_ms
        message.value = number if -float_max < number < float_max else _NAN
    return messages


def _numbers(posture: Posture | Refusal, n_water: float) -> tuple[float, ...]:
    """Return what `NAMES` names."""
    if not isinstance(posture, Posture):
        return (0.0, *6 * (_NAN,), n_water)
    sigma_range, sigma_pitch, sigma_yaw = deviations(posture.total_covariance)
    pitch, yaw = math.degrees(posture.pitch), math.degrees(posture.yaw)
    sigmas = 1e3 * sigma_range, sigma_pitch, sigma_yaw
    return (1.0, 1e3 * posture.range, pitch, yaw, *sigmas, n_water)


def _filtered_numbers(filtered: FilteredPosture | None) -> tuple[float, ...]:
    """Return what `FILTERED_NAMES` names."""
    if filtered is None:
        return (0.0, *4 * (_NAN,))
    pitch, yaw = math.degrees(filtered.pitch), math.degrees(filtered.yaw)
    return (1.0, 1e3 * filtered.range, pitch, yaw, 1e3 * float(filtered.rates[0]))
