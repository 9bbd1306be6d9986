"""Scans as signals along the lasers' lines."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.nets.lit_intervals import LineState, NetReader, NetSignal, net_from_dome
from aqualvs.scanning.posture import Reason, Refusal
from aqualvs.scanning.scan import Label, Scan
from aqualvs.simulation.scenario import dome_from_target
from aqualvs.simulation.scenarios import example_rig
from aqualvs.simulation.scene import Fish, Net, Scene, Wall
from net_cases import NetCamera

RIG = example_rig()
NET = Net(mesh="square", bar=0.03, twine=0.003, roll=0.4)
POSE = dome_from_target(0.5, np.deg2rad(4.0), np.deg2rad(-7.0))


@pytest.fixture(scope="module")
def reader() -> NetReader:
    return NetReader(RIG)


@pytest.fixture(scope="module")
def camera() -> NetCamera:
    return NetCamera(RIG)


def scan_of(camera: NetCamera, scene: Scene) -> Scan:
    return camera.scan(scene, 0.0, 3)


def signal_of(reader: NetReader, scan: Scan) -> NetSignal:
    signal = reader.read(scan)
    assert signal is not None
    return signal


def test_the_nets_frame_is_right_up_and_towards_the_vehicle() -> None:
    plane = Scene(dome_from_scene=POSE).target_plane()
    net = net_from_dome(plane.normal, plane.offset)
    np.testing.assert_allclose(net.rotation @ net.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(net.rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(net.apply(plane.offset * plane.normal), 0.0, atol=1e-12)
    assert net.apply(np.zeros(3))[2] == pytest.approx(0.5)
    right, up = net.rotate([1.0, 0.0, 0.0]), net.rotate([0.0, 0.0, 1.0])
    assert right[0] > 0.9
    assert up[1] > 0.9


def test_no_posture_no_signal(reader: NetReader, camera: NetCamera) -> None:
    scan = scan_of(camera, Scene(dome_from_scene=POSE, nets=(NET,), target="net"))
    assert reader.read(replace(scan, posture=Refusal(Reason.NO_TARGET))) is None


def test_light_on_strands_is_found_where_the_strands_are(
    reader: NetReader, camera: NetCamera
) -> None:
    scan = scan_of(camera, Scene(dome_from_scene=POSE, nets=(NET,), target="net"))
    signal = signal_of(reader, scan)
    assert scan.posture
    net = net_from_dome(scan.posture.normal_in_dome, scan.posture.range)
    in_net = net.apply(scan.points.points_in_dome)[:, :2]
    for i in range(3):
        lit = signal.state[i] == LineState.LIT
        assert np.count_nonzero(lit) > 20
        places = signal.origin[i] + signal.along[i, lit, None] * signal.direction[i]
        own = in_net[scan.points.laser == i]
        nearest = np.min(np.hypot(*(places[:, None] - own).transpose(2, 0, 1)), axis=1)
        # Lit twine stands 1.5 mm before the net's plane, and search lines are 0.6 mm apart.
        assert np.max(nearest) < 2.5e-3


def test_steps_add_up_to_the_line(reader: NetReader, camera: NetCamera) -> None:
    scan = scan_of(camera, Scene(dome_from_scene=POSE, nets=(NET,), target="net"))
    signal = signal_of(reader, scan)
    for along, step in zip(signal.along, signal.step, strict=True):
        known = np.isfinite(along)
        assert np.sum(step[known]) == pytest.approx(np.ptp(along[known]), rel=0.02)


def test_crossings_of_lasers_tell_nothing(reader: NetReader, camera: NetCamera) -> None:
    scan = scan_of(camera, Scene(dome_from_scene=POSE, nets=(NET,), target="net"))
    signal = signal_of(reader, scan)
    for i in range(3):
        places = signal.origin[i] + signal.along[i, :, None] * signal.direction[i]
        for k in range(3):
            if k != i:
                beside = np.array([-signal.direction[k][1], signal.direction[k][0]])
                with np.errstate(invalid="ignore"):
                    near = np.abs((places - signal.origin[k]) @ beside) < 2e-3
                assert np.all(signal.state[i, near] == LineState.HIDDEN)


def test_what_a_fish_hides_is_neither_lit_nor_dark(reader: NetReader, camera: NetCamera) -> None:
    open_net = Scene(dome_from_scene=POSE, nets=(NET,), target="net")
    with_fish = replace(open_net, fish=(Fish(position=(0.03, -0.12, -0.02), length=0.2),))
    scan = scan_of(camera, with_fish)
    assert np.count_nonzero(scan.points.label == Label.FISH) > 60
    free = signal_of(reader, scan_of(camera, open_net))
    signal = signal_of(reader, scan)
    lost = (free.state == LineState.LIT) & (signal.state == LineState.DARK)
    hidden = (free.state != LineState.HIDDEN) & (signal.state == LineState.HIDDEN)
    assert np.count_nonzero(hidden) > 50
    # What is taken for dark although a strand is there would make a hole of a fish.
    assert np.count_nonzero(lost) < 0.05 * np.count_nonzero(free.state == LineState.LIT)


def test_light_on_a_wall_shows_where_the_net_let_it_through(
    reader: NetReader, camera: NetCamera
) -> None:
    scene = Scene(dome_from_scene=POSE, nets=(NET,), walls=(Wall(depth=0.4),), target="net")
    signal = signal_of(reader, scan_of(camera, scene))
    open_water = signal_of(reader, scan_of(camera, replace(scene, walls=())))
    assert not open_water.beyond.any()
    dark, lit = signal.state == LineState.DARK, signal.state == LineState.LIT
    assert np.mean(signal.beyond[dark]) > 0.6
    assert np.mean(signal.beyond[lit]) < 0.75 * np.mean(signal.beyond[dark])
