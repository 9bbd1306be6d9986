"""The vehicle file: what it sets, and how faults in it are told."""

import math
from pathlib import Path

import pytest

from aqualvs.control.vehicle import SetpointHolder
from aqualvs.errors import OptionError
from aqualvs.live.mavlink.ardusub_commands import Command
from aqualvs.live.options import Page, VehicleSetup, load_vehicle
from live_cases import demo_rig


def write(folder: Path, text: str) -> Path:
    path = folder / "vehicle.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_an_empty_file_says_the_defaults(tmp_path: Path) -> None:
    assert load_vehicle(write(tmp_path, "aqualvs_vehicle: 1\n")) == VehicleSetup()


def test_everything_can_be_set(tmp_path: Path) -> None:
    (tmp_path / "signing.key").write_text("0" * 64, encoding="utf-8")
    (tmp_path / "signing.key").chmod(0o600)
    setup = load_vehicle(
        write(
            tmp_path,
            "aqualvs_vehicle: 1\nsystem: 7\ncomponent: 192\nground_station: 250\n"
            "station_timeout_s: null\ncommand: guided\nmodes: [GUIDED]\nstick_dead_band: 0.2\n"
            "speed_m_s: 0.4\nturning_rate_deg_s: 20\npeers: [192.168.2.2]\nkey: signing.key\n",
        )
    )
    assert (setup.link.system, setup.link.component) == (7, 192)
    assert (setup.link.peers, setup.link.key) == (("192.168.2.2",), bytes(32))
    steering = setup.steering
    assert (steering.ground_station, steering.station_timeout_s) == (250, None)
    assert (steering.command, steering.modes) == (Command.GUIDED, ("GUIDED",))
    assert (steering.stick_dead_band, steering.speed) == (0.2, 0.4)
    assert steering.turning_rate == pytest.approx(math.radians(20))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("ground_station: 255", "aqualvs_vehicle is missing"),
        ("aqualvs_vehicle: 2", "reads version 1"),
        ("aqualvs_vehicle: 1\nground_staton: 250", "did you mean 'ground_station'"),
        ("aqualvs_vehicle: 1\nground_station: 256", "ground_station is 256"),
        ("aqualvs_vehicle: 1\nsystem: 0", "system is 0"),
        ("aqualvs_vehicle: 1\nstation_timeout_s: 0", "station_timeout_s is 0"),
        ("aqualvs_vehicle: 1\nmodes: [MANUAL]", "cannot be steered by sticks"),
        ("aqualvs_vehicle: 1\nmodes: []", "modes is []; name a mode"),
        ("aqualvs_vehicle: 1\npeers: [blueos.local]", "write numbers"),
        ("aqualvs_vehicle: 1\nkey: none.key", "none.key: cannot be read"),
        ("aqualvs_vehicle: 1\ncommand: fly", "command is 'fly'"),
    ],
)
def test_faults_are_one_line(tmp_path: Path, text: str, words: str) -> None:
    path = write(tmp_path, text + "\n")
    with pytest.raises(OptionError) as caught:
        load_vehicle(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("host", "shown"), [("0.0.0.0", "127.0.0.1"), ("127.0.0.1", "127.0.0.1")])
def test_the_address_that_is_printed_can_be_opened(host: str, shown: str) -> None:
    pytest.importorskip("starlette")
    said: list[str] = []
    holder = SetpointHolder((0.3, 2.0))
    page = Page.of(f"{host}:0", "a-token-of-the-test")
    page.serve(demo_rig(), holder, None, said.append, lambda: None).close()
    (line,) = said
    assert line.startswith(f"dashboard: http://{shown}:")
    assert ("on other machines" in line) == (host != shown)
