"""Rendered pictures of a moving vehicle, as its camera's shutter takes them."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from aqualvs.control.missions import HoldMission
from aqualvs.control.tune import tune
from aqualvs.control.vehicle import Setpoint
from aqualvs.errors import OptionError
from aqualvs.follow import sensor_model
from aqualvs.follow.case import SimCase, vehicle_model
from aqualvs.follow.command import Aim, SimRequest
from aqualvs.follow.loop import Timing
from aqualvs.follow.sensor_model import RenderedSensor, SampledSensor
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.shutter import AT_ONCE, Shutter, ShutterKind
from aqualvs.simulation.net_motion import NetWall
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenarios import example_rig
from aqualvs.simulation.scene import Scene, Wall

_WALL = Scene(dome_from_scene=SE3.identity(), walls=(Wall(),), target="wall")
_SPEED = 0.5


@pytest.fixture(autouse=True)
def one_ray_a_pixel(monkeypatch):
    """What is tested is when a picture is taken; its stripes are as wide."""
    monkeypatch.setattr(sensor_model, "Renderer", partial(Renderer, samples=1))


def seen_ranges(shutter, times):
    """Ranges that a sensor measures that leaves a wall from 500 mm on."""
    rng, net = np.random.default_rng(1), NetWall()
    sensor = RenderedSensor(net, replace(example_rig(), shutter=shutter), rng, _WALL)
    return [sensor.look(net.station(0.5 + _SPEED * t), t).range for t in times], sensor


@pytest.mark.parametrize(
    ("shutter", "age"),
    [
        (AT_ONCE, 0.0),
        (Shutter(exposure=0.01), 0.005),
        (Shutter(kind=ShutterKind.ROLLING, readout=0.02), 0.01),
    ],
    ids=["at-once", "exposed", "rolling"],
)
def test_a_picture_is_of_the_time_before_it_was_read_out(shutter, age):
    found, _ = seen_ranges(shutter, (0.0, 0.04))
    # The vehicle moves by 20 mm from frame to frame; a rolling picture leans by that, its middle
    # hardly moves.
    assert found[1] == pytest.approx(0.5 + _SPEED * (0.04 - age), abs=1.5e-3)


def test_fields_are_frames_each_of_its_own_time():
    times = (0.0, 0.02, 0.04, 0.06)
    found, sensor = seen_ranges(Shutter(kind=ShutterKind.INTERLACED, readout=0.02), times)
    assert found == pytest.approx([0.5 + _SPEED * t for t in times], abs=1e-3)
    frames = [frame for frame, _ in sensor.shots]
    assert [frame.field for frame in frames] == ["top", "bottom"] * 2
    assert {frame.luma.shape for frame in frames} == {(288, 720)}


def test_the_first_field_of_a_picture_waits_for_the_second():
    model = vehicle_model("bluerov2")
    case = SimCase(model=model, gains=tune(model).gains, timing=Timing(fps=50.0, field=0.02))
    loop = case.loop(SampledSensor(case.net, np.random.default_rng(1)), HoldMission(Setpoint(0.6)))
    steps = []
    loop.on_step = lambda now_s, frame_s, *_: steps.append((now_s, frame_s))
    loop.run(0.3)
    assert len(steps) >= 8
    for (first_at, first), (second_at, second) in zip(steps[::2], steps[1::2], strict=False):
        assert second - first == pytest.approx(0.02)
        assert second_at == pytest.approx(first_at)
        assert second_at - second == pytest.approx(0.06)


def test_a_shutter_that_cannot_be_is_refused(tmp_path):
    with pytest.raises(OptionError, match="add --rendered"):
        SimRequest(out=tmp_path, aim=Aim(), shutter="rolling:20:8")
    with pytest.raises(OptionError, match="such as rolling:20:8"):
        SimRequest(out=tmp_path, aim=Aim(), rendered=True, shutter="roll")
    with pytest.raises(OptionError, match="lower fps"):
        SimRequest(out=tmp_path, aim=Aim(), rendered=True, fps=60.0, shutter="rolling:20")
