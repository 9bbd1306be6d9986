"""The link to ArduSub: what it makes of messages, and messages of efforts."""

import math
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aqualvs.control.sticks import StickShaping
from aqualvs.control.vehicle import NEUTRAL, Effort, Mode
from aqualvs.errors import OptionError
from aqualvs.geometry.transforms import SE3
from aqualvs.live.mavlink.ardusub import ArduSubLink, ArduSubOptions, gyro_rates_of
from aqualvs.live.mavlink.ardusub_commands import Command
from aqualvs.live.mavlink.link import Received, packed
from aqualvs.simulation.dive import vehicle_attitude
from aqualvs.simulation.scenario import dome_from_target

dialect = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega")

SHARES = st.floats(-2.0, 2.0)
EFFORTS = st.builds(Effort, forward=SHARES, right=SHARES, down=SHARES, yaw=SHARES)


class Wire:
    """A MAVLink connection in memory: keeps what was sent, and gives what tests put in."""

    def __init__(self) -> None:
        self.url, self.system, self.dialect = "udpout:nowhere", 1, dialect
        self.packer = dialect.MAVLink(None, 1, 191)
        self.heard: dict[tuple[str, int, int], Received] = {}
        self.sent: list[Any] = []
        self.works = True
        self.conflict = self.rival = ""
        self.told: dict[str, float] = {}
        self.asked: list[str] = []

    def parameters(self) -> dict[str, float]:
        return dict(self.told)

    def ask_parameters(self, names: list[str]) -> None:
        self.asked += names

    def autopilot(self) -> Received | None:
        return self.latest("HEARTBEAT", system=1)

    def make_packer(self, system: int, component: int) -> Any:
        return dialect.MAVLink(None, system, component)

    def send(
        self, *messages: Any, urgent: bool = False, to_vehicle: bool = False, packer: Any = None
    ) -> bool:
        assert urgent
        assert to_vehicle
        reader = dialect.MAVLink(None)
        for message in messages if self.works else ():
            self.sent.extend(reader.parse_buffer(packed(message, packer or self.packer)))
        return self.works

    def health(self) -> Any:
        return SimpleNamespace(detail="nobody listens")

    def latest(
        self, kind: str, *, system: int | None = None, component: int | None = None
    ) -> Received | None:
        found = [
            entry
            for entry in self.every(kind)
            if system in (None, entry.system) and component in (None, entry.component)
        ]
        return max(found, key=lambda entry: entry.received_ns, default=None)

    def every(self, kind: str) -> list[Received]:
        return [entry for (name, *_), entry in self.heard.items() if name == kind]

    def put(
        self, kind: str, sender: tuple[int, int] = (1, 1), age_s: float = 0.0, **f: Any
    ) -> None:
        at = time.monotonic_ns() - round(1e9 * age_s)
        self.heard[kind, *sender] = Received(SimpleNamespace(**f), at, *sender)

    def beat(self, mode: int = 2, base: int = 129, age_s: float = 0.0, **other: int) -> None:
        fields = {"autopilot": 3, "type": 12, "base_mode": base, "custom_mode": mode, **other}
        self.put("HEARTBEAT", age_s=age_s, **fields)


@pytest.fixture
def wire() -> Wire:
    """ArduSub in depth hold, armed, and its ground station."""
    made = Wire()
    made.beat()
    made.put("HEARTBEAT", (255, 190), type=6, autopilot=8, base_mode=0)
    return made


@pytest.fixture
def vehicle(wire: Wire) -> Iterator[ArduSubLink]:
    made = on(wire)
    yield made
    made.close()


def on(wire: Any, **options: Any) -> ArduSubLink:
    return ArduSubLink(wire, ArduSubOptions(**options))


def test_nothing_heard() -> None:
    state = on(Wire()).state()
    assert (state.mode, state.armed, state.heard_s) == (Mode.UNKNOWN, False, -math.inf)


@pytest.mark.parametrize(
    ("options", "number", "mode", "name"),
    [
        ({}, 2, Mode.OURS, "ALT_HOLD"),
        ({}, 16, Mode.PILOT, "POSHOLD"),
        ({"modes": ("ALT_HOLD", "POSHOLD")}, 16, Mode.OURS, "POSHOLD"),
        ({}, 0, Mode.PILOT, "STABILIZE"),
        ({}, 19, Mode.PILOT, "MANUAL"),
        ({}, 21, Mode.PILOT, "SURFTRAK"),
        ({}, 99, Mode.PILOT, "mode 99"),
        ({"command": Command.GUIDED}, 4, Mode.OURS, "GUIDED"),
        ({"command": Command.GUIDED}, 2, Mode.PILOT, "ALT_HOLD"),
    ],
)
def test_modes(wire: Wire, options: Any, number: int, mode: Mode, name: str) -> None:
    wire.beat(number)
    state = on(wire, **options).state()
    assert (state.mode, state.mode_name, state.armed) == (mode, name, True)


def test_only_the_autopilots_own_heartbeat_counts(wire: Wire, vehicle: ArduSubLink) -> None:
    wire.beat(base=1)
    # A camera manager of the same system, later, with the bit that means armed.
    wire.put("HEARTBEAT", (1, 194), autopilot=8, type=30, base_mode=128, custom_mode=0)
    assert not vehicle.state().armed
    wire.beat(type=2)
    assert vehicle.state().mode is Mode.UNKNOWN
    assert "not ArduSub" in vehicle.state().mode_name


def test_no_ground_station_no_efforts(wire: Wire) -> None:
    wire.put("HEARTBEAT", (255, 190), age_s=3.5, type=6, autopilot=8, base_mode=0)
    assert on(wire).state().mode is Mode.NO_STATION
    assert on(wire, station_timeout_s=5.0).state().mode is Mode.OURS
    assert on(wire, station_timeout_s=None).state().mode is Mode.OURS
    assert on(wire, station_timeout_s=5.0, ground_station=254).state().mode is Mode.NO_STATION
    wire.put("HEARTBEAT", (255, 190), type=18, autopilot=8, base_mode=0)
    assert on(wire).state().mode is Mode.NO_STATION


def test_a_missing_ground_station_is_named_with_the_one_that_is_there(wire: Wire) -> None:
    state = on(wire, ground_station=250).state()
    assert state.mode_name == "ALT_HOLD; no heartbeat of ground station 250, but of 255"


def test_heartbeats_that_contradict_each_other_are_no_mode_of_ours(wire: Wire) -> None:
    wire.conflict = "heartbeats contradict each other"
    state = on(wire).state()
    assert state.mode is Mode.CONFLICT
    assert "contradict" in state.mode_name


def test_heard_between_heartbeats_by_attitude(wire: Wire, vehicle: ArduSubLink) -> None:
    wire.beat(age_s=0.9)
    assert time.monotonic() - vehicle.state().heard_s > 0.9
    wire.put("ATTITUDE", roll=0.1, pitch=-0.2, yaw=-math.pi / 2)
    state = vehicle.state()
    assert time.monotonic() - state.heard_s < 0.5
    assert (state.roll, state.pitch, state.heading) == pytest.approx((0.1, -0.2, 1.5 * math.pi))
    wire.beat(age_s=2.6)
    assert time.monotonic() - vehicle.state().heard_s > 2.5
    wire.put("ATTITUDE", age_s=1.5, roll=0.1, pitch=-0.2, yaw=0.0)
    assert vehicle.state().heading is None


def test_gyros_turn_the_axes_of_the_dome(wire: Wire) -> None:
    def pose(t: float) -> SE3:
        return dome_from_target(0.6, 0.1 + 0.3 * t, -0.2 + 0.5 * t)

    # Body rates of a flight controller by the rates of heading, roll and pitch.
    step = 1e-4
    heading, roll, pitch = vehicle_attitude(pose(0.0))
    before, after = (np.array(vehicle_attitude(pose(t))) for t in (-step, step))
    to_heading, to_roll, to_pitch = (after - before) / (2.0 * step)
    wire.put(
        "ATTITUDE",
        roll=roll,
        pitch=pitch,
        yaw=heading,
        rollspeed=to_roll - to_heading * math.sin(pitch),
        pitchspeed=to_pitch * math.cos(roll) + to_heading * math.sin(roll) * math.cos(pitch),
        yawspeed=-to_pitch * math.sin(roll) + to_heading * math.cos(roll) * math.cos(pitch),
    )
    found = gyro_rates_of(wire, time.monotonic_ns())
    assert found is not None
    seen = [pose(t).rotation for t in (-step, step)]
    spin = -(seen[1] - seen[0]) / (2.0 * step) @ pose(0.0).rotation.T
    assert found.rates == pytest.approx([spin[2, 1], spin[0, 2], spin[1, 0]], abs=1e-6)
    assert float(np.linalg.norm(found.rates)) > 0.4


def test_gyros_are_worth_less_with_time_and_motion(wire: Wire) -> None:
    def sigma(age_s: float, rate: float) -> float:
        wire.put("ATTITUDE", age_s=age_s, rollspeed=0.0, pitchspeed=0.0, yawspeed=rate)
        found = gyro_rates_of(wire, time.monotonic_ns())
        assert found is not None
        return math.degrees(found.sigma)

    assert gyro_rates_of(wire, time.monotonic_ns()) is None
    # Of a stream of unknown delay, and a net that moves by itself.
    assert 4.0 < sigma(0.0, 0.0) < 5.0
    assert 20.0 < sigma(0.5, 0.0) < 22.0
    assert 10.0 < sigma(0.0, math.radians(90.0)) < 11.0
    wire.put("ATTITUDE", rollspeed=math.nan, pitchspeed=0.0, yawspeed=0.0)
    assert gyro_rates_of(wire, time.monotonic_ns()) is None
    wire.put("ATTITUDE", age_s=1.5, rollspeed=0.0, pitchspeed=0.0, yawspeed=0.0)
    assert gyro_rates_of(wire, time.monotonic_ns()) is None


def test_depth_from_the_best_message(wire: Wire, vehicle: ArduSubLink) -> None:
    assert vehicle.state().depth is None
    wire.put("AHRS2", altitude=-5.2)
    assert vehicle.state().depth == pytest.approx(5.2)
    wire.put("VFR_HUD", alt=-5.1)
    assert vehicle.state().depth == pytest.approx(5.1)
    wire.put("GLOBAL_POSITION_INT", relative_alt=-5000)
    assert vehicle.state().depth == pytest.approx(5.0)
    wire.put("GLOBAL_POSITION_INT", age_s=1.2, relative_alt=-5000)
    assert vehicle.state().depth == pytest.approx(5.1)


def test_depth_that_stands_still_while_the_pressure_changes_is_none(
    wire: Wire, vehicle: ArduSubLink
) -> None:
    for deeper in (0.0, 0.4, 1.0):
        wire.put("GLOBAL_POSITION_INT", relative_alt=-10)
        wire.put("VFR_HUD", alt=-2.0 - deeper)
        wire.put("SCALED_PRESSURE2", press_abs=1200.0 + 100.5 * deeper)
        depth = vehicle.state().depth
    assert depth == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("sticks", "moves"),
    [
        ({}, False),
        ({"x": 90}, False),
        ({"x": -150}, True),
        ({"y": 150}, True),
        ({"r": 150}, True),
        ({"z": 540}, False),
        ({"z": 440}, True),
        ({"x": 32767}, False),
    ],
)
def test_joystick_of_the_ground_station(
    wire: Wire, vehicle: ArduSubLink, sticks: dict[str, int], moves: bool
) -> None:
    axes = {"x": 0, "y": 0, "z": 500, "r": 0, **sticks}
    wire.put("MANUAL_CONTROL", (255, 190), **axes)
    assert vehicle.state().pilot_moves is moves
    wire.put("MANUAL_CONTROL", (255, 190), age_s=1.1, **axes)
    assert not vehicle.state().pilot_moves


@pytest.mark.parametrize(
    ("told", "mode"),
    [
        ({}, Mode.OURS),
        ({"MAV_GCS_SYSID": 255}, Mode.OURS),
        ({"MAV_GCS_SYSID": 250}, Mode.IGNORED),
        ({"SYSID_MYGCS": 250}, Mode.IGNORED),
        ({"MAV_GCS_SYSID": 250, "MAV_GCS_SYSID_HI": 255}, Mode.OURS),
        ({"MAV_GCS_SYSID": 250, "MAV_GCS_SYSID_HI": 254}, Mode.IGNORED),
        ({"MAV_GCS_SYSID": 255, "MAV_GCS_SYSID_HI": 3}, Mode.OURS),
    ],
)
def test_whose_sticks_the_vehicle_obeys(wire: Wire, told: dict[str, float], mode: Mode) -> None:
    wire.told = told
    state = on(wire).state()
    assert state.mode is mode
    if mode is Mode.IGNORED:
        assert f"set {next(iter(told))} 255, or ground_station 250" in state.mode_name


def test_speeds_are_obeyed_whoever_sends_them(wire: Wire) -> None:
    wire.beat(4)
    wire.told = {"MAV_GCS_SYSID": 250}
    assert on(wire, command=Command.GUIDED).state().mode is Mode.OURS


def test_parameters_are_asked_for_until_they_are_known(wire: Wire, vehicle: ArduSubLink) -> None:
    vehicle.state()
    assert {"MAV_GCS_SYSID", "SYSID_MYGCS", "FS_PILOT_INPUT"} <= set(wire.asked)
    n = len(wire.asked)
    vehicle.state()
    # Not with every frame.
    assert len(wire.asked) == n


def channels(**moved: int) -> dict[str, int]:
    centred = {f"chan{i}_raw": 1500 for i in range(1, 7)}
    return {**centred, **{f"chan{name[1:]}_raw": pulse for name, pulse in moved.items()}}


def responding(
    wire: Wire, vehicle: ArduSubLink, sticks: list[float], answer: Any, monkeypatch: Any
) -> str:
    """Send sticks ten times a second while channels answer; return the last doubt."""
    now_s = time.monotonic()
    doubt = ""
    for i, stick in enumerate(sticks):
        at_s = now_s + 0.1 * i
        monkeypatch.setattr(time, "monotonic", lambda at_s=at_s: at_s)
        monkeypatch.setattr(time, "monotonic_ns", lambda at_s=at_s: round(1e9 * at_s))
        vehicle.send(Effort(forward=stick))
        told = answer(stick)
        if told is not None:
            wire.put("RC_CHANNELS", **channels(c5=told))
        wire.beat()
        doubt = vehicle.state().doubt
    return doubt


@pytest.mark.parametrize(
    ("answer", "doubted"),
    [
        (lambda _: 1500, "does not follow"),
        (lambda _: 0, "does not follow"),
        (lambda s: 1500 + round(40 * s), ""),
        (lambda s: 1500 + round(400 * s), ""),
        (lambda _: None, "is not received"),
    ],
)
def test_sticks_that_are_not_obeyed_are_doubted(
    wire: Wire, vehicle: ArduSubLink, monkeypatch: pytest.MonkeyPatch, answer: Any, doubted: str
) -> None:
    steady = [0.3] * 50
    swinging = [0.4 * (-1) ** i for i in range(50)]
    for sticks in (steady, swinging):
        found = responding(wire, vehicle, sticks, answer, monkeypatch)
        assert (doubted in found) if doubted else (found == "")
        monkeypatch.undo()
        vehicle = on(wire)


def test_sticks_too_small_to_tell_are_not_doubted(
    wire: Wire, vehicle: ArduSubLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert responding(wire, vehicle, [0.02] * 50, lambda _: 1500, monkeypatch) == ""


def test_one_who_holds_his_sticks_still_does_not_hide_another(
    wire: Wire, vehicle: ArduSubLink
) -> None:
    wire.put("MANUAL_CONTROL", (255, 190), age_s=0.1, x=500, y=0, z=500, r=0)
    wire.put("MANUAL_CONTROL", (255, 1), x=0, y=0, z=500, r=0)
    assert vehicle.state().pilot_moves


def test_sticks_seen_by_the_vehicles_channels(wire: Wire, vehicle: ArduSubLink) -> None:
    for name in ("c3", "c4", "c5", "c6"):
        wire.put("RC_CHANNELS", **channels(**{name: 1600}))
        assert vehicle.state().pilot_moves, name
        wire.put("RC_CHANNELS", **channels(**{name: 1535}))
        assert not vehicle.state().pilot_moves, name
        wire.put("RC_CHANNELS", **channels(**{name: 0}))
        assert not vehicle.state().pilot_moves, name


def test_own_sticks_are_not_the_pilots(wire: Wire, vehicle: ArduSubLink) -> None:
    vehicle.send(Effort(forward=0.8, yaw=-0.5, down=0.6))
    for gain in (0.2, 0.5, 1.0):
        ours = channels(
            c5=1500 + round(320 * gain), c4=1500 - round(200 * gain), c3=1500 - round(240 * gain)
        )
        wire.put("RC_CHANNELS", **ours)
        assert not vehicle.state().pilot_moves, gain
    wire.put("RC_CHANNELS", **channels(c5=1400))
    assert vehicle.state().pilot_moves
    wire.put("RC_CHANNELS", **channels(c5=1600, c6=1600))
    assert vehicle.state().pilot_moves


def test_neutral_on_the_wire(wire: Wire, vehicle: ArduSubLink) -> None:
    vehicle.send(NEUTRAL)
    (told,) = wire.sent
    assert (told.get_srcSystem(), told.get_srcComponent()) == (255, 191)
    assert (told.target, told.x, told.y, told.z, told.r) == (1, 0, 0, 500, 0)
    assert (told.buttons, told.buttons2, told.enabled_extensions) == (0, 0, 0)


def test_frames_are_numbered_by_their_own_sender(wire: Wire, vehicle: ArduSubLink) -> None:
    for _ in range(258):
        vehicle.send(NEUTRAL)
    assert [told.get_seq() for told in wire.sent] == [i % 256 for i in range(258)]
    assert wire.packer.seq == 0


@given(EFFORTS)
def test_sticks_stay_within_bounds_and_keep_their_signs(effort: Effort) -> None:
    sticks = StickShaping().sticks(effort)
    assert all(-1000 <= axis <= 1000 for axis in (sticks.x, sticks.y, sticks.r))
    assert 0 <= sticks.z <= 1000
    for share, counts in (
        (effort.forward, sticks.x),
        (effort.right, sticks.y),
        (effort.down, 500 - sticks.z),
        (effort.yaw, sticks.r),
    ):
        # A pulse of a microsecond is five counts at a gain of 0.5.
        assert share * counts >= 0.0
        assert bool(counts) or abs(share) < 0.006


def test_speeds_in_body_axes(wire: Wire) -> None:
    vehicle = on(wire, command=Command.GUIDED, speed=0.4, turning_rate=0.6)
    vehicle.send(Effort(forward=0.5, right=-1.0, down=0.25, yaw=3.0))
    (told,) = wire.sent
    assert (told.get_srcSystem(), told.get_srcComponent()) == (1, 191)
    assert (told.target_system, told.target_component) == (1, 1)
    assert told.coordinate_frame == dialect.MAV_FRAME_BODY_NED
    # Position, acceleration and yaw are left out; speeds and turning rate are not.
    assert told.type_mask == 0b0000_0101_1100_0111
    speeds = (told.vx, told.vy, told.vz, told.yaw_rate)
    assert speeds == pytest.approx((0.2, -0.4, 0.1, 0.6))


@pytest.mark.parametrize("name", ["forward", "right", "down", "yaw"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_is_no_number_becomes_neutral(
    wire: Wire, vehicle: ArduSubLink, name: str, value: float
) -> None:
    effort = Effort(**{"forward": 0.5, name: value})
    assert not effort.is_finite
    with pytest.raises(ValueError, match="not finite"):
        vehicle.send(effort)
    (told,) = wire.sent
    assert (told.x, told.y, told.z, told.r) == (0, 0, 500, 0)


def test_unsent_efforts_are_told(wire: Wire, vehicle: ArduSubLink) -> None:
    wire.works = False
    with pytest.raises(OSError, match="nobody listens"):
        vehicle.send(NEUTRAL)


def test_closing_says_neutral_only_where_efforts_were_sent(wire: Wire) -> None:
    on(wire).close()
    assert not wire.sent
    vehicle = on(wire)
    vehicle.send(Effort(forward=1.0))
    vehicle.close()
    vehicle.close()
    assert [told.x for told in wire.sent] == [1000, 0, 0, 0]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"modes": ("MANUAL",)}, "MANUAL"),
        ({"modes": ("GUIDED",)}, "GUIDED"),
        ({"modes": ("ALT_HOLD",), "command": Command.GUIDED}, "ALT_HOLD"),
        ({"ground_station": 0}, "ground_station 0"),
        ({"station_timeout_s": 0.0}, "station_timeout_s 0"),
        ({"speed": math.inf}, "speed inf"),
        ({"turning_rate": -1.0}, "turning_rate -1"),
        ({"stick_dead_band": 1.0}, "stick_dead_band 1"),
    ],
)
def test_options_that_make_no_sense(options: Any, words: str) -> None:
    with pytest.raises(OptionError, match=words):
        ArduSubOptions(**options)
