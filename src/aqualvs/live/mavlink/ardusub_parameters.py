"""ArduSub's parameters: what their values mean for us, and advice on what to set instead.

Names and meanings are those of ArduSub's `Parameters.cpp`, `GCS.cpp` (MAV_), and
`AP_RangeFinder_Params.cpp` (RNGFND1_); the second name is that of releases before 4.7.
"""

import time
from collections.abc import Iterator, Mapping

from aqualvs.live.mavlink.link import MavlinkLink
from aqualvs.text import Finding

STATION = ("MAV_GCS_SYSID", "SYSID_MYGCS")
STATION_HIGH = "MAV_GCS_SYSID_HI"
PILOT_INPUT, PILOT_TIMEOUT = "FS_PILOT_INPUT", "FS_PILOT_TIMEOUT"
SPEED_UP, SPEED_DOWN = "PILOT_SPEED_UP", "PILOT_SPEED_DN"
RANGE_TYPE, RANGE_ORIENT = "RNGFND1_TYPE", "RNGFND1_ORIENT"
RANGE_NEAR = (("RNGFND1_MIN", 1.0), ("RNGFND1_MIN_CM", 0.01))
RANGE_FAR = (("RNGFND1_MAX", 1.0), ("RNGFND1_MAX_CM", 0.01))
"""Names with their units in metres."""

FOR_STICKS = (*STATION, STATION_HIGH, PILOT_INPUT, PILOT_TIMEOUT, SPEED_UP, SPEED_DOWN)
FOR_DISTANCE = (RANGE_TYPE, RANGE_ORIENT, *(name for name, _ in (*RANGE_NEAR, *RANGE_FAR)))

FULL_CLIMB_RATE = 0.5
"""Speed of a full stick at a pilot gain of 1 in m/s, as the packaged gains assume it."""

_MAVLINK_RANGEFINDER, _FORWARD = 10, 0
# The rate of descent is controlled by the depth: half or twice the rate still works.
_CLIMB_RATE_RATIO = 2.0
_ASK_EVERY_S, _ASK_SELDOM_S, _ROUNDS = 1.0, 30.0, 5


class StationRange:
    """The system ids that the vehicle takes for its ground station.

    `parameters`: as the vehicle reported them.
    """

    def __init__(self, parameters: Mapping[str, float]) -> None:
        self.name = next((name for name in STATION if name in parameters), STATION[0])
        self._least = round(parameters[self.name]) if self.name in parameters else None
        self._most = round(parameters.get(STATION_HIGH, 0))

    @property
    def known(self) -> bool:
        """Whether the vehicle has reported them."""
        return self._least is not None

    def __contains__(self, system: int) -> bool:
        """Return whether a system id counts; `GCS::sysid_is_gcs`."""
        if self._least is None:
            return False
        return self._least <= system <= max(self._least, self._most)

    def __str__(self) -> str:
        """Return the ids as messages show them."""
        if self._least is None:
            return "unknown"
        return f"{self._least} to {self._most}" if self._most > self._least else f"{self._least}"


class ParameterWatch:
    """Requests for the vehicle's parameters, repeated until it has answered; never waits.

    `names`: at most ten.
    """

    def __init__(self, link: MavlinkLink, names: tuple[str, ...]) -> None:
        self._link, self._names = link, names
        self._next_s, self._n_asked = float("-inf"), 0

    def read(self) -> dict[str, float]:
        """Return the known parameters, and request the others when it is time."""
        known = self._link.parameters()
        missing = [name for name in self._names if name not in known]
        now_s = time.monotonic()
        if missing and now_s >= self._next_s and self._link.autopilot() is not None:
            # Some names belong to other releases: they are never answered.
            self._n_asked += 1
            self._next_s = now_s + (_ASK_EVERY_S if self._n_asked < _ROUNDS else _ASK_SELDOM_S)
            self._link.ask_parameters(missing)
        return known

    @property
    def has_waited(self) -> bool:
        """Whether the vehicle had time enough to answer."""
        return self._n_asked >= _ROUNDS


def advise_on_station(parameters: Mapping[str, float], station: int) -> Finding:
    """Advise whether the vehicle obeys sticks that are sent in a ground station's name."""
    obeyed = StationRange(parameters)
    if not obeyed.known:
        return Finding.warn(
            f"{' or '.join(STATION)} is unknown, and so is whether the vehicle obeys sticks of "
            f"ground station {station}; look it up in the ground station"
        )
    if station in obeyed:
        return Finding.ok(
            f"{obeyed.name} {obeyed}: sticks in the name of ground station {station} are obeyed"
        )
    return Finding.bad(
        f"{obeyed.name} {obeyed}: every stick in the name of ground station {station} is ignored, "
        f"the pilot's too; set {obeyed.name} {station}, or ground_station {obeyed} in the vehicle "
        "file"
    )


def advise_on_fail_safe(parameters: Mapping[str, float]) -> Iterator[Finding]:
    """Advise on the effect of the pilot-input fail-safe when efforts end."""
    # A last effort that stays in force longer than this moves the vehicle far.
    longest_timeout_s = 1.0
    disabled, disarm = 0, 2
    action, timeout_s = parameters.get(PILOT_INPUT), parameters.get(PILOT_TIMEOUT)
    if action is None:
        yield Finding.warn(f"{PILOT_INPUT} is unknown; make sure that it is 1 or 2")
    elif round(action) == disabled:
        yield Finding.bad(
            f"{PILOT_INPUT} 0 (off): if follow is killed, its last effort stands for ever; set "
            f"{PILOT_INPUT} 1"
        )
    elif round(action) == disarm:
        after = PILOT_TIMEOUT if timeout_s is None else f"{timeout_s:g} s"
        yield Finding.warn(
            f"{PILOT_INPUT} 2 (disarm): without a joystick that sends, the vehicle disarms "
            f"{after} after Enter gives it back, and sinks if it is heavy; set "
            f"{PILOT_INPUT} 1, or leave the joystick on"
        )
    else:
        yield Finding.ok(f"{PILOT_INPUT} 1 (warn): sticks go neutral, armed")
    if timeout_s is None:
        yield Finding.warn(f"{PILOT_TIMEOUT} is unknown; make sure that it is 0.5 to 1")
    elif timeout_s > longest_timeout_s:
        yield Finding.warn(
            f"{PILOT_TIMEOUT} {timeout_s:g} s: if follow is killed, its last effort stands that "
            f"long; set {PILOT_TIMEOUT} 1"
        )
    else:
        yield Finding.ok(
            f"{PILOT_TIMEOUT} {timeout_s:g} s: the last effort stands that long if follow is killed"
        )


def advise_on_speed(parameters: Mapping[str, float]) -> Iterator[Finding]:
    """Advise on the climb rate of a full vertical stick, compared with the gains' assumption."""
    up, down = parameters.get(SPEED_UP), parameters.get(SPEED_DOWN, 0.0)
    if up is None:
        yield Finding.warn(
            f"{SPEED_UP} is unknown: depth changes may be faster or slower than planned"
        )
    elif down == 0.0:
        # ArduSub takes 0 for the speed upwards (get_pilot_speed_dn).
        same = "0" if SPEED_DOWN in parameters else "unknown"
        yield _climb_advice(f"{SPEED_UP} {up:.0f} ({SPEED_DOWN} {same}: the same downwards)", up)
    else:
        yield _climb_advice(f"{SPEED_UP} {up:.0f}", up)
        yield _climb_advice(f"{SPEED_DOWN} {down:.0f}", down)


def advise_on_distance(
    parameters: Mapping[str, float], working_range: tuple[float, float] | None
) -> Iterator[Finding]:
    """Advise on the vehicle's use of `DISTANCE_SENSOR`.

    `working_range`: of the rig, in metres.
    """
    kind, orient = parameters.get(RANGE_TYPE), parameters.get(RANGE_ORIENT)
    if kind is None:
        yield Finding.warn(f"{RANGE_TYPE} is unknown; set 10 (MAVLink) to use the distance")
    elif round(kind) != _MAVLINK_RANGEFINDER:
        yield Finding.warn(
            f"{RANGE_TYPE} {kind:.0f}: the autopilot does not use the distance to the net; set "
            f"{RANGE_TYPE} 10 (MAVLink) and {RANGE_ORIENT} 0, and restart the autopilot"
        )
    elif orient is None or round(orient) != _FORWARD:
        value = "is unknown" if orient is None else f"{orient:.0f}"
        yield Finding.warn(
            f"{RANGE_ORIENT} {value}: our sensor looks forward, and the autopilot ignores other "
            f"orientations; set {RANGE_ORIENT} 0"
        )
    else:
        text = f"{RANGE_TYPE} 10, {RANGE_ORIENT} 0: the autopilot uses the distance to the net"
        yield Finding.ok(text)
        yield from _limits_advice(parameters, working_range)


def _climb_advice(setting: str, speed_cm_s: float) -> Finding:
    speed = 0.01 * speed_cm_s
    means = f"{setting}: a full stick asks for {speed:.2g} m/s times the pilot gain"
    if FULL_CLIMB_RATE / _CLIMB_RATE_RATIO <= speed <= FULL_CLIMB_RATE * _CLIMB_RATE_RATIO:
        return Finding.ok(means)
    return Finding.warn(
        f"{means}, but the gains assume {FULL_CLIMB_RATE:g} m/s: follow changes the depth at a "
        f"different speed than planned; set {SPEED_UP} and {SPEED_DOWN} "
        f"{100.0 * FULL_CLIMB_RATE:.0f}"
    )


def _limits_advice(
    parameters: Mapping[str, float], working_range: tuple[float, float] | None
) -> Iterator[Finding]:
    near, far = _first(parameters, RANGE_NEAR), _first(parameters, RANGE_FAR)
    if near is None or far is None:
        return
    (near_name, least), (far_name, most) = near, far
    means = f"{near_name}, {far_name}: {least:g} to {most:g} m are valid"
    if working_range is None:
        yield Finding.ok(f"{means}; the rig's working range must lie within")
    elif least <= working_range[0] and most >= working_range[1]:
        yield Finding.ok(means)
    else:
        wanted = f"{working_range[0]:g} to {working_range[1]:g} m"
        yield Finding.warn(f"{means}, but the rig measures {wanted}; set them to enclose that")


def _first(
    parameters: Mapping[str, float], names: tuple[tuple[str, float], ...]
) -> tuple[str, float] | None:
    """Return the first name with a reported value, and the value in metres."""
    known = ((name, unit * parameters[name]) for name, unit in names if name in parameters)
    return next(known, None)
