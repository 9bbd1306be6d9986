"""Link to a vehicle with ArduSub by MAVLink: its state, its pilot's sticks, and our efforts.

The link never arms or disarms, never changes the mode and never presses a button: it sends only
`MANUAL_CONTROL` without buttons, or a speed in GUIDED.

`PilotSticks` detects movements of the pilot's sticks, as far as an onboard computer can see them,
from two messages, because neither arrives everywhere:

- `MANUAL_CONTROL` of the ground station, where the router passes it on. The message's `target` is
  no target field to MAVLink's routing tables, so mavlink-router and ArduPilot's own routing treat
  it as broadcast.
- `RC_CHANNELS` of the vehicle: the stick channels that result from all senders together. Ours are
  among them, scaled by a pilot gain that is not reported; values outside of what we sent in the
  last second are the pilot's.

`DepthChoice` reads the depth from the best message available.
"""

import contextlib
import logging
import math
import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from aqualvs.control.sticks import FULL, MIDDLE, PARAMETERS, Sticks, shaping_of
from aqualvs.control.vehicle import NEUTRAL, Effort, Mode, VehicleState
from aqualvs.errors import OptionError, check_positive
from aqualvs.live.mavlink.ardusub_commands import (
    CENTRE_US,
    MAX_US,
    MIN_US,
    STICK_CHANNELS,
    Command,
    GuidedCommander,
    StickCommander,
    StickResponse,
)
from aqualvs.live.mavlink.ardusub_parameters import (
    FOR_STICKS,
    PILOT_TIMEOUT,
    ParameterWatch,
    StationRange,
    advise_on_fail_safe,
    advise_on_station,
)
from aqualvs.live.mavlink.link import MAV_COMP_ID_ONBOARD_COMPUTER, MavlinkLink, Received
from aqualvs.live.mavlink.peers import SAFETY_ARMED
from aqualvs.scanning.scan import GyroRates
from aqualvs.text import Severity
from aqualvs.vehicle_logs.tlog import DEPTH_FIELDS, PRESSURE_FIELD

FRESH_S = 1.0
"""Older messages are ignored; ground stations send sticks 5 to 50 times a second."""

_INVALID = 32767
# ArduSub turns full deflection at a pilot gain of 1 into 400 us about 1500 us (joystick.cpp).
_FULL_US = 400
_KEPT = 200


class PilotSticks:
    """Detector of movements of the pilot's sticks.

    `own`: system and component in whose name we send sticks ourselves. `dead_band`: deflection, as
    a share of the full one, that counts as centred.
    """

    def __init__(self, link: MavlinkLink, *, own: tuple[int, int], dead_band: float) -> None:
        self._link, self._own, self._dead_band = link, own, dead_band
        self._sent: deque[tuple[int, Sticks]] = deque(maxlen=_KEPT)

    def note(self, sticks: Sticks) -> None:
        """Remember the sticks that we send now."""
        self._sent.append((time.monotonic_ns(), sticks))

    def moved(self) -> bool:
        """Return whether the pilot's sticks are off their centre."""
        # A sender whose sticks are centred must not hide another whose sticks move.
        joysticks = self._link.every("MANUAL_CONTROL")
        return any(map(self._moves, joysticks)) or self._channels_moved()

    def _moves(self, found: Received) -> bool:
        if found.age_s > FRESH_S or (found.system, found.component) == self._own:
            return False
        sticks = found.message
        # The vertical counts from 0 to 1000, the others from -1000 to 1000.
        z = sticks.z if sticks.z == _INVALID else 2 * (sticks.z - MIDDLE)
        swings = (sticks.x, sticks.y, sticks.r, z)
        return any(abs(s) > FULL * self._dead_band for s in swings if s != _INVALID)

    def _channels_moved(self) -> bool:
        found = _fresh(self._link, "RC_CHANNELS")
        if found is None:
            return False
        since = found.received_ns - round(1e9 * FRESH_S)
        # The thread that sends may add while this one reads.
        ours = [s for at, s in self._sent.copy() if since <= at <= found.received_ns]
        message = found.message
        for channel, axis in STICK_CHANNELS:
            if self._exceeds(message, channel, [getattr(sticks, axis) for sticks in ours]):
                return True
        # JS_THR_GAIN scales the vertical by up to 4: while we use that axis, it shows nothing.
        vertical_is_ours = any(s.z != MIDDLE for s in ours)
        return not vertical_is_ours and self._exceeds(message, "chan3_raw", [])

    def _exceeds(self, message: Any, channel: str, ours: list[int]) -> bool:
        """Return whether a channel is outside of the range that our own sticks explain."""
        pulse_us = getattr(message, channel)
        if not MIN_US <= pulse_us <= MAX_US:
            return False
        swing = (pulse_us - CENTRE_US) / _FULL_US
        least, most = min((0, *ours)) / FULL, max((0, *ours)) / FULL
        return not least - self._dead_band <= swing <= most + self._dead_band


class DepthChoice:
    """Reader of the depth; remembers which estimates stood still."""

    def __init__(self, link: MavlinkLink) -> None:
        self._link = link
        self._spans: dict[str, tuple[float, float]] = {}

    def read(self) -> float | None:
        """Return the depth in metres, positive down; None if none is known."""
        # Only its span counts: the pressure at the surface is unknown.
        self._value(*PRESSURE_FIELD)
        found = {kind: self._value(kind, field, scale) for kind, field, scale in DEPTH_FIELDS}
        for kind, depth in found.items():
            if depth is not None and not self._stands_still(kind):
                return depth
        return None

    def _value(self, kind: str, field: str, scale: float) -> float | None:
        received = _fresh(self._link, kind)
        if received is None:
            return None
        value = scale * float(getattr(received.message, field))
        low, high = self._spans.get(kind, (value, value))
        self._spans[kind] = (min(low, value), max(high, value))
        return value

    def _stands_still(self, kind: str) -> bool:
        # An estimate that stands still while the outer pressure changes is that of a filter without
        # origin, not a depth.
        stuck_share, dived_m = 0.1, 0.5
        dived = self._span(PRESSURE_FIELD[0])
        return dived > dived_m and self._span(kind) < stuck_share * dived

    def _span(self, kind: str) -> float:
        low, high = self._spans.get(kind, (0.0, 0.0))
        return high - low


_AUTOPILOT = 1
_ARDUPILOT, _SUBMARINE, _GROUND_STATION = 3, 12, 6
# ArduSub's flight modes (ArduSub/mode.h).
_MODES: Final = {
    0: "STABILIZE",
    1: "ACRO",
    2: "ALT_HOLD",
    3: "AUTO",
    4: "GUIDED",
    7: "CIRCLE",
    9: "SURFACE",
    16: "POSHOLD",
    19: "MANUAL",
    20: "MOTOR_DETECT",
    21: "SURFTRAK",
}
# Two and a half of ArduSub's heartbeats.
_BEATS_WITHIN_S = 2.5
# Depth hold only: in other modes the vehicle sinks or rises at neutral sticks, or steers itself.
_KEEPS_DEPTH: Final = {
    Command.STICKS: ("ALT_HOLD", "POSHOLD", "SURFTRAK"),
    Command.GUIDED: ("GUIDED",),
}
_log = logging.getLogger(__name__)


def attitude_of(link: MavlinkLink) -> tuple[float | None, float | None, float | None]:
    """Return an autopilot's roll, pitch and heading (in [0, 2 pi)), in radians; None if unknown."""
    found = _fresh(link, "ATTITUDE", _AUTOPILOT)
    if found is None:
        return None, None, None
    message = found.message
    return message.roll, message.pitch, message.yaw % (2.0 * math.pi)


def _fresh(link: MavlinkLink, kind: str, component: int | None = None) -> Received | None:
    """Return the vehicle's last message of a kind; None if it is older than `FRESH_S`."""
    found = link.latest(kind, system=link.system, component=component)
    return None if found is None or found.age_s > FRESH_S else found


def gyro_rates_of(link: MavlinkLink, at_ns: int) -> GyroRates | None:
    """Return the turning of an autopilot's vehicle; None if it is unknown.

    `at_ns`: time of a picture, by `time.monotonic_ns`.
    """
    found = _fresh(link, "ATTITUDE", _AUTOPILOT)
    if found is None:
        return None
    message = found.message
    # Forward, right, down to the dome's right, forward, up.
    rates = np.array([message.pitchspeed, message.rollspeed, -message.yawspeed])
    # A vehicle changes its rates by so much (rad/s², as in `row_motion`) in the time between the
    # message and the picture. Of that, the delay of camera and network is not known; this (s) is
    # that of a usual stream.
    acceleration, delay = math.radians(40.0), 0.1
    # A net in swell turns by itself (rad/s): rocking by 3 degrees in 7 s, rms.
    target = math.radians(2.0)
    # The axes of autopilot and dome differ by some 5 degrees, which is this share of the rates.
    mounting = 0.1
    apart = math.hypot(1e-9 * (found.received_ns - at_ns), delay)
    sigma = math.hypot(acceleration * apart, target, mounting * float(np.linalg.norm(rates)))
    return GyroRates(rates, sigma) if math.isfinite(sigma) else None


@dataclass(frozen=True, slots=True, kw_only=True)
class ArduSubOptions:
    """Options of steering ArduSub, and of the ground station that must be present."""

    command: Command = Command.STICKS  # Sticks, or speeds in GUIDED.
    # Modes in which it takes our efforts; empty for ALT_HOLD, or GUIDED.
    modes: tuple[str, ...] = ()
    # System id of the ground station, the vehicle's MAV_GCS_SYSID (before ArduSub 4.7:
    # SYSID_MYGCS). Sticks are sent in its name: ArduSub ignores all others.
    ground_station: int = 255
    # Without its heartbeat for this time no efforts are sent: our own sticks would keep ArduSub
    # from noticing that its ground station is gone. None if no station is required.
    station_timeout_s: float | None = 3.0
    # Deflection of the pilot's sticks that counts as centred, as a share of the full one.
    stick_dead_band: float = 0.1
    # In GUIDED: what an effort of 1 forward, right or down asks for, in m/s; and in yaw, in rad/s.
    speed: float = 0.3
    turning_rate: float = math.radians(30.0)

    def __post_init__(self) -> None:
        """Check every value.

        Raises `OptionError` if one makes no sense.
        """
        allowed = _KEEPS_DEPTH[self.command]
        for mode in self.modes:
            if mode not in allowed:
                raise OptionError(
                    f"ArduSub mode {mode}: cannot be steered by {self.command}; choose of "
                    f"{', '.join(allowed)}"
                )
        if not 1 <= self.ground_station <= 255:
            raise OptionError(
                f"ArduSub ground_station {self.ground_station}: must lie between 1 and 255"
            )
        timeout = () if self.station_timeout_s is None else ("station_timeout_s",)
        check_positive("ArduSub", self, *timeout, "speed", "turning_rate")
        if not 0.0 < self.stick_dead_band < 1.0:
            raise OptionError(
                f"ArduSub stick_dead_band {self.stick_dead_band:g}: must lie between 0 and 1"
            )

    @property
    def own_modes(self) -> tuple[str, ...]:
        """The modes in which efforts are taken."""
        return self.modes or _KEEPS_DEPTH[self.command][:1]


class ArduSubLink:
    """A vehicle with ArduSub, as `aqualvs.control.vehicle.VehicleLink`.

    `link`: not closed here, since others use it too. `advises`: whether settings of the vehicle
    that are not safe are logged.
    """

    def __init__(
        self, link: MavlinkLink, options: ArduSubOptions | None = None, *, advises: bool = True
    ) -> None:
        self.options = options or ArduSubOptions()
        self.link = link
        self.name = f"ArduSub {self.link.url}"
        # Not a ground station's own component (190 as a rule): a router would take the two for one,
        # and keep its messages from us.
        self._sender = (self.options.ground_station, MAV_COMP_ID_ONBOARD_COMPUTER)
        self._commander: StickCommander | GuidedCommander = (
            StickCommander(self.link, self._sender)
            if self.options.command is Command.STICKS
            else GuidedCommander(
                self.link, speed=self.options.speed, turning_rate=self.options.turning_rate
            )
        )
        dead_band = self.options.stick_dead_band
        self._sticks = PilotSticks(self.link, own=self._sender, dead_band=dead_band)
        self._depth = DepthChoice(self.link)
        self._response = StickResponse(self.link)
        self._watch = ParameterWatch(self.link, FOR_STICKS)
        # The autopilot takes ten requests at once.
        self._shaping_watches = [
            ParameterWatch(self.link, PARAMETERS[k : k + 10]) for k in range(0, len(PARAMETERS), 10)
        ]
        self._advised = not advises
        # A watchdog sends from a thread of its own.
        self._sending = threading.Lock()
        self._sent_s = float("-inf")
        self._closed = False

    def state(self) -> VehicleState:
        """Return the latest state; returns at once."""
        beat = self.link.latest("HEARTBEAT", system=self.link.system, component=_AUTOPILOT)
        if beat is None:
            return VehicleState()
        parameters = self._watch.read()
        self._advise(parameters)
        mode, mode_name = self._mode(beat, parameters)
        self._update_shaping(beat)
        roll, pitch, heading = attitude_of(self.link)
        return VehicleState(
            heard_s=self._last_heard_s(beat),
            armed=bool(beat.message.base_mode & SAFETY_ARMED),
            mode=mode,
            mode_name=mode_name,
            pilot_moves=self._sticks.moved(),
            depth=self._depth.read(),
            heading=heading,
            roll=roll,
            pitch=pitch,
            doubt=self._response.doubt(),
            rival=self.link.rival,
        )

    def send(self, effort: Effort) -> None:
        """Ask for an effort; returns at once.

        ArduSub keeps it until another one comes, from us or from the ground station, or until its
        pilot-input fail-safe (FS_PILOT_TIMEOUT; in GUIDED 3 s) has run out.

        Raises `OSError` if it could not be sent. Raises `ValueError` if a part of it is not finite;
        neutral is sent then.
        """
        sent = self._send(effort if effort.is_finite else NEUTRAL)
        if not effort.is_finite:
            raise ValueError(f"effort is not finite: {effort}")
        if not sent:
            raise OSError(f"{self.name}: not sent; {self.link.health().detail}")

    def close(self) -> None:
        """Send neutral, if efforts may still be in force; further calls do nothing."""
        # Sticks used within this time may still be in force when the link is closed.
        lately_s = 3.0
        goodbyes, goodbye_every_s = 3, 0.02
        if self._closed:
            return
        self._closed = True
        if time.monotonic() - self._sent_s < lately_s:
            for _ in range(goodbyes):
                with contextlib.suppress(OSError):
                    self._send(NEUTRAL)
                time.sleep(goodbye_every_s)

    def _send(self, effort: Effort) -> bool:
        with self._sending:
            if isinstance(self._commander, StickCommander):
                sticks = self._commander.sticks(effort)
                self._sticks.note(sticks)
                self._response.note(sticks)
            message, packer = self._commander.message(effort), self._commander.packer
            sent = self.link.send(message, urgent=True, to_vehicle=True, packer=packer)
            self._sent_s = time.monotonic() if sent else self._sent_s
        return sent

    def _update_shaping(self, beat: Received) -> None:
        """Compensate the vehicle's reported conversion of the sticks."""
        if not isinstance(self._commander, StickCommander):
            return
        known: dict[str, float] = {}
        for watch in self._shaping_watches:
            known = watch.read()
        keeps_place = _MODES.get(beat.message.custom_mode) == "POSHOLD"
        with self._sending:
            self._commander.shaping = shaping_of(known)
            self._commander.keeps_place = keeps_place

    def _advise(self, parameters: dict[str, float]) -> None:
        """Log advice on the vehicle's settings once, when they are known or stay unanswered."""
        if self._advised or self.options.command is not Command.STICKS:
            return
        is_known = StationRange(parameters).known and PILOT_TIMEOUT in parameters
        if not is_known and not self._watch.has_waited:
            return
        self._advised = True
        advice = advise_on_station(parameters, self.options.ground_station)
        for one in (advice, *advise_on_fail_safe(parameters)):
            if one.severity is not Severity.OK:
                _log.warning("%s: %s", self.name, one.sentence)

    def _mode(self, beat: Received, parameters: dict[str, float]) -> tuple[Mode, str]:
        heard = beat.message
        if heard.autopilot != _ARDUPILOT or heard.type != _SUBMARINE:
            return Mode.UNKNOWN, f"not ArduSub (vehicle type {heard.type})"
        name = _MODES.get(heard.custom_mode, f"mode {heard.custom_mode}")
        if name not in self.options.own_modes:
            return Mode.PILOT, name
        if self.link.conflict:
            return Mode.CONFLICT, f"{name}; {self.link.conflict}"
        obeyed, station = StationRange(parameters), self.options.ground_station
        by_sticks = self.options.command is Command.STICKS
        if by_sticks and obeyed.known and station not in obeyed:
            # The vehicle has reported that it takes only others' sticks.
            return Mode.IGNORED, f"{name}; {advise_on_station(parameters, station).sentence}"
        if not self._is_supervised():
            return Mode.NO_STATION, f"{name}; {self._missing_station()}"
        return Mode.OURS, name

    def _is_supervised(self) -> bool:
        """Return whether the ground station is there, or need not be."""
        timeout_s = self.options.station_timeout_s
        if timeout_s is None:
            return True
        beat = self.link.latest("HEARTBEAT", system=self.options.ground_station)
        if beat is None or beat.message.type != _GROUND_STATION:
            return False
        return beat.age_s < timeout_s

    def _missing_station(self) -> str:
        """Say which ground station is missing, and which is there instead."""
        wanted = f"no heartbeat of ground station {self.options.ground_station}"
        others = {
            beat.system
            for beat in self.link.every("HEARTBEAT")
            if beat.message.type == _GROUND_STATION and beat.age_s < _BEATS_WITHIN_S
        } - {self.options.ground_station}
        return f"{wanted}, but of {', '.join(map(str, sorted(others)))}" if others else wanted

    def _last_heard_s(self, beat: Received) -> float:
        """Return when the vehicle was heard last.

        Heartbeats come once a second, attitude ten times and more: between two heartbeats attitude
        tells that the vehicle is there. Without heartbeats it does not count: mode and arming are
        then unknown.
        """
        heard_ns = beat.received_ns
        attitude = self.link.latest("ATTITUDE", system=self.link.system, component=_AUTOPILOT)
        if attitude is not None and beat.age_s < _BEATS_WITHIN_S:
            heard_ns = max(heard_ns, attitude.received_ns)
        return 1e-9 * heard_ns
