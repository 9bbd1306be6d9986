"""Poses from postures, and courses over time."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aqualvs.errors import OptionError
from aqualvs.simulation.scenario import Course, Trajectory, dome_from_target
from aqualvs.simulation.scenarios import load_scenario


@given(
    distance=st.floats(0.05, 5.0),
    pitch=st.floats(-1.0, 1.0),
    yaw=st.floats(-1.0, 1.0),
    x=st.floats(-1.0, 1.0),
    z=st.floats(-1.0, 1.0),
)
def test_pose_has_the_posture_asked_for(distance, pitch, yaw, x, z):
    pose = dome_from_target(distance, pitch, yaw, (x, z))
    normal = pose.rotation[:, 1]
    # Rounding of a few units in the last place.
    assert np.allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(pose.rotation) == pytest.approx(1.0)
    assert normal @ pose.translation == pytest.approx(distance, abs=1e-12)
    assert np.arctan2(normal[2], normal[1]) == pytest.approx(pitch, abs=1e-12)
    assert np.arctan2(normal[0], normal[1]) == pytest.approx(yaw, abs=1e-12)


def test_slide_moves_the_target_right_and_up():
    still, slid = dome_from_target(0.5, 0.0, 0.0), dome_from_target(0.5, 0.0, 0.0, (0.1, 0.2))
    assert np.allclose(slid.translation - still.translation, [0.1, 0.0, 0.2])


@pytest.mark.parametrize(("distance", "yaw"), [(0.0, 0.0), (-0.3, 0.0), (np.nan, 0.0), (0.5, 1.55)])
def test_impossible_posture_is_refused(distance, yaw):
    with pytest.raises(OptionError):
        dome_from_target(distance, 0.0, yaw)


def test_smooth_course_passes_through_its_values_without_overshoot():
    course = Course(values=(0.3, 0.9, 0.5))
    assert [course.at(t, 4.0) for t in (0.0, 2.0, 4.0)] == pytest.approx([0.3, 0.9, 0.5])
    assert max(course.at(t, 4.0) for t in np.linspace(0, 4, 201)) <= 0.9 + 1e-12


def test_steps_hold_each_value_for_its_share():
    course = Course(values=(1.0, 2.0, 3.0, 4.0), mode="steps")
    seen = [course.at(i / 25.0, 1.6) for i in range(40)]
    assert seen == [1.0] * 10 + [2.0] * 10 + [3.0] * 10 + [4.0] * 10


def test_sway_rides_on_top():
    course = Course(values=(0.5,), sway=0.1, period=4.0)
    assert course.at(1.0, 10.0) == pytest.approx(0.6)
    pose = Trajectory(distance=course).pose_at(1.0, 10.0)
    assert pose.translation[1] == pytest.approx(0.6)


def test_the_motion_goes_on_in_rows_that_are_exposed_before_the_dive_begins():
    steady = Course(values=(0.4, 0.6))
    assert steady.at(-0.01, 2.0) == pytest.approx(0.399)
    assert steady.at(2.01, 2.0) == pytest.approx(0.601)
    assert steady.at(99.0, 2.0) == steady.at(2.1, 2.0)


def test_an_empty_file_is_no_scenario(tmp_path):
    path = tmp_path / "empty.yaml"
    path.write_text("\n")
    with pytest.raises(OptionError, match=r"empty\.yaml: an empty scenario"):
        load_scenario(path)


def test_folds_that_run_into_each_other_are_named_before_anything_is_rendered(tmp_path):
    path = tmp_path / "folds.yaml"
    path.write_text("net: {folds: [{}, {width_mm: 60, every_mm: 110}]}\n")
    place = r"folds\.yaml: net\.folds\[1\]\.every_mm is 110; it must be 0 or at least 120, twice"
    with pytest.raises(OptionError, match=place):
        load_scenario(path)
    path.write_text("net: {folds: [{width_mm: 60, every_mm: 120}]}\n")
    assert load_scenario(path).nets[0].folds[0].period == pytest.approx(0.12)
