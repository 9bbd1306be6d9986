"""Simulated calibration pictures: the files are those that calibrations read, and they are true."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from aqualvs.calibrate.common import load_nominal
from aqualvs.calibration.detection.detection import detect_board, detect_markers
from aqualvs.calibration.targets.pose_files import load_poses
from aqualvs.calibration.targets.target_files import load_board, load_box, load_target
from aqualvs.calibration.targets.targets import View
from aqualvs.errors import OptionError, OutputError
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.flat_port import FlatPort
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL
from aqualvs.optics.rigfile import load_rig, rig_to_mapping
from aqualvs.optics.shutter import Shutter, ShutterKind
from aqualvs.optics.solved import with_exact_numbers
from aqualvs.optics.water import Dispersion
from aqualvs.simulation.calibration_set import SetSize, simulate_calibration
from aqualvs.simulation.cameras import simulated_camera
from panel_cases import small_rig

SIZE = SetSize(camera=2, dome=3, box=2, index=1, dive=1)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    ticks = []
    out = tmp_path_factory.mktemp("set")
    files = simulate_calibration(
        small_rig(), out, size=SIZE, seed=5, progress=lambda *tick: ticks.append(tick)
    )
    return files, ticks


def test_boards_before_a_flat_port_are_in_water_at_their_true_poses(tmp_path):
    rig = small_rig()
    rig = replace(
        rig,
        lasers=tuple(replace(laser, wavelength_nm=650.0) for laser in rig.lasers),
        housing=FlatPort(0.012, 0.005, 1.49, 0.01, -0.01),
        shutter=Shutter(kind=ShutterKind.ROLLING, readout=0.025, exposure=0.005),
        dome_from_cam=SE3(DOME_FROM_CAM_NOMINAL, np.zeros(3)),
    )
    size = SetSize(camera=1, dome=2, box=1, index=1, dive=0)
    files = simulate_calibration(rig, tmp_path, size=size)
    assert files.dome == tmp_path / "port_water"
    assert files.poses is None
    nominal = load_nominal(files.nominal)
    assert nominal.wavelength_nm == 650.0
    assert nominal.shutter == rig.shutter
    port = nominal.housing
    assert port == replace(rig.flat_port, tilt_x=0.0, tilt_y=0.0)
    board = load_board(files.rail_board)
    # Red lasers have the rig's index; boards and plate are seen in green light.
    green = rig.in_water(Dispersion.of(650.0, rig.n_air).to_green(rig.n_water))
    for name, pose in true_poses(files, "port_water").items():
        view = detect_board(picture(files.dome / name), board, name)
        assert isinstance(view, View), view
        check_close(view.pixels, *green.camera().project(pose.apply(view.points)))
    plate = load_target(files.target)
    view = detect_markers(picture(files.index / "frame_000.png"), plate, "frame")
    assert isinstance(view, View), view
    check_close(view.pixels, *green.camera().project(view.points))
    by_lasers, _ = rig.camera().project(view.points)
    assert np.abs(by_lasers - view.pixels).max() > 0.3


def picture(path):
    return cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)


def true_poses(files, part):
    poses = load_poses(files.rig.parent / f"{part}_poses.csv")
    return {pose.name: pose.dome_from_board for pose in poses}


def check_close(pixels, expected, valid):
    """Noise leaves about 0.02 px, a wrong convention 0.5 px; stripes disturb a few corners."""
    off = np.linalg.norm(pixels - expected, axis=-1)
    assert valid.all()
    assert np.median(off) < 0.05
    assert np.abs(np.median(pixels - expected, axis=0)).max() < 0.02


def test_everything_is_there(made):
    files, ticks = made
    assert sorted(path.name for path in files.nominal.parent.iterdir()) == [
        *("box", "camera_air", "dive", "dome_air", "index", "nominal.yaml", "truth")
    ]
    assert [len(list(folder.glob("*.png"))) for folder in (files.camera, files.dome)] == [2, 3]
    assert [len(list(folder.glob("*.png"))) for folder in (files.box, files.index)] == [2, 1]
    assert files.dive.stat().st_size > 0
    assert files.dive_truth.read_text().count("\n") == 2
    assert files.n_pictures == SIZE.total
    assert ticks == [(i + 1, SIZE.total) for i in range(SIZE.total)]


def test_the_truth_and_what_is_known_beforehand_are_those_of_the_rig(made):
    files, _ = made
    rig = small_rig()
    assert rig_to_mapping(load_rig(files.rig)) == rig_to_mapping(with_exact_numbers(rig))
    nominal = load_nominal(files.nominal)
    assert (nominal.name, nominal.size_px, nominal.n_lasers) == ("example", (360, 288), 3)
    assert nominal.housing == rig.dome


def test_boards_before_the_bare_camera_are_at_their_true_poses(made):
    files, _ = made
    board, camera = load_board(files.board), small_rig().bare_camera()
    for name, pose in true_poses(files, "camera_air").items():
        view = detect_board(picture(files.camera / name), board, name)
        assert isinstance(view, View), view
        check_close(view.pixels, *camera.project(pose.apply(view.points)))


def test_boards_before_the_dome_are_at_their_true_poses_and_distances(made):
    files, _ = made
    board, rig = load_board(files.rail_board), small_rig()
    camera = rig.in_water(rig.n_air).camera()
    poses, tilts = true_poses(files, "dome_air"), []
    for measured in load_poses(files.poses):
        pose = poses[measured.name]
        normal = pose.rotation[:, 2]
        assert measured.dome_from_board is None
        # Nine digits of millimetres are written.
        assert measured.distance == pytest.approx(normal @ pose.translation / normal[1], abs=1e-12)
        tilts.append(np.rad2deg(np.arccos(min(normal @ DOME_FROM_CAM_NOMINAL[:, 2], 1.0))))
        view = detect_board(picture(files.dome / measured.name), board, measured.name)
        assert isinstance(view, View), view
        check_close(view.pixels, *camera.project(pose.apply(view.points)))
    assert tilts[0] == tilts[2] == pytest.approx(0.0, abs=1e-6)
    assert 0.05 < tilts[1] < 1.5


def test_the_markers_of_the_box_are_where_its_file_has_them(made):
    files, _ = made
    box, n_outside = load_box(files.box_file)
    rig = small_rig()
    camera = rig.in_water(rig.n_air).camera()
    assert n_outside == rig.n_air
    assert set(box.planes) == {"forward", "left", "right", "down"}
    seen_on = set()
    for name, box_from_dome in true_poses(files, "box").items():
        view = detect_markers(picture(files.box / name), box, name)
        assert isinstance(view, View), view
        seen_on |= {box.plane_names[i // 4] for i in view.ids}
        check_close(view.pixels, *camera.project(box_from_dome.inverse().apply(view.points)))
    assert len(seen_on) >= 3


def test_the_plate_is_seen_through_the_rigs_water(made):
    files, _ = made
    plate, camera = load_target(files.target), small_rig().camera()
    view = detect_markers(picture(files.index / "frame_000.png"), plate, "frame")
    assert isinstance(view, View), view
    assert len(view.ids) >= 20
    check_close(view.pixels, *camera.project(view.points))


def test_the_same_seed_gives_the_same_pictures(made, tmp_path):
    files, _ = made
    again = simulate_calibration(small_rig(), tmp_path, size=replace(SIZE, dive=0), seed=5)
    other = simulate_calibration(
        small_rig(), tmp_path / "other", size=SetSize(camera=1, dome=1, box=1, index=1, dive=0)
    )
    first = (files.box / "view_00.png").read_bytes()
    assert (again.box / "view_00.png").read_bytes() == first
    assert (other.box / "view_00.png").read_bytes() != first
    assert again.dive is None


@pytest.mark.parametrize("change", [{"housing": None}, {"lasers": ()}])
def test_a_rig_that_cannot_be_calibrated_wholly_is_refused(change, tmp_path):
    with pytest.raises(OptionError, match=next(iter(change))):
        simulate_calibration(replace(small_rig(), **change), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_flat_port_and_a_turned_camera_are_refused(tmp_path):
    rig = replace(small_rig(), housing=FlatPort(0.012, 0.005, 1.49))
    with pytest.raises(OptionError, match=r"leave camera.position_mm and camera.rotation_deg"):
        simulate_calibration(rig, tmp_path / "out")


def test_too_few_pictures_are_refused(tmp_path):
    with pytest.raises(OptionError, match="one picture"):
        simulate_calibration(small_rig(), tmp_path, size=SetSize(box=0))


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "file").write_text("here")
    with pytest.raises(OutputError, match="file"):
        simulate_calibration(small_rig(), tmp_path / "file", size=SIZE)


def test_a_real_camera_keeps_jpegs_that_show_the_same_board(tmp_path):
    size = SetSize(camera=1, dome=1, box=1, index=1, dive=0)
    simulate_calibration(small_rig(), tmp_path, size=size, seed=5)
    files = simulate_calibration(
        small_rig(), tmp_path, size=size, seed=5, camera=simulated_camera("pal")
    )
    kept = [p.name for p in (files.camera, files.dome, files.box, files.index) for p in p.iterdir()]
    assert sum(name.endswith(".jpg") for name in kept) == 4
    assert not any(name.endswith(".png") for name in kept)
    assert [pose.name for pose in load_poses(files.poses)] == ["view_00.jpg"]
    board, camera = load_board(files.board), small_rig().bare_camera()
    ((name, pose),) = true_poses(files, "camera_air").items()
    view = detect_board(picture(files.camera / name), board, name)
    assert isinstance(view, View), view
    pixels, valid = camera.project(pose.apply(view.points))
    assert valid.all()
    # Noise, blur and JPEG at quality 92; the picture stays where it is.
    off = view.pixels - pixels
    assert np.median(np.linalg.norm(off, axis=-1)) < 0.15
    assert np.abs(np.median(off, axis=0)).max() < 0.06
