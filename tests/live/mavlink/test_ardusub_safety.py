"""Every safety rule, on the real MAVLink wire: what the other process gets, and when.

Rules say within what time; a machine that is busy adds to it. Each test measures by how much the
two processes were held up meanwhile, and allows that and 50 ms on top of the rule.
"""

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from aqualvs.control.safety import SafetyLimits
from aqualvs.control.vehicle import Effort, Setpoint
from aqualvs.errors import OptionError
from aqualvs.live.mavlink.ardusub import ArduSubLink, ArduSubOptions
from aqualvs.live.mavlink.ardusub_commands import Command
from aqualvs.live.mavlink.link import MavlinkLink
from aqualvs.scanning.posture import Reason, Refusal
from aqualvs.sources.base import State
from repository import HELPERS

pytest.importorskip("pymavlink")

from fake_ardusub_cases import (
    AT_START,
    FRAME_S,
    MARGIN_S,
    STEERED,
    WITHIN_S,
    Dive,
    Fake,
    assert_released,
    assert_stopped,
    is_neutral,
    posture,
    pushed,
    pushing,
    until,
    within,
)
from waiting import TIMEOUT_S

LAPSE_S = 0.5
MakeDive = Callable[..., Dive]


@pytest.fixture(scope="module")
def vehicle() -> Iterator[Fake]:
    """One other process for all tests."""
    fake = Fake("--lapse", str(LAPSE_S))
    yield fake
    fake.stop()


@pytest.fixture
def fake(vehicle: Fake) -> Iterator[Fake]:
    """The vehicle at 0.9 m, armed, in depth hold; at the end, what it was never to be told."""
    vehicle.play(**AT_START)
    n = len(vehicle.wire)
    yield vehicle
    for message in vehicle.wire[n:]:
        kind, sender = message["kind"], (message["system"], message["component"])
        assert kind in ("HEARTBEAT", "PARAM_REQUEST_READ", *STEERED)
        if kind == "MANUAL_CONTROL":
            fields = message["fields"]
            assert sender == (255, 191)
            assert (fields["target"], fields["buttons"], fields["buttons2"]) == (1, 0, 0)
            assert fields["enabled_extensions"] == 0
        else:
            assert sender == (1, 191)


@pytest.fixture
def dive(fake: Fake) -> Iterator[MakeDive]:
    """Makes dives and ends them."""
    made: list[Dive] = []

    def make(**options: Any) -> Dive:
        made.append(Dive(fake, **options))
        return made[-1]

    yield make
    for one in made:
        one.close()


def test_holds_range_and_yaw(fake: Fake, dive: MakeDive) -> None:
    fake.play(at=[0.8, -0.3])
    one = dive(setpoint=Setpoint(0.6))
    pushed(one)
    until(
        lambda: abs(fake.truth["range"] - 0.6) < 0.03 and abs(fake.truth["yaw"]) < 0.03,
        "range and yaw as wanted",
    )
    assert one.pilot.engaged
    assert one.pilot.health().state is State.OK
    assert min(t["truth"]["range"] for t in fake.truths if t["at"] > one.began) > 0.5


def test_sends_nothing_until_engaged(fake: Fake, dive: MakeDive) -> None:
    one = dive(setpoint=None)
    until(lambda: one.vehicle.state().mode == "ours", "a vehicle")
    with pytest.raises(OptionError, match="no range is set"):
        one.pilot.engage()
    one.holder.put(Setpoint(0.6))
    fake.play(mode=19)
    until(lambda: one.vehicle.state().mode_name == "MANUAL", "another mode")
    with pytest.raises(OptionError, match="another mode"):
        one.pilot.engage()
    assert not fake.steered(one.began)
    assert one.pilot.health().state is State.OFF


@pytest.mark.parametrize("how", ["refused", "silent", "hangs"])
def test_neutral_without_a_posture_and_on_again_with_one(
    fake: Fake, dive: MakeDive, how: str
) -> None:
    one = dive()
    pushed(one)
    as_before = one.frames.seen
    if how == "refused":
        one.frames.seen = lambda: Refusal(Reason.NO_STRIPES)
    elif how == "silent":
        one.frames.flows = False
    else:
        one.frames.hangs = True
    time.sleep(0.05)
    at = one.last_seen_s
    assert_stopped(one, at)
    assert one.pilot.engaged
    one.frames.seen, one.frames.flows, one.frames.hangs = as_before, True, False
    until(lambda: pushing(fake), "an effort again")


def test_a_posture_that_was_measured_too_late_is_none(fake: Fake, dive: MakeDive) -> None:
    one = dive()
    pushed(one)

    def slowly() -> Any:
        seen = posture(fake.truth["range"])
        time.sleep(0.4)
        return seen

    one.frames.seen = slowly
    at = one.last_seen_s
    assert_stopped(one, at)


def test_never_closer_than_the_least_range(fake: Fake, dive: MakeDive) -> None:
    one = dive(setpoint=Setpoint(0.32), limits=SafetyLimits(least_range=0.5))
    fake.play(at=[0.45, 0.0])
    one.engage()
    at = time.monotonic()
    until(lambda: "closer" in one.pilot.health().detail, "a warning")
    until(lambda: one.pilot.health().state is State.WARN, "a warning")
    until(lambda: fake.truth["range"] > 0.5, "a retreat")
    # Neutral comes between where a frame was held up.
    assert all(x <= 0 for x in told_forward(fake, at))


def test_brakes_where_it_closes_in_too_fast(fake: Fake, dive: MakeDive) -> None:
    one = dive(setpoint=Setpoint(0.6))
    one.frames.seen = lambda: posture(1.4)
    one.engage()
    # 0.5 m/s by the frames' own clock, which a busy machine does not change; to where hardly any
    # closing speed is allowed, and the brake is firm.
    ranges = iter(np.arange(1.4, 0.45, -0.5 * FRAME_S).tolist())
    at = time.monotonic()
    one.frames.seen = lambda: posture(next(ranges, 0.45))
    until(lambda: "too fast" in one.pilot.health().detail, "a warning")
    until(lambda: min(told_forward(fake, at)) <= -490, "a firm brake")
    told = told_forward(fake, at)
    first = next(i for i, x in enumerate(told) if x < 0)
    firm = next(i for i, x in enumerate(told) if x <= -490)
    # It begins gently; where a frame was held up, neutral comes between.
    assert all(x <= 0 for x in told[first:firm])


def told_forward(fake: Fake, since: float) -> list[int]:
    """The forward sticks on the wire, in thousandths; 0 before any."""
    return [m["fields"]["x"] for m in fake.steered(since)] or [0]


@pytest.mark.parametrize("forwards", [True, False])
def test_sticks_take_over_at_once(fake: Fake, dive: MakeDive, forwards: bool) -> None:
    fake.play(forwards=forwards)
    one = dive()
    pushed(one)
    at = fake.play(joystick={"y": -600})
    # Channels are told ten times a second, and hold either his sticks or ours, whoever came last.
    assert_released(one, at, WITHIN_S if forwards else 1.0)
    assert fake.truths[-1]["sticks"][1] == pytest.approx(-0.6)
    with pytest.raises(OptionError, match="sticks"):
        one.pilot.engage()
    released = fake.play(joystick=None, lapsed=True, sticks=[0.0, 0.0, 0.0, 0.0])
    time.sleep(0.3)
    assert not fake.steered(released)
    one.engage()


@pytest.mark.parametrize(
    ("event", "words"),
    [({"mode": 19}, "another mode"), ({"armed": False}, "disarmed"), ({"away": True}, "silent")],
)
def test_vehicle_stops_us_until_engaged_again(
    fake: Fake, dive: MakeDive, event: dict[str, Any], words: str
) -> None:
    one = dive(limits=SafetyLimits(heartbeat_age=0.5))
    pushed(one)
    at = fake.play(**event)
    if "away" in event:
        # It hears nothing meanwhile.
        until(lambda: not one.pilot.engaged, "a stop")
        assert time.monotonic() - at <= within(one, at, 0.5 + 0.04)
        time.sleep(0.2)
    else:
        # Heartbeats come every 0.2 s here, and at once when the mode changes.
        assert_released(one, at, 0.2 if "mode" in event else 0.4)
    until(lambda: words in one.pilot.health().detail, words)
    back = fake.play(mode=2, armed=True, away=False)
    time.sleep(0.3)
    assert not fake.steered(back)
    one.engage()


def test_attitude_without_heartbeats_is_no_vehicle(fake: Fake, dive: MakeDive) -> None:
    one = dive()
    pushed(one)
    at = fake.play(beats=False)
    until(lambda: not one.pilot.engaged, "a stop")
    assert time.monotonic() - at <= within(one, at, 2.5 + 0.04)


def test_lost_ground_station_stops_us(fake: Fake, dive: MakeDive) -> None:
    one = dive(options=ArduSubOptions(station_timeout_s=0.5))
    pushed(one)
    at = fake.play(station=False)
    assert_released(one, at, 0.5 + 0.04)
    assert "no ground station" in one.pilot.health().detail


def test_fault_in_control_stops_us(fake: Fake, dive: MakeDive) -> None:
    one = dive()
    pushed(one)

    def broken() -> Any:
        raise ZeroDivisionError("of a controller")

    healthy = one.pilot._steering.controller.update
    one.pilot._steering.controller.update = lambda *_: broken()
    at = time.monotonic()
    assert_released(one, at)
    assert one.pilot.health().state is State.FAULT
    assert "of a controller" in one.pilot.health().detail
    one.pilot._steering.controller.update = healthy
    one.engage()
    assert one.pilot.health().state is not State.FAULT


def test_disengaging_and_closing_leave_neutral(fake: Fake, dive: MakeDive) -> None:
    one = dive()
    pushed(one)
    one.pilot.disengage()
    at = time.monotonic()
    assert_released(one, at, 0.0)
    pushed(one)
    at = time.monotonic()
    one.close()
    until(lambda: ends_neutral(fake.steered(at)), "three neutrals")
    closed = time.monotonic()
    time.sleep(0.2)
    assert all(is_neutral(m) for m in fake.steered(closed))


def ends_neutral(told: list[dict[str, Any]]) -> bool:
    return len(told) >= 3 and all(is_neutral(m) for m in told[-3:])


KILLED = """
import sys, time
sys.path.insert(0, {helpers!r})
from fake_ardusub_cases import *
from aqualvs.live.mavlink.ardusub import ArduSubLink
from aqualvs.live.mavlink.link import MavlinkLink

vehicle = ArduSubLink(MavlinkLink({url!r}))
holder = SetpointHolder((0.3, 2.0))
holder.put(Setpoint(0.4))
pilot, smooth = Pilot(steering(), vehicle, holder), PostureFilter()
until(lambda: vehicle.state().mode == "ours", "a vehicle")
pilot.engage()
for i in range(500):
    seen = posture(1.2 + 0.001 * (i % 2))
    pilot.send(sample(i, seen, smooth.update(FRAME_S * i, seen)))
    time.sleep(0.04)
"""


def test_killed_process_leaves_the_vehicle_to_its_own_fail_safe(fake: Fake) -> None:
    script = KILLED.format(helpers=str(HELPERS), url=fake.url)
    process = subprocess.Popen([sys.executable, "-c", script])
    try:
        until(lambda: pushing(fake), "an effort", TIMEOUT_S)
        n = len(fake.events)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    at = time.monotonic()
    until(lambda: any(e["event"] == "fail-safe" for e in fake.events[n:]), "the fail-safe")
    assert time.monotonic() - at <= LAPSE_S + MARGIN_S + 2.0 * fake.lateness(at)
    until(lambda: fake.truths[-1]["sticks"] == [0.0, 0.0, 0.0, 0.0], "sticks at their centre")
    until(lambda: abs(fake.truths[-1]["speeds"][0]) < 0.02, "a vehicle at rest")


@pytest.mark.parametrize("command", list(Command))
def test_signs(fake: Fake, command: Command) -> None:
    """Forward, right, down and clockwise are positive, from the effort to the motion."""
    fake.play(mode=2 if command is Command.STICKS else 4)
    link = MavlinkLink(fake.url)
    vehicle = ArduSubLink(link, ArduSubOptions(command=command))
    try:
        until(lambda: vehicle.state().mode == "ours", "a vehicle")
        for name, measured, sign in (
            ("forward", "range", -1.0),
            ("right", "aside", 1.0),
            ("down", "depth", 1.0),
            ("yaw", "yaw", -1.0),
        ):
            fake.play(at=[0.9, 0.0])
            before = dict(fake.truth)

            def moves(measured: str = measured, before: dict[str, float] = before) -> float:
                return fake.truth[measured] - before[measured]

            steer_until(vehicle, Effort(**{name: 0.8}), lambda: abs(moves()) > 0.02)
            moved = {key: fake.truth[key] - before[key] for key in before}
            assert sign * moved.pop(measured) > 0.02
            others = {"aside", "yaw"} if name == "yaw" else set()
            assert all(abs(moved[key]) < 0.005 for key in moved.keys() - others), (name, moved)
    finally:
        vehicle.close()
        link.close()


def steer_until(vehicle: ArduSubLink, effort: Effort, done: Callable[[], bool]) -> None:
    end = time.monotonic() + TIMEOUT_S
    while not done():
        assert time.monotonic() < end, f"{effort} moves nothing"
        vehicle.send(effort)
        time.sleep(0.04)
    vehicle.send(Effort())


def test_steers_by_speeds_where_the_vehicle_knows_its_place(fake: Fake, dive: MakeDive) -> None:
    fake.play(mode=4)
    one = dive(options=ArduSubOptions(command=Command.GUIDED, speed=0.5, turning_rate=0.5))
    pushed(one)
    until(lambda: fake.steered()[-1]["fields"]["vx"] > 0.05, "a speed towards the wall")
    assert {m["kind"] for m in fake.steered(one.began)} == {"SET_POSITION_TARGET_LOCAL_NED"}
    at = fake.play(mode=2)
    assert_released(one, at)
