"""`aqualvs doctor --mavlink` beside the fake vehicle: every setting, its meaning, what to set."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from aqualvs.check.doctor import autopilot
from aqualvs.demo import bundled_dive
from aqualvs.live.mavlink.ardusub import ArduSubOptions
from aqualvs.live.options import VehicleSetup
from aqualvs.text import Severity
from live_cases import demo_rig

pytest.importorskip("pymavlink")

from fake_ardusub_cases import AT_START, Fake

OK, WARN, BAD = Severity.OK, Severity.WARN, Severity.BAD
SOUND = {
    "MAV_GCS_SYSID": 255.0,
    "FS_PILOT_INPUT": 1.0,
    "FS_PILOT_TIMEOUT": 1.0,
    "PILOT_SPEED_UP": 50.0,
    "PILOT_SPEED_DN": 0.0,
    "RNGFND1_TYPE": 10.0,
    "RNGFND1_ORIENT": 0.0,
    "RNGFND1_MIN": 0.2,
    "RNGFND1_MAX": 7.0,
}


@pytest.fixture(scope="module")
def vehicle() -> Iterator[Fake]:
    """One other process for all tests."""
    fake = Fake()
    yield fake
    fake.stop()


def found(fake: Fake, setup: VehicleSetup | None = None, **events: Any) -> dict[str, Severity]:
    """What is told of a vehicle that differs so from a sound one."""
    fake.play(**{**AT_START, "parameters": SOUND, **events})
    findings = autopilot(fake.url, setup or VehicleSetup())
    return {one.sentence: one.severity for one in findings}


def told(findings: dict[str, Severity], *words: str) -> Severity:
    """The severity of the only sentence with such words."""
    fits = [sentence for sentence in findings if all(word in sentence for word in words)]
    assert len(fits) == 1, (words, findings)
    return findings[fits[0]]


def test_a_vehicle_that_is_ready(vehicle: Fake) -> None:
    findings = found(vehicle)
    assert set(findings.values()) == {OK}, findings
    assert told(findings, "ArduSub seen") is OK
    assert told(findings, "mode ALT_HOLD: follow engages in it; armed") is OK
    assert told(findings, "ground station 255 is heard") is OK
    assert told(findings, "ATTITUDE", "Hz: follow hears the vehicle") is OK
    assert told(findings, "RC_CHANNELS", "Hz: follow sees the pilot's sticks") is OK
    assert told(findings, "MAV_GCS_SYSID 255", "are obeyed") is OK
    assert told(findings, "FS_PILOT_INPUT 1 (warn)") is OK
    assert told(findings, "FS_PILOT_TIMEOUT 1 s") is OK
    # What the vehicle holds is shown, not what it makes of a 0.
    said = "PILOT_SPEED_UP 50 (PILOT_SPEED_DN 0: the same downwards): a full stick asks for 0.5 m/s"
    assert told(findings, said) is OK
    assert told(findings, "RNGFND1_TYPE 10, RNGFND1_ORIENT 0") is OK
    assert told(findings, "RNGFND1_MIN, RNGFND1_MAX: 0.2 to 7 m are valid") is OK


def test_a_vehicle_as_it_comes(vehicle: Fake) -> None:
    findings = found(
        vehicle, parameters=AT_START["parameters"], mode=19, armed=False, channels_told=False
    )
    assert told(findings, "mode MANUAL", "choose ALT_HOLD; disarmed") is OK
    assert told(findings, "RC_CHANNELS 0 Hz", "set MAV1_RC_CHAN 10", "SR0_RC_CHAN") is WARN
    assert told(findings, "FS_PILOT_INPUT 2", "disarms 3 s after Enter", "FS_PILOT_INPUT 1") is WARN
    assert told(findings, "FS_PILOT_TIMEOUT 3 s", "set FS_PILOT_TIMEOUT 1") is WARN
    assert told(findings, "PILOT_SPEED_UP 500", "5 m/s", "PILOT_SPEED_DN 50") is WARN
    assert told(findings, "RNGFND1_TYPE 0", "set RNGFND1_TYPE 10") is WARN


def test_a_vehicle_that_sinks_at_a_speed_of_its_own(vehicle: Fake) -> None:
    findings = found(vehicle, parameters={**SOUND, "PILOT_SPEED_DN": 500.0})
    assert told(findings, "PILOT_SPEED_UP 50: a full stick asks for 0.5 m/s") is OK
    assert told(findings, "PILOT_SPEED_DN 500: a full stick asks for 5 m/s") is WARN


def test_a_vehicle_that_does_not_obey_us(vehicle: Fake) -> None:
    parameters = {**SOUND, "FS_PILOT_INPUT": 0.0}
    del parameters["MAV_GCS_SYSID"]
    parameters["SYSID_MYGCS"] = 250.0
    findings = found(vehicle, parameters=parameters)
    assert told(findings, "mode ALT_HOLD: follow does not engage") is WARN
    assert told(findings, "SYSID_MYGCS 250", "set SYSID_MYGCS 255, or ground_station 250") is BAD
    assert told(findings, "FS_PILOT_INPUT 0 (off)", "set FS_PILOT_INPUT 1") is BAD
    setup = VehicleSetup(steering=ArduSubOptions(ground_station=250))
    findings = found(vehicle, setup, parameters=parameters)
    assert told(findings, "SYSID_MYGCS 250", "are obeyed") is OK
    assert told(findings, "ground station 250 is not heard", "ground_station") is WARN


def test_a_vehicle_that_does_not_answer(vehicle: Fake) -> None:
    findings = found(vehicle, parameters={}, station=False)
    assert told(findings, "no parameters received", "docs/ardusub.md") is WARN
    assert told(findings, "ground station 255 is not heard") is WARN


def test_a_rangefinder_of_before_4_7_that_is_too_short(vehicle: Fake) -> None:
    parameters = {name: SOUND[name] for name in SOUND if not name.startswith("RNGFND1_M")}
    parameters |= {"RNGFND1_MIN_CM": 50.0, "RNGFND1_MAX_CM": 700.0}
    vehicle.play(**{**AT_START, "parameters": parameters})
    rig = demo_rig()
    findings = {
        one.sentence: one.severity
        for one in autopilot(vehicle.url, VehicleSetup(), Path(str(bundled_dive() / "rig.yaml")))
    }
    least, most = rig.working_range
    assert (
        told(findings, "0.5 to 7 m are valid", f"the rig measures {least:g} to {most:g} m") is WARN
    )
