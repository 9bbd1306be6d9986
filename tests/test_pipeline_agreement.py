"""Lasers that disagree: from the frames of a run to its last lines, `run.yaml` and the report."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from agreement_cases import Diver, Target
from aqualvs.errors import RigError
from aqualvs.optics.rig import Rig, RigUncertainty, rig_moved_by, rig_parameter_names
from aqualvs.optics.rigfile import rig_to_mapping, save_rig
from aqualvs.optics.solved import with_uncertainty
from aqualvs.pipeline import open_dive, run, summary_for, summary_lines
from aqualvs.report.run_page import write_report
from aqualvs.results.agreement import LaserAgreement
from aqualvs.results.folder import RunOutputs, prepare_folder
from aqualvs.results.run_request import RunRequest
from aqualvs.results.summary import RunSummary
from aqualvs.scanning.scan import Frame, Scan
from aqualvs.simulation.scenarios import example_rig
from report_cases import make_dive
from shell_cases import write_video

RIG = example_rig()


def scans(degrees: float) -> list[Scan]:
    seen = rig_moved_by(RIG, ("left:tilt_1",), np.array([np.tan(np.deg2rad(degrees))]))
    diver = Diver(seen, RIG)
    return [diver.scan(Target(0.4 + 0.02 * i, yaw_deg=float(i)), index=i) for i in range(18)]


def watched(degrees: float) -> RunSummary:
    summary = RunSummary(agreement=LaserAgreement(RIG))
    for scan in scans(degrees):
        summary.add(scan)
    return summary


def test_a_drifted_laser_gets_a_line_and_its_facts() -> None:
    summary = watched(0.4)
    assert summary.lines()[-1].startswith("laser 2 (left) is off by 0.4 deg (its stripe lies")
    assert "recalibrate" in summary.lines()[-1]
    found = summary.to_dict()["laser_agreement"]
    assert found["state"] == "drifted"
    assert found["suspects"] == ["left"]
    assert found["angle_deg"] == pytest.approx(0.4, abs=0.02)
    assert found["words"] == summary.lines()[-1]


def test_lasers_that_agree_are_not_spoken_of() -> None:
    summary = watched(0.0)
    assert not any("laser" in line for line in summary.lines())
    assert summary.to_dict()["laser_agreement"] == {"state": "agree", "n_frames": 6}
    assert "laser_agreement" not in RunSummary().to_dict()


@pytest.mark.parametrize("degrees", [0.0, 0.4])
def test_the_run_file_and_the_report_tell(tmp_path: Path, degrees: float) -> None:
    folder = make_dive(tmp_path / "dive").folder
    (folder / "run.yaml").unlink()
    summary = RunSummary(agreement=LaserAgreement(RIG))
    with RunOutputs(
        folder, source={}, rig=rig_to_mapping(RIG), options={}, summary=summary
    ) as outputs:
        for scan in scans(degrees):
            outputs.write(scan)
    content = yaml.safe_load((folder / "run.yaml").read_text())
    state = content["summary"]["laser_agreement"]["state"]
    assert state == ("drifted" if degrees else "agree")
    page = write_report(folder).read_text()
    assert ("Laser 2 (left) is off by 0.4 deg" in page) == bool(degrees)


class DriftedScanner:
    """Answers every frame with a scan in which one laser has drifted."""

    def __init__(self) -> None:
        self._scans = scans(0.4)

    def process(self, frame: Frame) -> Scan:
        return self._scans[frame.index]


def request(tmp_path: Path, **more: object) -> RunRequest:
    save_rig(RIG, tmp_path / "rig.yaml")
    source = write_video(tmp_path / "dive.mp4", 18, size=RIG.size_px)
    return RunRequest(
        source=str(source), rig=tmp_path / "rig.yaml", out=tmp_path / "out", report=False, **more
    )


def test_a_run_watches_its_lasers(tmp_path: Path) -> None:
    asked = request(tmp_path)
    result = run(asked, scanner_for=lambda _rig, _options: DriftedScanner())
    assert any("laser 2 (left) is off" in line for line in summary_lines(asked, result))


def test_without_the_dome_the_lasers_are_not_blamed(tmp_path: Path) -> None:
    asked = request(tmp_path, no_dome=True)
    result = run(asked, scanner_for=lambda _rig, _options: DriftedScanner())
    assert not any("is off" in line for line in summary_lines(asked, result))
    content = yaml.safe_load((asked.out / "run.yaml").read_text())
    assert "laser_agreement" not in content["summary"]


def test_one_laser_has_none_to_agree_with(tmp_path: Path) -> None:
    one = Rig(**{name: getattr(RIG, name) for name in RIG.__slots__} | {"lasers": RIG.lasers[:1]})
    with open_dive(request(tmp_path)) as dive:
        assert summary_for(replace(dive, rig=one)).agreement is None
        assert summary_for(dive).agreement is not None


def test_a_malformed_rig_is_named(tmp_path: Path) -> None:
    rig = with_uncertainty(RIG, RigUncertainty.independent({"fx": 1.0}))
    rig.solved_from["uncertainty"]["sigma"] = ["wide"]
    message = r"rig\.yaml: solved_from\.uncertainty\.sigma\[0\]"
    with open_dive(request(tmp_path)) as dive, pytest.raises(RigError, match=message):
        summary_for(replace(dive, rig=rig))


def test_a_long_rig_stays_short_in_the_run_file(tmp_path: Path) -> None:
    """The correlations of 28 numbers take a line each, not one for each pair."""
    names = rig_parameter_names(RIG)
    rig = with_uncertainty(RIG, RigUncertainty(names, np.eye(len(names))))
    prepare_folder(tmp_path, overwrite=False)
    with RunOutputs(tmp_path, source={}, rig=rig_to_mapping(rig), options={}):
        pass
    text = (tmp_path / "run.yaml").read_text()
    assert yaml.safe_load(text)["rig"] == rig_to_mapping(rig)
    assert len(text.splitlines()) < 120
