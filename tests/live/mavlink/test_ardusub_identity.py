"""In whose name the vehicle takes sticks: refused where it is known, doubted where it shows."""

import contextlib
import time
from collections.abc import Iterator

import pytest

from aqualvs.control.vehicle import Setpoint
from aqualvs.errors import OptionError
from aqualvs.live.mavlink.ardusub import ArduSubOptions
from aqualvs.sources.base import State
from waiting import until

pytest.importorskip("pymavlink")

from fake_ardusub_cases import AT_START, Dive, Fake, pushed

FAR = Setpoint(0.4)
"""So far from where the vehicle is that sticks are large."""


@pytest.fixture(scope="module")
def vehicle() -> Iterator[Fake]:
    """One other process for all tests."""
    fake = Fake()
    yield fake
    fake.stop()


@pytest.fixture
def fake(vehicle: Fake) -> Fake:
    """The vehicle at 0.9 m, armed, in depth hold."""
    vehicle.play(**AT_START)
    return vehicle


@pytest.mark.parametrize("name", ["MAV_GCS_SYSID", "SYSID_MYGCS"])
def test_a_vehicle_that_obeys_another_station_is_not_engaged(fake: Fake, name: str) -> None:
    fake.play(parameters={name: 250.0})
    with contextlib.closing(Dive(fake)) as one:
        until(lambda: one.vehicle.state().mode == "ignored", "an answer of the vehicle")
        with pytest.raises(OptionError, match=f"ignores our sticks.*{name} 250.*set {name} 255"):
            one.pilot.engage()
        time.sleep(0.2)
        assert not fake.steered(one.began)


def test_sticks_in_the_name_of_the_station_that_it_obeys(fake: Fake) -> None:
    fake.play(parameters={"MAV_GCS_SYSID": 250.0}, station_id=250)
    with contextlib.closing(Dive(fake, options=ArduSubOptions(ground_station=250))) as one:
        pushed(one)
        assert {m["system"] for m in fake.steered(one.began)} == {250}
        until(lambda: fake.truth["range"] < 0.85, "a vehicle that moves")


def test_a_vehicle_that_only_shows_that_it_does_not_obey(fake: Fake) -> None:
    fake.play(parameters={}, obeys=250)
    with contextlib.closing(Dive(fake, setpoint=FAR)) as one:
        pushed(one)
        until(lambda: "does not obey" in one.pilot.health().detail, "a warning", 20.0)
        assert one.pilot.engaged
        assert one.pilot.health().state is State.WARN
        assert fake.truth["range"] == pytest.approx(0.9)
        fake.play(obeys=255)
        until(lambda: "does not obey" not in one.pilot.health().detail, "no warning", 20.0)


def test_a_vehicle_that_obeys_is_not_doubted(fake: Fake) -> None:
    # Another joystick that is held still, as one that is left on.
    fake.play(joystick={})
    with contextlib.closing(Dive(fake, setpoint=FAR)) as one:
        pushed(one)
        end = time.monotonic() + 4.0
        while time.monotonic() < end:
            assert not one.vehicle.state().doubt
            time.sleep(0.05)


def test_channels_that_are_not_told_are_missed(fake: Fake) -> None:
    fake.play(channels_told=False)
    with contextlib.closing(Dive(fake, setpoint=FAR)) as one:
        pushed(one)
        until(lambda: "RC_CHANNELS is not received" in one.pilot.health().detail, "a warning", 20.0)


def test_a_ground_station_that_is_missing_is_named(fake: Fake) -> None:
    fake.play(station_id=254)
    with contextlib.closing(Dive(fake)) as one:
        missing = "no heartbeat of ground station 255, but of 254"
        until(lambda: missing in one.vehicle.state().mode_name, "a heartbeat of either")
        with pytest.raises(OptionError, match=f"no ground station heard.*{missing}"):
            one.pilot.engage()


def test_dangerous_settings_are_told_once(fake: Fake, caplog: pytest.LogCaptureFixture) -> None:
    fake.play(parameters={"MAV_GCS_SYSID": 255.0, "FS_PILOT_INPUT": 0.0, "FS_PILOT_TIMEOUT": 3.0})
    with contextlib.closing(Dive(fake)):
        until(lambda: "FS_PILOT_TIMEOUT 3 s" in caplog.text, "a warning")
        time.sleep(0.3)
    assert caplog.text.count("FS_PILOT_INPUT 0 (off)") == 1
    assert "MAV_GCS_SYSID" not in caplog.text
