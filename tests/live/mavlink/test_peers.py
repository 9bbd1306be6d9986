"""Senders of a MAVLink connection: who keeps which name, and who is sent to."""

import time
from typing import Any

import pytest

from aqualvs.live.mavlink.peers import SILENT_AFTER_S, PeerTable

pytest.importorskip("pymavlink")

from pymavlink.dialects.v20 import ardupilotmega as dialect

VEHICLE, OTHER = ("10.0.0.1", 14550), ("10.0.0.2", 14550)


class Clock:
    """Time that tests set."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 100.0
        monkeypatch.setattr(time, "monotonic", lambda: self.now_s)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


@pytest.fixture
def table() -> PeerTable:
    def make_parser() -> Any:
        parser = dialect.MAVLink(None)
        parser.robust_parsing = True
        return parser

    return PeerTable(make_parser, (dialect.MAVError,), system=1)


def frame(message: Any, system: int = 1, component: int = 1) -> bytes:
    packed: bytes = message.pack(dialect.MAVLink(None, system, component))
    return packed


def beat(mode: int = 2, *, armed: bool = True, kind: int = 12, autopilot: int = 3) -> Any:
    return dialect.MAVLink_heartbeat_message(kind, autopilot, 129 if armed else 1, mode, 4, 3)


ATTITUDE = dialect.MAVLink_attitude_message(0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


def heard(table: PeerTable, peer: tuple[object, ...], *messages: Any, system: int = 1) -> list[str]:
    """Take messages in; return the kinds of those that count."""
    data = b"".join(frame(message, system) for message in messages)
    decoded = table.decode(peer, data, whole=True)
    return [message.get_type() for message in decoded if table.admit(peer, message)]


def test_the_vehicles_name_belongs_to_where_it_was_heard_first(
    table: PeerTable, clock: Clock
) -> None:
    assert heard(table, VEHICLE, ATTITUDE) == []
    assert heard(table, VEHICLE, beat(), ATTITUDE) == ["HEARTBEAT", "ATTITUDE"]
    assert heard(table, OTHER, beat(), ATTITUDE) == []
    assert table.vehicle == VEHICLE
    assert "10.0.0.1:14550 and 10.0.0.2:14550 both speak as sysid 1" in table.rival
    assert not table.conflict
    clock.now_s += SILENT_AFTER_S + 0.1
    assert heard(table, OTHER, beat(), ATTITUDE) == ["HEARTBEAT", "ATTITUDE"]
    assert table.vehicle == OTHER


def test_other_parts_of_the_vehicle_do_not_say_where_it_is(table: PeerTable, clock: Clock) -> None:
    assert heard(table, OTHER, beat(kind=30, autopilot=8)) == []
    assert table.vehicle is None
    heard(table, VEHICLE, beat())
    assert heard(table, VEHICLE, beat(kind=30, autopilot=8)) == ["HEARTBEAT"]
    assert not table.conflict


@pytest.mark.parametrize("other", [beat(19), beat(armed=False), beat(kind=2)])
def test_another_who_contradicts_the_vehicle(table: PeerTable, clock: Clock, other: Any) -> None:
    heard(table, VEHICLE, beat())
    heard(table, OTHER, other)
    assert "from 10.0.0.1:14550 and 10.0.0.2:14550 contradict" in table.conflict
    clock.now_s += 3.1
    assert not table.conflict


def test_a_vehicle_that_changes_its_mode_contradicts_nobody(table: PeerTable, clock: Clock) -> None:
    for message in (beat(19, armed=False), beat(19), beat(2), beat(0), beat(2, armed=False)):
        heard(table, VEHICLE, message)
        assert not table.conflict
        clock.now_s += 0.5


def test_a_mode_that_comes_back_too_soon_contradicts(table: PeerTable, clock: Clock) -> None:
    for mode in (2, 19):
        heard(table, VEHICLE, beat(mode))
        clock.now_s += 0.2
    assert not table.conflict
    heard(table, VEHICLE, beat(2))
    assert "from 10.0.0.1:14550 contradict" in table.conflict
    clock.now_s += 4.0
    heard(table, VEHICLE, beat(19))
    clock.now_s += 4.0
    heard(table, VEHICLE, beat(2))
    assert not table.conflict


def test_strangers_displace_nobody(table: PeerTable, clock: Clock) -> None:
    for i in range(20):
        heard(table, ("10.0.1.1", i), beat(), system=2 + i)
    first = table.receivers()
    assert len(first) == 8
    heard(table, VEHICLE, beat())
    heard(table, VEHICLE, beat())
    assert table.receivers() == [VEHICLE, *first]
    # Who sends nothing that can be understood is none.
    table.decode(("10.0.1.1", 99), b"\xfd", whole=True)
    clock.now_s += 10.1
    assert table.receivers() == []
    heard(table, OTHER, beat(), system=9)
    assert table.receivers() == [OTHER]
    assert table.vehicle == VEHICLE


def test_half_messages_of_others_and_of_oneself_disturb_nobody(
    table: PeerTable, clock: Clock
) -> None:
    heard(table, VEHICLE, beat())
    half = b"\xfd\xff\x00\x00\x00\x01\x01\x1e\x00\x00"
    for peer in (VEHICLE, OTHER):
        table.decode(peer, half, whole=True)
    assert heard(table, VEHICLE, ATTITUDE) == ["ATTITUDE"]
    # A message in two datagrams, as some serial bridges send it.
    whole = frame(ATTITUDE)
    assert table.decode(VEHICLE, whole[:9], whole=True) == []
    assert [m.get_type() for m in table.decode(VEHICLE, whole[9:], whole=True)] == ["ATTITUDE"]


def test_a_stream_may_be_cut_anywhere(table: PeerTable, clock: Clock) -> None:
    data = frame(beat()) + frame(ATTITUDE)
    found = []
    for i in range(len(data)):
        found += table.decode((), data[i : i + 1], whole=False)
    assert [message.get_type() for message in found] == ["HEARTBEAT", "ATTITUDE"]


def test_the_pilots_sticks_count_wherever_they_come_from(table: PeerTable, clock: Clock) -> None:
    sticks = dialect.MAVLink_manual_control_message(1, 900, 0, 500, 0, 0)
    station = dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    assert heard(table, VEHICLE, station, sticks, system=255) == ["HEARTBEAT", "MANUAL_CONTROL"]
    assert heard(table, OTHER, station, sticks, system=255) == ["MANUAL_CONTROL"]
