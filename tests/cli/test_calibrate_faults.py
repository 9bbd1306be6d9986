"""Faults of calibration pictures and files: one line with the remedy, exit code 2."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from aqualvs.calibration.targets.target_files import save_board
from aqualvs.optics.rigfile import save_rig
from aqualvs.simulation.scenarios import example_rig
from target_cases import board_cells, charuco, homography, picture

SIZE = (440, 340)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Six pictures of a board that always faces the camera, and its file."""
    path = tmp_path_factory.mktemp("faults")
    board = charuco()
    cells, _ = board_cells(board)
    for i in range(4):
        x, y = 10 + 10 * i, 8 + 10 * i
        ends = [(x, y), (x + 352, y), (x + 352, y + 256), (x, y + 256)]
        h = homography(ends, (cells.shape[1], cells.shape[0]))
        cv2.imwrite(str(path / f"view_{i}.png"), picture(cells, h, SIZE, seed=i))
    save_board(board, path / "board.yaml")
    save_board(replace(board, dictionary="DICT_5X5_100"), path / "other.yaml")
    rig = replace(example_rig(), size_px=SIZE, lasers=(), solved_from={})
    save_rig(rig, path / "rig.yaml")
    save_rig(replace(rig, housing=None), path / "bare.yaml")
    (path / "box.yaml").write_text(
        "frame: G\nplanes:\n  wall: {normal: [0, 1, 0], d: 700}\nfamily: DICT_APRILTAG_36h11\n"
        "markers:\n- {id: 0, plane: wall, size_mm: 48, corners: [[0, 700, 48], [48, 700, 48], "
        "[48, 700, 0], [0, 700, 0]]}\n"
    )
    return path


@pytest.fixture
def faulty(folder, refused, tmp_path):
    """Run a step of a calibration with a board, which must refuse; returns its words."""

    def run(step, *more, rig=folder / "rig.yaml"):
        board, out = folder / "board.yaml", tmp_path / "rig.yaml"
        return refused("calibrate", step, folder, "--board", board, "--rig", rig, "-o", out, *more)

    return run


def test_pictures_that_are_not_there(folder, refused, tmp_path):
    board = folder / "board.yaml"
    said = refused("calibrate", "camera", tmp_path / "no*.png", "--board", board, "-o", "x.yaml")
    assert "no*.png: no file matches this pattern" in said


def test_a_board_that_all_pictures_show_alike(folder, refused, tmp_path):
    out = tmp_path / "rig.yaml"
    said = refused("calibrate", "camera", folder, "--board", folder / "board.yaml", "-o", out)
    assert "tilt" in said
    assert not out.exists()


def test_pictures_without_the_board_are_counted_in_a_refusal(folder, refused, tmp_path):
    for path in sorted(folder.glob("view_*.png")):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    cv2.imwrite(str(tmp_path / "blank.png"), np.full(SIZE[::-1], 90, np.uint8))
    board = folder / "board.yaml"
    said = refused("calibrate", "camera", tmp_path, "--board", board, "-o", tmp_path / "rig.yaml")
    assert "tilt" in said
    assert f"; 1 of 5 pictures could not be used with {board} (blank.png: no " in said


def test_a_board_of_another_dictionary(folder, refused, tmp_path):
    said = refused(
        "calibrate", "camera", folder, "--board", folder / "other.yaml", "-o", tmp_path / "rig.yaml"
    )
    assert f"{folder / 'other.yaml'}: found in none of 4 pictures" in said
    assert "DICT" in said


def test_mixed_sizes_and_what_is_no_picture(folder, refused, tmp_path):
    for path in sorted(folder.glob("view_*.png")):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    cv2.imwrite(str(tmp_path / "view_3.png"), np.zeros((240, 440), np.uint8))
    board = folder / "board.yaml"
    said = refused("calibrate", "camera", tmp_path, "--board", board, "-o", tmp_path / "rig.yaml")
    assert "view_3.png: 440x240 px, but the other pictures have 440x340 px" in said
    (tmp_path / "view_3.png").write_text("no picture")
    said = refused("calibrate", "camera", tmp_path, "--board", board, "-o", tmp_path / "rig.yaml")
    assert "view_3.png: not a readable picture" in said


def test_a_video_is_no_picture_and_how_to_get_some(folder, refused, tmp_path):
    video = tmp_path / "a dive.mp4"
    video.write_text("no picture")
    said = refused(
        *("calibrate", "camera", video, "--board", folder / "board.yaml", "-o", tmp_path / "r.yaml")
    )
    assert "a dive.mp4: is a video, but this step takes pictures" in said
    assert said.endswith(f"-i '{video}' -r 1 '{tmp_path / 'a dive_%03d.png'}'")


def test_a_dome_that_nobody_measured(folder, faulty, tmp_path):
    said = faulty("dome", rig=folder / "bare.yaml")
    assert "bare.yaml: has no dome; give --inner-radius-mm" in said


def test_poses_without_a_row_for_a_picture(folder, faulty, tmp_path):
    poses = tmp_path / "poses.csv"
    poses.write_text("file,distance_mm\nview_0.png,300\n")
    said = faulty("dome", "--poses", poses)
    assert "poses.csv: has no row for view_1.png" in said


@pytest.mark.parametrize(
    ("poses", "words"),
    [
        ("file,distance_mm\nview_0.png,0.3\n", "looks like metres"),
        ("file,distance_mm\nview_0.png,abc\n", "write a plain number"),
        ("name,distance\nview_0.png,300\n", "is not a column"),
        ("file,distance_mm\n", "holds no rows"),
    ],
)
def test_poses_that_cannot_be(folder, faulty, tmp_path, poses, words):
    path = tmp_path / "poses.csv"
    path.write_text(poses)
    said = faulty("dome", "--poses", path)
    assert "poses.csv" in said
    assert words in said


def test_lasers_need_one_target_of_two_planes(folder, refused, tmp_path):
    rig, out = folder / "rig.yaml", tmp_path / "rig.yaml"
    said = refused("calibrate", "lasers", folder, "--rig", rig, "-o", out)
    assert "--box or --board" in said
    said = refused(
        "calibrate", "lasers", folder, "--box", folder / "box.yaml", "--rig", rig, "-o", out
    )
    assert "the box has 1 plane" in said


@pytest.mark.parametrize("wavelength", ["5320", "0.532", "nan"])
def test_a_wavelength_that_no_camera_sees(folder, faulty, tmp_path, wavelength):
    said = faulty("lasers", "--wavelength-nm", wavelength)
    remedy = "give a finite number" if wavelength == "nan" else "write the wavelength in nanometres"
    assert wavelength in said
    assert "--wavelength-nm" in said
    assert remedy in said
    assert not (tmp_path / "rig.yaml").exists()


def test_pictures_of_another_size_than_the_rig(folder, faulty, tmp_path):
    rig = replace(example_rig(), lasers=())
    save_rig(rig, tmp_path / "large.yaml")
    said = faulty("lasers", rig=tmp_path / "large.yaml")
    assert "the rig's camera was calibrated at" in said


def test_a_medium_that_is_none(folder, faulty, tmp_path):
    said = faulty("dome", "--medium", "oil")
    assert "--medium oil: not understood" in said
