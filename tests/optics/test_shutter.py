"""The shutter: times of the rows, its part of the rig file, and what it does to a posture."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.check.finding import shutter_finding
from aqualvs.errors import RigError
from aqualvs.optics.expected_error import WallView
from aqualvs.optics.rigfile import load_rig, rig_from_mapping, rig_to_mapping, save_rig
from aqualvs.optics.shutter import AT_ONCE, Shutter, ShutterKind
from aqualvs.simulation.scenarios import example_rig

_ROLLING = Shutter(kind=ShutterKind.ROLLING, readout=0.02, exposure=0.008)
_FIELDS = Shutter(kind=ShutterKind.INTERLACED, readout=0.02, first_field="bottom")


def test_rows_are_exposed_in_their_order_about_the_middle():
    rows = np.arange(576)
    rolling = _ROLLING.row_times(rows, 576)
    assert np.allclose(np.diff(rolling), 0.02 / 576)
    assert rolling.mean() == pytest.approx(0.0, abs=1e-15)
    assert np.array_equal(_FIELDS.row_times(rows[:4], 576), [0.01, -0.01, 0.01, -0.01])
    top = replace(_FIELDS, first_field="top")
    assert np.array_equal(top.row_times([0.4, 0.6], 576), [-0.01, 0.01])
    assert not AT_ONCE.row_times(rows, 576).any()


@pytest.mark.parametrize(
    "shutter", [_ROLLING, replace(_ROLLING, readout=-0.03), _FIELDS, Shutter(exposure=0.0083)]
)
def test_a_shutter_is_saved_and_loaded_to_the_bit(tmp_path, shutter):
    rig = replace(example_rig(), shutter=shutter)
    save_rig(rig, tmp_path / "rig.yaml")
    assert load_rig(tmp_path / "rig.yaml").shutter == shutter


def test_a_rig_file_without_a_shutter_is_written_without_one():
    content = rig_to_mapping(example_rig())
    assert "shutter" not in content["camera"]
    assert rig_from_mapping(content, source_name="rig").shutter == AT_ONCE


@pytest.mark.parametrize(
    ("shutter", "message"),
    [
        ({"kind": "roling"}, "shutter.kind is 'roling'; write 'global', 'rolling' or 'interlaced'"),
        ({"readout": 20}, "did you mean 'readout_ms'"),
        ({"kind": "rolling"}, "shutter.readout_ms is missing or 0; write the milliseconds"),
        ({"kind": "interlaced"}, "20 for PAL"),
        ({"readout_ms": 20}, "leave it out, or write kind: rolling"),
        ({"kind": "rolling", "readout_ms": 20000}, "20000; write milliseconds, -500 to 500"),
        ({"kind": "interlaced", "readout_ms": -20}, "is -20; write milliseconds, 0 to 500"),
        ({"kind": "rolling", "readout_ms": 20, "first_field": "bottom"}, "kind: interlaced"),
        ({"kind": "interlaced", "readout_ms": 20, "exposure_ms": 21}, "from field to field"),
        ("rolling", "for example 'shutter: {kind: rolling, readout_ms: 20, exposure_ms: 8}'"),
    ],
)
def test_a_shutter_that_contradicts_itself_is_refused_with_the_remedy(shutter, message):
    content = rig_to_mapping(example_rig())
    content["camera"]["shutter"] = shutter
    with pytest.raises(RigError, match=r"camera\.shutter") as fault:
        rig_from_mapping(content, source_name="rig.yaml")
    assert message in str(fault.value)
    assert "\n" not in str(fault.value)


def test_rates_move_a_posture_by_what_the_same_pixels_read():
    rig = replace(example_rig(), shutter=_ROLLING)
    wall = WallView.ahead(rig, 0.6)
    times = np.concatenate([_ROLLING.row_times(one.pixels[:, 1], 576) for one in wall.stripes])
    points, weights = wall._weighted(wall._points)
    for i, rate in enumerate(np.diag([0.3, 0.2, 0.2])):
        # Points of a plane that moves, put onto it along the view; small steps, so all is linear.
        step = 1e-4 * rate * times[:, None]
        normal = np.stack([np.tan(step[:, 2]), np.ones(len(step)), np.tan(step[:, 1])], axis=-1)
        normal *= ((0.6 + step[:, 0]) ** -1.0 / np.linalg.norm(normal, axis=1))[:, None]
        values = np.sum(points / weights[:, None] * normal, axis=1)
        x, y, z = np.linalg.lstsq(points / values[:, None], weights)[0]
        read = np.array([1.0 / np.hypot(np.hypot(x, y), z), np.arctan2(z, y), np.arctan2(x, y)])
        change = (read - [0.6, 0.0, 0.0]) / 1e-4
        told = wall.by_rates(lambda rows: _ROLLING.row_times(rows, 576))[:, i] * rate[i]
        assert np.allclose(change, told, atol=2e-3 * np.abs(told).max())


def test_what_a_shutter_means_is_told_in_one_line():
    rig = example_rig()
    assert shutter_finding(rig) is None
    rolling = shutter_finding(replace(rig, shutter=_ROLLING)).sentence
    slower = replace(_ROLLING, readout=0.04)
    assert rolling.startswith("The shutter rolls, 20 ms from the first row to the last. At 0.2 m/s")
    numbers = [
        [float(word) for word in text.split() if word.replace(".", "", 1).isdigit()]
        for text in (rolling, shutter_finding(replace(rig, shutter=slower)).sentence)
    ]
    # Milliseconds, m/s, degrees/s, the wall's mm, then the errors in mm and degrees, which double.
    assert numbers[1][4:6] == pytest.approx([2.0 * value for value in numbers[0][4:6]], abs=0.11)
    fields = shutter_finding(replace(rig, shutter=_FIELDS)).sentence
    assert "fields 20 ms apart" in fields
    assert "4.0 mm and 0.30 degrees" in fields
    blurred = shutter_finding(replace(rig, shutter=Shutter(exposure=0.008)))
    assert "blurs a net over" in blurred.sentence
