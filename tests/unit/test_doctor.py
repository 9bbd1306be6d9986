"""`aqualvs doctor` on this machine: what works is told, what does not makes it exit with 2."""

import io
import re
from pathlib import Path

import pytest
from rich.console import Console

from aqualvs.app import doctor, doctor_autopilot
from aqualvs.app.doctor import EXIT_NOT_READY, EXIT_READY, DoctorRequest, run_doctor
from ports import free_port

DEMO = Path(doctor.__file__).parents[1] / "data" / "demo"


def told(request: DoctorRequest) -> tuple[int, str]:
    text = io.StringIO()
    code = run_doctor(request, Console(file=text, width=200))
    return code, text.getvalue()


def test_this_machine_decodes_and_measures() -> None:
    code, text = told(DoctorRequest())
    assert code == EXIT_READY
    assert "H.264 decoded: 40 frames" in text
    assert "posture in 39 of 40 frames" in text or "posture in 40 of 40 frames" in text


def test_a_source_that_fits_the_rig(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_STREAM_S", 2.0)
    request = DoctorRequest(source=str(DEMO / "dive.mp4"), rig=DEMO / "rig.yaml")
    code, text = told(request)
    assert code == EXIT_READY
    assert "720x576 px" in text
    # A busy machine does not keep up with a recording that comes at its own pace.
    assert re.search(r" \d+ lost", text)


def test_silence_is_not_ready_and_the_remedy_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_STREAM_S", 0.5)
    monkeypatch.setattr(doctor_autopilot, "_HEARTBEAT_S", 0.5)
    request = DoctorRequest(source=f"udp://127.0.0.1:{free_port()}", mavlink="udpin:127.0.0.1:0")
    code, text = told(request)
    assert code == EXIT_NOT_READY
    assert "no picture in" in text
    assert "no heartbeat of an autopilot" in text


def test_a_missing_file_and_another_size_are_told(tmp_path: Path) -> None:
    code, text = told(DoctorRequest(source=str(tmp_path / "none.mp4")))
    assert code == EXIT_NOT_READY
    assert "none.mp4" in text


def test_a_package_that_is_missing_names_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_installed", lambda name: name != "cyclonedds")
    code, text = told(DoctorRequest())
    assert code == EXIT_READY
    assert "pip install 'aqualvs[dds]'" in text
