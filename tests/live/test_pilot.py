"""The output that closes the loop, without a wire: when it sends, what it tells."""

import logging
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from aqualvs.control.autopilot import Motion
from aqualvs.control.safety import LimitReason
from aqualvs.control.time_filter import FilteredPosture
from aqualvs.control.vehicle import NEUTRAL, Effort, Mode, Setpoint, SetpointHolder, VehicleState
from aqualvs.errors import OptionError
from aqualvs.live import pilot as live_pilot
from aqualvs.live import pilot as pilot_watchdog
from aqualvs.live.pilot import Pilot, Watchdog
from aqualvs.live.runner import OutputWorker
from aqualvs.scanning.posture import Reason as NoPosture
from aqualvs.scanning.posture import Refusal
from aqualvs.sources.base import State

pytest.importorskip("pymavlink")

import fake_ardusub_cases
from fake_ardusub_cases import posture, sample, steering
from waiting import until

BLIND = Refusal(NoPosture.NO_STRIPES)


class Clock:
    """Stands for the machine's clock, which goes on between any two lines where that is busy."""

    now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s

    def monotonic_ns(self) -> int:
        return round(1e9 * self.now_s)


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    for module in (live_pilot, pilot_watchdog, fake_ardusub_cases):
        monkeypatch.setattr(module, "time", made)
    return made


class Vehicle:
    """In memory: armed, in our mode, always heard."""

    name = "vehicle"

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.now = VehicleState(armed=True, mode=Mode.OURS, mode_name="ALT_HOLD")
        self.sent: list[Effort] = []
        self.n_tried = 0
        self.fault: Exception | None = None
        self.closed = False

    def state(self) -> VehicleState:
        return replace(self.now, heard_s=self.clock.now_s)

    def send(self, effort: Effort) -> None:
        self.n_tried += 1
        if self.fault is not None:
            raise self.fault
        self.sent.append(effort)

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def vehicle(clock: Clock) -> Vehicle:
    return Vehicle(clock)


@pytest.fixture
def pilot(vehicle: Vehicle) -> Iterator[Pilot]:
    holder = SetpointHolder((0.3, 2.0))
    holder.put(Setpoint(0.6))
    made = Pilot(steering(), vehicle, holder)
    yield made
    made.close()


def test_silent_until_engaged_then_one_effort_a_sample(pilot: Pilot, vehicle: Vehicle) -> None:
    pilot.send(sample(0, posture(0.9)))
    assert not vehicle.sent
    assert pilot.health().state is State.OFF
    pilot.engage()
    pilot.send(sample(1, posture(0.9, yaw=0.1)))
    assert vehicle.sent == [Effort(forward=pytest.approx(0.36), yaw=pytest.approx(0.2))]
    latest = pilot.latest
    assert latest is not None
    assert (latest.frame, latest.decision.engaged, latest.decision.reason) == (1, True, None)
    assert latest.decision.effort == vehicle.sent[0]
    assert latest.state.mode_name == "ALT_HOLD"
    assert pilot.health().detail == "holding: 0.60 m, yaw 0 deg"


def test_follows_the_setpoint_as_it_is_changed(pilot: Pilot, vehicle: Vehicle) -> None:
    pilot.engage()
    pilot.send(sample(0, posture(0.7)))
    pilot._holder.put(Setpoint(0.8))
    pilot.send(sample(1, posture(0.7)))
    assert [effort.forward > 0.0 for effort in vehicle.sent] == [True, False]
    pilot._holder.put(None)
    pilot.send(sample(2, posture(0.7)))
    assert vehicle.sent[-1] == NEUTRAL
    assert pilot.latest is not None
    assert pilot.latest.decision.reason is LimitReason.NO_SETPOINT


def test_not_engaged_without_a_setpoint(vehicle: Vehicle) -> None:
    pilot = Pilot(steering(), vehicle, SetpointHolder((0.3, 2.0)))
    with pytest.raises(OptionError, match="no range is set"):
        pilot.engage()
    pilot.close()
    assert vehicle.closed


@pytest.mark.parametrize(
    ("change", "n"), [({"mode": Mode.PILOT}, 3), ({"armed": False}, 3), ({"pilot_moves": True}, 1)]
)
def test_a_few_neutrals_and_then_nothing(
    pilot: Pilot, vehicle: Vehicle, change: dict[str, object], n: int
) -> None:
    """One where the pilot holds his sticks: ours must not be in their way."""
    pilot.engage()
    pilot.send(sample(0, posture(0.9)))
    vehicle.now = replace(vehicle.now, **change)
    for i in range(1, 8):
        pilot.send(sample(i, posture(0.9)))
    assert vehicle.sent[1:] == [NEUTRAL] * n


def test_disengaging_is_neutral_at_once(pilot: Pilot, vehicle: Vehicle) -> None:
    pilot.engage()
    pilot.send(sample(0, posture(0.9)))
    pilot.disengage()
    assert vehicle.sent[-1] == NEUTRAL
    n = len(vehicle.sent)
    pilot.disengage()
    assert len(vehicle.sent) == n


def test_old_postures_are_none(pilot: Pilot, vehicle: Vehicle) -> None:
    pilot.engage()
    pilot.send(sample(0, posture(0.9), arrived_s=vehicle.clock.now_s - 0.3))
    assert vehicle.sent == [NEUTRAL]
    assert pilot.latest is not None
    assert pilot.latest.decision.reason is LimitReason.NO_POSTURE


def test_filter_is_handed_on(vehicle: Vehicle) -> None:
    net_pilot = steering()
    seen: list[Motion | None] = []
    step = net_pilot.step

    def watched(*args: object) -> object:
        seen.append(args[3])
        return step(*args)

    net_pilot.step = watched
    pilot = Pilot(net_pilot, vehicle)
    rates = np.array((0.1, 0.2, 0.3))
    filtered = FilteredPosture(0.9, 0.01, 0.02, rates, np.eye(6), 0.0, True)
    pilot.send(sample(0, posture(0.9), filtered))
    pilot.send(sample(1, posture(0.9)))
    pilot.close()
    assert seen == [Motion(0.9, 0.02, 0.1, 0.3), None]


def test_what_cannot_be_sent_is_told(pilot: Pilot, vehicle: Vehicle) -> None:
    worker = OutputWorker(pilot)
    pilot.engage()
    vehicle.fault = OSError("no connection")
    worker.offer(sample(0, posture(0.9)))
    health = worker.health()
    assert (health.state, health.detail, health.n_dropped) == (State.FAULT, "no connection", 1)
    assert pilot.latest is not None
    assert pilot.latest.decision.effort == NEUTRAL
    vehicle.fault = None
    worker.offer(sample(1, posture(0.9)))
    assert worker.health().state is State.OK


def test_fault_stops_until_engaged_again(
    pilot: Pilot, vehicle: Vehicle, caplog: pytest.LogCaptureFixture
) -> None:
    pilot.engage()
    pilot.send(sample(0, posture(0.9)))
    good = vehicle.state
    vehicle.state = lambda: 1 / 0
    for i in range(1, 8):
        pilot.send(sample(i, posture(0.9)))
    assert vehicle.sent[1:] == [NEUTRAL] * 3
    assert pilot.health().state is State.FAULT
    assert "division" in pilot.health().detail
    assert sum("stopped by a fault" in told for told in caplog.messages) == 1
    assert pilot.latest is not None
    assert not pilot.latest.decision.engaged
    vehicle.state = good
    pilot.send(sample(8, posture(0.9)))
    assert not pilot.engaged
    pilot.engage()
    pilot.send(sample(9, posture(0.9)))
    assert vehicle.sent[-1] != NEUTRAL
    assert pilot.health().state is State.OK


def test_fault_while_engaging_leaves_it_disengaged(pilot: Pilot) -> None:
    pilot._steering.controller.reset = lambda: 1 / 0
    with pytest.raises(ZeroDivisionError):
        pilot.engage()
    assert not pilot.engaged


def test_reasons_are_logged_once(
    pilot: Pilot, vehicle: Vehicle, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "aqualvs")
    pilot.engage()
    for i in range(3):
        pilot.send(sample(i, posture(0.9)))
    clock.now_s += 0.2
    for i in range(3, 6):
        pilot.send(sample(i, BLIND))
    vehicle.now = replace(vehicle.now, mode=Mode.PILOT, mode_name="MANUAL")
    for i in range(6, 9):
        pilot.send(sample(i, BLIND))
    told = [words for words in caplog.messages if words.startswith("pilot")]
    assert len(told) == 3
    assert "no valid posture" in told[1]
    assert told[2].startswith("pilot, frame 6: ")
    assert told[2].endswith("(MANUAL)")


def test_watchdog_stops_an_effort_that_nobody_renews(vehicle: Vehicle, clock: Clock) -> None:
    watchdog = Watchdog(vehicle, 0.1)
    push = Effort(forward=0.5)
    assert watchdog.send(push, clock.now_s) == push
    clock.now_s += 0.11
    until(lambda: watchdog.n_barks == 1, "neutral")
    assert vehicle.sent == [push, NEUTRAL]
    # Neutral needs no watching, and what is too old already is not sent.
    assert watchdog.send(push, clock.now_s - 0.2) == NEUTRAL
    clock.now_s += 1.0
    time.sleep(0.2)
    assert watchdog.n_barks == 1
    watchdog.close()


def test_watchdog_tries_until_neutral_is_sent(vehicle: Vehicle, clock: Clock) -> None:
    watchdog = Watchdog(vehicle, 0.05)
    watchdog.send(Effort(yaw=0.5), clock.now_s)
    vehicle.fault = OSError("no connection")
    clock.now_s += 0.06
    until(lambda: vehicle.n_tried > 2, "a second try")
    assert watchdog.n_barks == 0
    vehicle.fault = None
    until(lambda: vehicle.sent[-1] == NEUTRAL, "neutral")
    watchdog.close()
