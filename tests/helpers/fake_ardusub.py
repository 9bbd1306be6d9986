"""A vehicle with ArduSub in a process of its own: real MAVLink over UDP, made of pymavlink.

It plays autopilot, router and ground station at once: it obeys the sticks of its ground station's
system id alone, forgets them after its pilot-input fail-safe, and passes the pilot's own sticks on.
It hovers before a plane wall: x is the distance it has moved towards it.

Standard input takes one JSON object a line, each a scripted event (see `Vehicle.play`). Standard
output tells one JSON object a line: its port, every message that it gets, its own events, and 50
times a second where it is.
"""

import argparse
import json
import math
import os
import queue
import select
import sys
import threading
import time
from dataclasses import dataclass, field
from typing import Any

os.environ["MAVLINK20"] = "1"
from pymavlink import mavutil

mavlink = mavutil.mavlink

STEP_S = 0.01
FAST_EVERY, SLOW_EVERY, STICKS_EVERY = 2, 10, 3
GUIDED_LAPSE_S = 3.0
MANUAL, GUIDED = 19, 4
STATION = (255, 190)
PULSES = (("MIN", 1100.0), ("TRIM", 1500.0), ("MAX", 1900.0), ("DZ", 0.0), ("REVERSED", 0.0))
# As ArduSub 4.7 has them after a reset, with its names.
PARAMETERS = {
    "MAV_GCS_SYSID": 255.0,
    "MAV_GCS_SYSID_HI": 0.0,
    "FS_PILOT_INPUT": 2.0,
    "FS_PILOT_TIMEOUT": 3.0,
    "FS_GCS_ENABLE": 2.0,
    "JS_GAIN_DEFAULT": 0.5,
    "JS_THR_GAIN": 1.0,
    "PILOT_SPEED_UP": 500.0,
    "PILOT_SPEED_DN": 0.0,
    "RNGFND1_TYPE": 0.0,
    "THR_DZ": 100.0,
    **{f"RC{n}_{part}": value for n in (3, 4, 5, 6) for part, value in PULSES},
    "RC3_DZ": 30.0,
    "RC4_DZ": 40.0,
}
# For system 1, in body axes (BODY_NED, BODY_FRD), with all but speeds and turning rate left out.
SPEEDS_ALONE = ((1, 8, 1479), (1, 12, 1479))


@dataclass
class Motion:
    """Surge, sway, turning and descent, each of first order."""

    distance: float
    angle: float = 0.0
    aside: float = 0.0
    depth: float = 2.0
    speeds: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0, 0.0])
    full: tuple[float, ...] = (0.8, 0.8, 0.5, 0.8)
    lag_s: float = 0.3

    def step(self, wanted: tuple[float, ...], h: float) -> None:
        """Go on under shares (forward, right, down, clockwise) of full speed."""
        for i, share in enumerate(wanted):
            self.speeds[i] += h / self.lag_s * (self.full[i] * share - self.speeds[i])
        forward, right, down, clockwise = self.speeds
        c, s = math.cos(self.angle), math.sin(self.angle)
        self.distance -= h * (forward * c - right * s)
        self.aside += h * (forward * s + right * c)
        self.angle += h * clockwise
        self.depth += h * down


@dataclass
class Vehicle:
    """ArduSub's manners.

    Attributes
    ----------
    gain : float
        The pilot gain.
    lapse_s : float
        FS_PILOT_TIMEOUT.
    joystick : dict or None
        Axes of the ground station's own `MANUAL_CONTROL`, sent 33 times a second; None without.
    forwards : bool
        Whether the router passes the ground station's sticks on to others.
    station, beats : bool
        Whether ground station and vehicle send heartbeats.
    station_id : int
        System id of the ground station.
    away : bool
        Nothing comes from it and nothing reaches it.
    beat_s : float
        Heartbeats come so far apart, and at once when the mode changes.
    channels_told : bool
        Whether it tells its stick channels.
    obeys : int
        Its ground station, where that is none of its parameters.
    halves : bool
        Half a message goes out before each of its own, as of somebody behind its router.
    parameters : dict
        What it answers when asked; it stays silent about all others, as ArduPilot does.
    """

    motion: Motion
    gain: float
    lapse_s: float
    beat_s: float
    armed: bool = True
    mode: int = 2
    joystick: dict[str, int] | None = None
    forwards: bool = True
    station: bool = True
    station_id: int = STATION[0]
    beats: bool = True
    away: bool = False
    decoy: bool = True
    halves: bool = False
    channels_told: bool = True
    obeys: int = STATION[0]
    sticks: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    sticks_at: float = -math.inf
    lapsed: bool = True
    speeds: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    speeds_at: float = -math.inf
    beat_at: float = 0.0
    parameters: dict[str, float] = field(default_factory=lambda: dict(PARAMETERS))

    def play(self, event: dict[str, Any]) -> None:
        """Play a scripted event: set what it names."""
        distance, angle = event.pop("at", (None, None))
        if distance is not None:
            self.motion = Motion(distance, angle)
        for name, value in event.items():
            assert hasattr(self, name), name
            setattr(self, name, value)
        if "mode" in event:
            self.beat_at = 0.0

    def hear(self, message: Any, now: float) -> None:
        """Obey what ArduSub obeys."""
        kind = message.get_type()
        if kind == "MANUAL_CONTROL":
            if self.is_station(message.get_srcSystem()) and message.target == 1:
                self.take(message.x, message.y, message.z, message.r, now)
        elif kind == "SET_POSITION_TARGET_LOCAL_NED":
            told = (message.target_system, message.coordinate_frame, message.type_mask)
            if told in SPEEDS_ALONE:
                wanted = (message.vx, message.vy, message.vz, message.yaw_rate)
                shares = zip(wanted, self.motion.full, strict=True)
                self.speeds, self.speeds_at = tuple(w / full for w, full in shares), now

    def is_station(self, system: int) -> bool:
        """ArduPilot's `GCS::sysid_is_gcs`."""
        least = self.parameters.get("MAV_GCS_SYSID", self.parameters.get("SYSID_MYGCS", self.obeys))
        return least <= system <= max(least, self.parameters.get("MAV_GCS_SYSID_HI", 0))

    def take(self, x: int, y: int, z: int, r: int, now: float) -> None:
        """Take stick positions, whoever they are from."""
        self.sticks = (x / 1000, y / 1000, (500 - z) / 500, r / 1000)
        self.sticks_at = now
        self.lapsed = False

    def step(self, now: float) -> None:
        """Move on by one step."""
        if not self.lapsed and now - self.sticks_at > self.lapse_s:
            self.lapsed, self.sticks = True, (0.0, 0.0, 0.0, 0.0)
            say(event="fail-safe", after_s=now - self.sticks_at)
        wanted = self.asked()
        if self.mode == GUIDED:
            wanted = self.speeds if now - self.speeds_at < GUIDED_LAPSE_S else (0.0,) * 4
        self.motion.step(wanted if self.armed else (0.0,) * 4, STEP_S)

    def channels(self) -> list[int]:
        """What the stick channels hold, in whole microseconds (joystick.cpp)."""
        forward, right, down, clockwise = (400 * self.gain * s for s in self.sticks)
        pulses = (1500, 1500, 1500 - down, 1500 + clockwise, 1500 + forward, 1500 + right)
        return [min(max(int(pulse), 1100), 1900) for pulse in pulses]

    def asked(self) -> tuple[float, ...]:
        """What depth hold makes of them: dead zones of RC4_DZ and THR_DZ times gain, no expo."""
        _, _, throttle, yaw, forward, right = self.channels()
        dead = int(self.parameters.get("RC4_DZ", 40.0) * self.gain)
        turn = math.copysign(max(abs(yaw - 1500) - dead, 0) / (400 - dead), yaw - 1500)
        control, middle = 1000 * (throttle - 1130) / 770, 1000 * 370 / 770
        band = self.parameters.get("THR_DZ", 100.0) * self.gain
        up = max(control - middle - band, 0.0) / (1000 - middle - band)
        down = max(middle - band - control, 0.0) / (middle - band)
        return (forward - 1500) / 400, (right - 1500) / 400, down - up, turn


class Wire:
    """Two senders on one socket: the vehicle, and the ground station behind its router."""

    def __init__(self, port: int, to: int, key: bytes) -> None:
        url = f"udpout:127.0.0.1:{to}" if to else f"udpin:127.0.0.1:{port}"
        self.link = mavutil.mavlink_connection(url, source_system=1, source_component=1)
        if to:
            self.link.port.bind(("127.0.0.1", port))
        self.port = int(self.link.port.getsockname()[1])
        self.station = mavlink.MAVLink(self.link, *STATION)
        self.extra = mavlink.MAVLink(self.link, 1, 194)
        if key:
            self.link.setup_signing(key)
            self.station.signing = self.extra.signing = self.link.mav.signing
        self.started = time.monotonic()

    def tell_fast(self, v: Vehicle) -> None:
        """Send attitude."""
        ms = round(1e3 * (time.monotonic() - self.started))
        m = v.motion
        heading = (m.angle + math.pi) % (2 * math.pi) - math.pi
        self.link.mav.attitude_send(ms, 0.01, -0.02, heading, 0.0, 0.0, m.speeds[3])

    def tell_slow(self, v: Vehicle) -> None:
        """Send depth four ways, and the stick channels."""
        ms = round(1e3 * (time.monotonic() - self.started))
        deep_mm = round(1e3 * v.motion.depth)
        self.link.mav.global_position_int_send(ms, 0, 0, -deep_mm, -deep_mm, 0, 0, 0, 65535)
        self.link.mav.vfr_hud_send(0.0, 0.0, 0, 0, -v.motion.depth - 0.5, 0.0)
        self.link.mav.ahrs2_send(0.0, 0.0, 0.0, -v.motion.depth - 0.7, 0, 0)
        self.link.mav.scaled_pressure2_send(ms, 1013.0 + 100.5 * v.motion.depth, 0.0, 1500)
        others = [0] * 12
        if v.channels_told:
            self.link.mav.rc_channels_send(ms, 16, *v.channels(), *others, 255)

    def tell_beat(self, v: Vehicle) -> None:
        """Send the heartbeats: the vehicle's, a camera manager's, the ground station's."""
        if v.beats:
            base = 1 | (128 if v.armed else 0)
            self.link.mav.heartbeat_send(12, 3, base, v.mode, 4)
        if v.decoy:
            self.extra.heartbeat_send(30, 8, 128, 0, 4)
        if v.station:
            self.station.srcSystem = v.station_id
            self.station.heartbeat_send(6, 8, 0, 0, 4)

    def answer(self, message: Any, v: Vehicle) -> None:
        """Tell a parameter that was asked for."""
        asked = (message.target_system, message.target_component, message.param_index)
        if asked == (1, 1, -1) and message.param_id in v.parameters:
            name, value = message.param_id, v.parameters[message.param_id]
            kind = mavlink.MAV_PARAM_TYPE_REAL32
            self.link.mav.param_value_send(name.encode(), value, kind, len(v.parameters), 0)

    def tell_sticks(self, v: Vehicle) -> None:
        """Pass the pilot's sticks on, and obey them."""
        if v.joystick is not None:
            axes = {"x": 0, "y": 0, "z": 500, "r": 0, **v.joystick}
            if v.forwards:
                self.station.manual_control_send(1, **axes, buttons=0)
            v.take(**axes, now=time.monotonic())


def say(**what: object) -> None:
    print(json.dumps(what), flush=True)


def heard(message: Any) -> None:
    say(
        kind=message.get_type(),
        fields=message.to_dict(),
        system=message.get_srcSystem(),
        component=message.get_srcComponent(),
        at=time.monotonic(),
    )


def told(v: Vehicle, now: float) -> None:
    m = v.motion
    # The wall's far normal lies to the right of a vehicle that has turned to the left of it.
    where = {"range": m.distance, "yaw": -m.angle, "aside": m.aside, "depth": m.depth}
    say(truth=where, speeds=m.speeds, sticks=v.sticks, at=now)


def read_all(wire: Wire, v: Vehicle) -> None:
    while (message := wire.link.recv_msg()) is not None:
        if message.get_type() != "BAD_DATA" and not v.away:
            heard(message)
            v.hear(message, time.monotonic())
            if message.get_type() == "PARAM_REQUEST_READ":
                wire.answer(message, v)


def listen(script: "queue.Queue[str]", v: Vehicle) -> None:
    """Play what has come on standard input."""
    while not script.empty():
        line = script.get()
        v.play(json.loads(line))
        say(event="played", at=time.monotonic(), line=line.strip())


def read_script(script: "queue.Queue[str]") -> None:
    for line in sys.stdin:
        script.put(line)
    os._exit(0)


def speak(wire: Wire, v: Vehicle, i: int, now: float) -> None:
    if v.halves:
        # Announces 255 bytes more than follow.
        wire.link.write(b"\xfd\xff\x00\x00\x00\x01\x01\x1e\x00\x00")
    if i % FAST_EVERY == 0:
        wire.tell_fast(v)
    if i % SLOW_EVERY == 0:
        wire.tell_slow(v)
    if i % STICKS_EVERY == 0:
        wire.tell_sticks(v)
    if now >= v.beat_at:
        v.beat_at = now + v.beat_s
        wire.tell_beat(v)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--port", type=int, default=0)
    parser.add_argument("--to", type=int, default=0, help="speak to this port first")
    parser.add_argument("--key", type=bytes.fromhex, default=b"", help="sign, and take signed only")
    parser.add_argument("--distance", type=float, default=0.9)
    parser.add_argument("--angle", type=float, default=0.0)
    parser.add_argument("--gain", type=float, default=1.0)
    parser.add_argument("--lapse", type=float, default=0.5)
    parser.add_argument("--beat", type=float, default=0.2)
    args = parser.parse_args()
    script: queue.Queue[str] = queue.Queue()
    threading.Thread(target=read_script, args=(script,), daemon=True).start()
    wire = Wire(args.port, args.to, args.key)
    motion = Motion(args.distance, args.angle)
    v = Vehicle(motion, gain=args.gain, lapse_s=args.lapse, beat_s=args.beat)
    say(port=wire.port)
    i, due = 0, time.monotonic()
    while True:
        listen(script, v)
        read_all(wire, v)
        now = time.monotonic()
        while due <= now:
            v.step(due)
            if i % FAST_EVERY == 0:
                told(v, now)
            if not v.away:
                speak(wire, v, i, now)
            i, due = i + 1, due + STEP_S
        select.select([wire.link.port], [], [], max(0.0, due - time.monotonic()))


if __name__ == "__main__":
    main()
