"""Strangers on a listening port: none of them is taken for the vehicle, or gets its sticks.

Each spoofs in another way while the vehicle is being steered; then the picture is lost, and the
vehicle must be told neutral in time.
"""

import contextlib
import random
import socket
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest

from aqualvs.errors import OptionError
from aqualvs.live.mavlink.link import LinkOptions, MavlinkLink
from ports import free_port

pytest.importorskip("pymavlink")

from pymavlink.dialects.v20 import ardupilotmega as dialect

from fake_ardusub_cases import (
    AT_START,
    Dive,
    Fake,
    assert_released,
    assert_stopped,
    is_neutral,
    pushed,
    pushing,
    until,
)

NOTICED_S = 2.0
"""Within so long a busy machine notices what spoofing must not hide; less than five seconds, after
which another address may speak as the vehicle."""

STEERING = (b"\x45\x00\x00", b"\x54\x00\x00")
"""Message ids of `MANUAL_CONTROL` and `SET_POSITION_TARGET_LOCAL_NED` as frames hold them."""


def frame(message: Any, system: int, component: int = 1) -> bytes:
    packed: bytes = message.pack(dialect.MAVLink(None, system, component))
    return packed


def beat(mode: int, system: int = 1, kind: int = 12, *, autopilot: int = 3) -> bytes:
    """A heartbeat of an armed vehicle."""
    return frame(dialect.MAVLink_heartbeat_message(kind, autopilot, 129, mode, 4, 3), system)


def attitude() -> bytes:
    return frame(dialect.MAVLink_attitude_message(0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), 1)


def station_beat() -> bytes:
    return frame(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), 255, 190)


def sticks(x: int) -> bytes:
    return frame(dialect.MAVLink_manual_control_message(1, x, 0, 500, 0, 0), 255, 190)


@dataclass
class Strangers:
    """Many senders, each with an address of its own, that say the same again and again."""

    port: int
    says: list[bytes]
    count: int = 20
    every_s: float = 0.02
    host: str = "127.0.0.1"
    got: list[bytes] = field(default_factory=list)

    def __enter__(self) -> "Strangers":
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        with contextlib.ExitStack() as stack:
            made = []
            for _ in range(self.count):
                one = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
                one.bind((self.host, 0))
                one.setblocking(False)
                made.append(one)
            while not self._stop.wait(self.every_s):
                for one in made:
                    for said in self.says:
                        one.sendto(said, ("127.0.0.1", self.port))
                    with contextlib.suppress(BlockingIOError):
                        while True:
                            self.got.append(one.recv(2048))

    @property
    def were_steered(self) -> bool:
        """Whether they received what was meant for the vehicle."""
        return any(data[7:10] in STEERING for data in list(self.got))


PORT = free_port()


@pytest.fixture(scope="module")
def vehicle() -> Iterator[Fake]:
    """A vehicle that speaks to our port first, as BlueOS does with an endpoint of its own."""
    fake = Fake("--to", str(PORT), "--lapse", "0.5")
    yield fake
    fake.stop()


@pytest.fixture
def dive(vehicle: Fake) -> Iterator[Dive]:
    """A dive whose link listens, with the vehicle at 0.9 m."""
    vehicle.play(**AT_START)
    one = Dive(vehicle, link=MavlinkLink(f"udpin:127.0.0.1:{PORT}"))
    yield one
    one.close()


def assert_neutral_without_video(one: Dive) -> None:
    """Lose the picture and assert that the vehicle is told neutral in time."""
    one.frames.flows = False
    assert_stopped(one, one.last_seen_s)


CROWDS = {
    "one byte each": [b"\xfd"],
    "nothing but noise": [random.Random(7).randbytes(300)],
    "other vehicles": [beat(2, system=2), beat(19, system=3)],
    "half frames": [beat(2)[:8]],
    "the vehicle's own words": [beat(2), attitude()],
    "sticks that are centred": [sticks(0)],
}


@pytest.mark.parametrize("says", CROWDS.values(), ids=CROWDS)
def test_strangers_neither_steer_nor_are_steered(dive: Dive, says: list[bytes]) -> None:
    pushed(dive)
    with Strangers(PORT, says) as strangers:
        time.sleep(0.5)
        assert dive.pilot.engaged
        until(lambda: pushing(dive.fake), "an effort in spite of them")
        assert_neutral_without_video(dive)
        dive.frames.flows = True
        until(lambda: pushing(dive.fake), "an effort again")
    assert not strangers.were_steered


def test_half_frames_from_the_vehicles_own_address_blind_nobody(dive: Dive) -> None:
    dive.fake.play(halves=True)
    pushed(dive)
    time.sleep(1.0)
    assert dive.pilot.engaged
    assert_neutral_without_video(dive)
    at = dive.fake.play(mode=19)
    until(lambda: not dive.pilot.engaged, "a stop")
    assert time.monotonic() - at < NOTICED_S + dive.lateness(at)


def test_the_pilots_mode_is_seen_behind_spoofed_heartbeats(dive: Dive) -> None:
    pushed(dive)
    with Strangers(PORT, [beat(2), attitude()], count=3):
        time.sleep(0.3)
        assert dive.pilot.engaged
        at = dive.fake.play(mode=19)
        assert_released(dive, at, NOTICED_S)
        assert dive.vehicle.state().mode_name.startswith("MANUAL")


def test_spoofed_modes_that_contradict_the_vehicles_stop_us(dive: Dive) -> None:
    pushed(dive)
    at = time.monotonic()
    with Strangers(PORT, [beat(19)], count=1) as strangers:
        assert_released(dive, at, NOTICED_S)
        assert "two senders claim to be the vehicle" in dive.pilot.health().detail
        assert "contradict each other" in dive.pilot.health().detail
    assert not strangers.were_steered
    # What was said counts for a while; then the pilot may engage again.
    until(lambda: dive.vehicle.state().mode == "ours", "an end of the conflict")


def test_nobody_is_steered_while_two_are_the_vehicle_from_the_start(dive: Dive) -> None:
    with Strangers(PORT, [beat(2), attitude()], count=1) as strangers:
        until(lambda: dive.vehicle.state().rival, "a rival")
        until(lambda: dive.vehicle.state().mode == "ours", "the ground station")
        with pytest.raises(
            OptionError, match=r"two senders claim to be the vehicle.*both speak as sysid 1"
        ):
            dive.pilot.engage()
        assert not dive.fake.steered(dive.began)
    assert not strangers.were_steered
    until(lambda: not dive.vehicle.state().rival, "silence of the rival")
    pushed(dive)


def test_modes_that_alternate_at_one_address_stop_us(dive: Dive) -> None:
    pushed(dive)
    dive.fake.play(mode=19)
    dive.fake.play(mode=2)
    until(lambda: not dive.pilot.engaged, "a stop")
    until(lambda: dive.vehicle.state().mode == "conflict", "a conflict")
    until(lambda: all(map(is_neutral, dive.fake.steered()[-3:])), "neutral")


def test_a_vehicle_that_fell_silent_is_not_replaced(dive: Dive) -> None:
    pushed(dive)
    with Strangers(PORT, [beat(2), attitude()], count=2) as strangers:
        at = dive.fake.play(away=True)
        until(lambda: not dive.pilot.engaged, "a stop")
        # After a second of silence; a replacement would never be noticed.
        assert time.monotonic() - at < NOTICED_S + dive.lateness(at)
        until(lambda: "silent" in dive.pilot.health().detail, "the reason")
        dive.fake.play(away=False)
    assert not strangers.were_steered


def test_a_ground_station_that_is_gone_is_not_replaced(dive: Dive) -> None:
    dive.vehicle.options = type(dive.vehicle.options)(station_timeout_s=0.5)
    pushed(dive)
    with Strangers(PORT, [station_beat()], count=2):
        at = dive.fake.play(station=False)
        assert_released(dive, at, 0.5 + NOTICED_S)
        assert "no ground station" in dive.pilot.health().detail


def test_centred_sticks_of_strangers_do_not_hide_the_pilots(dive: Dive) -> None:
    pushed(dive)
    with Strangers(PORT, [sticks(0)], count=5, every_s=0.005):
        time.sleep(0.2)
        at = dive.fake.play(joystick={"y": -600})
        assert_released(dive, at, NOTICED_S)


@pytest.mark.skipif(sys.platform != "linux", reason="one address for this computer")
def test_peers_that_may_not_speak_are_not_heard(vehicle: Fake) -> None:
    vehicle.play(**AT_START)
    link = MavlinkLink(f"udpin:127.0.0.1:{PORT}", LinkOptions(peers=("127.0.0.1",)))
    with contextlib.closing(Dive(vehicle, link=link)) as one:
        pushed(one)
        with Strangers(PORT, [beat(19), sticks(900)], count=3, host="127.0.0.2") as strangers:
            time.sleep(0.5)
            assert one.pilot.engaged
            assert_neutral_without_video(one)
        assert not strangers.got


def test_a_vehicle_that_may_not_speak_is_named(vehicle: Fake) -> None:
    vehicle.play(**AT_START)
    link = MavlinkLink(f"udpin:127.0.0.1:{PORT}", LinkOptions(peers=("192.0.2.1",)))
    with contextlib.closing(link):
        until(lambda: "127.0.0.1 is not an allowed peer" in link.health().detail, "a word on it")
        assert link.autopilot() is None


KEY = bytes(range(32))


def test_only_who_has_the_key_is_heard_and_steered() -> None:
    port = free_port()
    fake = Fake("--to", str(port), "--lapse", "0.5", "--key", KEY.hex())
    link = MavlinkLink(f"udpin:127.0.0.1:{port}", LinkOptions(key=KEY))
    with contextlib.ExitStack() as stack:
        stack.callback(fake.stop)
        one = stack.enter_context(contextlib.closing(Dive(fake, link=link)))
        pushed(one)
        # The vehicle takes signed messages only, so it obeys: ours are signed.
        until(lambda: abs(fake.truths[-1]["sticks"][0]) > 0.05, "sticks that are obeyed")
        with Strangers(port, [beat(19), sticks(900)], count=3) as strangers:
            time.sleep(0.5)
            assert one.pilot.engaged
            assert_neutral_without_video(one)
        assert not strangers.got


def test_a_vehicle_without_the_key_is_told(vehicle: Fake) -> None:
    vehicle.play(**AT_START)
    link = MavlinkLink(f"udpin:127.0.0.1:{PORT}", LinkOptions(key=KEY))
    with contextlib.closing(link):
        until(lambda: "not signed with our key" in link.health().detail, "a word on it")
        assert link.autopilot() is None
