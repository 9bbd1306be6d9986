"""`aqualvs doctor` on this machine: what works is told, what does not makes it exit with 2."""

import contextlib
import io
import re
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from aqualvs.check import doctor
from aqualvs.check import doctor as doctor_autopilot
from aqualvs.check.doctor import _EXTRAS, run_doctor
from aqualvs.errors import AqualvsError
from aqualvs.geometry import compiled
from aqualvs.text import Finding, Severity
from field_cases import interlaced_rig, woven_dive
from ports import free_port
from repository import ROOT
from shell_cases import cut_after, write_video

MEASURE = doctor._speed
DEMO = Path(doctor.__file__).parents[1] / "data" / "demo"


def told(fault: str | None = None, **checked: Any) -> str:
    """What is printed; with `fault`, what is refused in the end must match it."""
    text = io.StringIO()
    with contextlib.nullcontext() if fault is None else pytest.raises(AqualvsError, match=fault):
        run_doctor(**checked, console=Console(file=text, width=200))
    return text.getvalue()


@pytest.fixture(autouse=True)
def no_dive_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measuring the bundled dive would be most of the time of each test."""
    monkeypatch.setattr(doctor, "_speed", lambda *_: Finding.ok("not measured"))


def test_this_machine_decodes_and_measures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_speed", MEASURE)
    text = told()
    assert "H.264 decoded: 40 frames" in text
    assert "posture in 39 of 40 frames" in text or "posture in 40 of 40 frames" in text


def test_the_speed_is_that_of_compiled_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python runs some kernels in the first seconds of a process, but not in a live run."""
    interprets = []

    class Probe:
        def __init__(self, _rig: object) -> None: ...

        def process(self, _frame: object) -> SimpleNamespace:
            interprets.append(compiled._interpreter.is_allowed)
            return SimpleNamespace(posture=True)

    monkeypatch.setattr(doctor, "Scanner", Probe)
    rig: Any = SimpleNamespace(size_px=(720, 576))
    frames: list[Any] = [None] * 3
    assert MEASURE(rig, frames).severity is Severity.OK
    assert interprets == [False] * 4


def test_a_source_that_fits_the_rig(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_STREAM_S", 2.0)
    text = told(source=str(DEMO / "dive.mp4"), rig=DEMO / "rig.yaml")
    assert "720x576 px" in text
    # A busy machine does not keep up with a recording that comes at its own pace.
    assert re.search(r" \d+ lost", text)


def test_fields_that_the_rig_says_nothing_of_are_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(doctor, "_STREAM_S", 2.0)
    dive, rig = woven_dive(tmp_path / "dive.mp4", 12), interlaced_rig(tmp_path / "rig.yaml")
    wrong = "camera.shutter: {kind: interlaced, readout_ms: 40}"
    assert wrong in told(source=str(dive), rig=DEMO / "rig.yaml")
    assert wrong in told(source=str(dive))
    text = told(source=str(dive), rig=rig)
    assert wrong not in text
    assert re.search(r"posture in \d+ of \d*[02468] frames with the rig", text)
    assert "take camera.shutter out" in told(source=str(DEMO / "dive.mp4"), rig=rig)


def test_silence_is_not_ready_and_the_remedy_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_STREAM_S", 0.5)
    monkeypatch.setattr(doctor_autopilot, "_HEARTBEAT_S", 0.5)
    port = free_port()
    address, fault = f"udp://127.0.0.1:{port}", f"not ready: udp://127.0.0.1:{port}: no picture in"
    text = told(source=address, mavlink="udpin:127.0.0.1:0", fault=fault)
    assert "no heartbeat of an autopilot" in text


def test_a_missing_file_and_another_size_are_told(tmp_path: Path) -> None:
    assert "none.mp4" in told(source=str(tmp_path / "none.mp4"), fault="none.mp4")


def test_a_file_that_is_cut_short_is_told(tmp_path: Path) -> None:
    dive = write_video(tmp_path / "dive.mp4", 10, size=(96, 64), mux={"movflags": "faststart"})
    cut_after(dive, 5)
    text = told(source=str(dive), fault="only 5 of 10 frames")
    assert "96x64 px" in text


def test_a_rig_is_read_also_where_nothing_is_to_fit_it(tmp_path: Path) -> None:
    told(rig=tmp_path / "none.yaml", fault="none.yaml: no such file")


def test_a_package_that_is_missing_names_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_installed", lambda _name: False)
    text = told()
    for extra in _EXTRAS:
        assert f"pip install 'aqualvs[{extra}]'" in text


def test_every_extra_of_users_is_listed_with_its_packages() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    expected = {
        name: {one.partition(">")[0] for one in packages}
        for name, packages in extras.items()
        if name not in ("live", "docs", "dev")
    }
    assert {name: set(packages) for name, (packages, _) in _EXTRAS.items()} == expected
