"""The plan file: the examples, and faults in one line."""

import math
from pathlib import Path

import pytest
import yaml

from aqualvs.control.missions import FollowMission, HoldMission, SurveyMission
from aqualvs.control.plan import load_plan
from aqualvs.errors import OptionError
from repository import ROOT

EXAMPLES = ROOT / "examples"
SURVEY = {
    "aqualvs_plan": 1,
    "mission": "survey",
    "range_m": 0.6,
    "sway_m_s": 0.2,
    "leg": {"time_s": 30},
    "survey": {"depths_m": [2, 5], "step_m": 1},
}


def written(tmp_path: Path, content: object) -> Path:
    path = tmp_path / "plan.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


@pytest.mark.parametrize(
    ("name", "kind"), [("hold", HoldMission), ("follow", FollowMission), ("survey", SurveyMission)]
)
def test_examples_are_plans(name: str, kind: type) -> None:
    plan = load_plan(EXAMPLES / f"plan_{name}.yaml")
    assert plan.name == name
    assert isinstance(plan.mission(), kind)
    assert plan.setpoint.range == 0.6
    # Every call begins anew.
    assert plan.mission() is not plan.mission()


def test_values_reach_their_places(tmp_path: Path) -> None:
    content = {
        **SURVEY,
        "yaw_deg": 10,
        "safety": {"least_range_m": 0.4, "retreat_effort": 0.3, "tilt_deg": 30},
        "loss": {"give_up_s": 30},
    }
    plan = load_plan(written(tmp_path, content))
    assert plan.setpoint.yaw == pytest.approx(math.radians(10.0))
    assert plan.limits.least_range == 0.4
    assert plan.limits.retreat_effort == 0.3
    assert plan.limits.tilt == pytest.approx(math.radians(30.0))
    mission = plan.mission()
    assert isinstance(mission, SurveyMission)
    assert mission._options.depths == (2.0, 3.0, 4.0, 5.0)
    assert mission._options.leg.time == 30.0
    assert mission._watch.options.give_up == 30.0


@pytest.mark.parametrize(
    ("depths", "step", "expected"),
    [
        ([2, 3], 0.4, (2.0, 2.4, 2.8, 3.0)),
        ([3, 2], 0.5, (3.0, 2.5, 2.0)),
        ([4, 2, 6], None, (4.0, 2.0, 6.0)),
        ([4], None, (4.0,)),
    ],
)
def test_depths_by_step_or_one_by_one(
    tmp_path: Path, depths: list[float], step: float | None, expected: tuple[float, ...]
) -> None:
    survey = {"depths_m": depths} if step is None else {"depths_m": depths, "step_m": step}
    mission = load_plan(written(tmp_path, {**SURVEY, "survey": survey})).mission()
    assert isinstance(mission, SurveyMission)
    assert mission._options.depths == pytest.approx(expected)


def without(key: str) -> dict[str, object]:
    return {name: value for name, value in SURVEY.items() if name != key}


HOLD = {"aqualvs_plan": 1, "mission": "hold", "range_m": 0.6}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ([1, 2], "aqualvs_plan is missing"),
        ({**HOLD, "aqualvs_plan": 3}, "reads version 1"),
        ({**HOLD, "mission": "dance"}, "mission is 'dance'; write 'hold', 'follow' or 'survey'"),
        ({**HOLD, "range_mm": 600}, "did you mean 'range_m'?"),
        ({**HOLD, "range_m": "0.6"}, "range_m is '0.6'"),
        ({**HOLD, "range_m": 0.4}, "choose at least 0.45"),
        ({**HOLD, "yaw_deg": 60}, "choose at most 45"),
        ({**HOLD, "sway_m_s": 0.1}, "sway_m_s does nothing in a mission 'hold'"),
        ({**HOLD, "leg": {"time_s": 3}}, "leg does nothing"),
        ({**HOLD, "safety": {"posture_age_s": 1.0}}, "posture_age 1 s: choose at most 0.2"),
        ({**HOLD, "safety": {"min_range_m": 1.0}}, "safety.min_range_m is not a key of this file"),
        ({**HOLD, "loss": {"give_up_s": 0.1}}, "give up"),
        ({**SURVEY, "duration_s": 5}, "duration_s does nothing in a mission 'survey'; use leg"),
        ({**SURVEY, "sway_m_s": 0}, "survey: speed 0"),
        ({**SURVEY, "sway_m_s": 3}, "sway_m_s is 3"),
        ({**SURVEY, "leg": {}}, "legs have no end"),
        ({**SURVEY, "survey": {"depths_m": [1, 2, 3], "step_m": 1}}, "give two, from and to"),
        ({**SURVEY, "survey": {"depths_m": [1, 900], "step_m": 0.1}}, "makes 8991 legs"),
        ({**SURVEY, "survey": {"depths_m": [-1]}}, "survey.depths_m[0] is -1"),
        (without("survey"), "survey is missing"),
        (without("sway_m_s"), "sway_m_s is missing"),
    ],
)
def test_faults_are_told_in_one_line(tmp_path: Path, content: object, words: str) -> None:
    path = written(tmp_path, content)
    with pytest.raises(OptionError) as caught:
        load_plan(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert words in text
    assert "\n" not in text


def test_files_that_are_no_yaml(tmp_path: Path) -> None:
    path = tmp_path / "plan.yaml"
    for content, words in ((b"a: [", "is not YAML"), (b"\xff\xfe\x00", "is not text")):
        path.write_bytes(content)
        with pytest.raises(OptionError, match=words):
            load_plan(path)
    with pytest.raises(OptionError, match="no such file"):
        load_plan(tmp_path / "none.yaml")
