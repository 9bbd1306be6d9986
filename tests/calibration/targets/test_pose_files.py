from pathlib import Path

import numpy as np
import pytest

from aqualvs.calibrate.common import picture_paths
from aqualvs.calibration.targets.pose_files import load_poses, match_poses
from aqualvs.errors import CalibrationError

_MATRIX = "T00,T01,T02,T03,T10,T11,T12,T13,T20,T21,T22,T23"
_FACING = "1,0,0,-551.4,0,0,1,{y},0,-1,0,413.4"
_FULL = f"file,distance_mm,{_MATRIX}\na.png,200,{_FACING.format(y=200)}\nb.png,,,,,,,,,,,,,\n"


def _written(tmp_path, text):
    path = tmp_path / "poses.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_distances_are_read_in_metres(tmp_path):
    # With the byte order mark and the line ends that spreadsheets write.
    poses = load_poses(_written(tmp_path, "\ufefffile,distance_mm\r\nair/a.png, 250.5\r\n\r\n"))
    assert [pose.name for pose in poses] == ["a.png"]
    assert poses[0].distance == pytest.approx(0.2505)
    assert poses[0].dome_from_board is None


def test_poses_are_read_in_metres_and_empty_cells_are_unknown(tmp_path):
    first, second = load_poses(_written(tmp_path, _FULL))
    assert np.allclose(first.dome_from_board.rotation, [[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    assert np.allclose(first.dome_from_board.translation, [-0.5514, 0.2, 0.4134])
    assert first.distance == 0.2
    assert second.distance is None
    assert second.dome_from_board is None


def test_cut_digits_still_give_a_rotation(tmp_path):
    c, s = 0.9848, 0.1736
    cells = f"{c},{-s},0,0,0,0,1,300,{-s},{-c},0,0"
    pose = load_poses(_written(tmp_path, f"file,{_MATRIX}\na.png,{cells}\n"))[0].dome_from_board
    assert np.allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-15)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("file,distance_mm\n", "holds no rows"),
        ("file;distance_mm\na.png;200\n", "separated by semicolons"),
        ("file,distance\na.png,200\n", "'distance' is not a column of a poses.csv; did you mean"),
        ("file,distance_mm,file\na.png,200,b\n", "column file appears twice"),
        ("distance_mm\n200\n", "column file is missing"),
        ("file\na.png\n", "says nothing of poses"),
        ("file,T00\na.png,1\n", "column T01 is missing"),
        ("file,distance_mm\na.png,200\na.png,300\n", "line 3 names a.png a second time"),
        ("file,distance_mm\na.png,0.2\n", "line 2: distance_mm is 0.2; it looks like metres"),
        ("file,distance_mm\na.png,25\n", "it looks like centimetres"),
        ("file,distance_mm\na.png,-200\n", "distance_mm is -200; give millimetres"),
        ("file,distance_mm\na.png,nan\n", "write a finite number"),
        ("file,distance_mm\na.png,near\n", "distance_mm is 'near'; write a plain number"),
        ("file,distance_mm\na.png\n", "line 2 has 1 values for 2 columns"),
        ("file,distance_mm\n,200\n", "file is empty"),
        (_FULL.replace("1,0,0,-551.4", "1.1,0,0,-551.4"), "not a rotation (off by 0.21)"),
        (_FULL.replace("0,-1,0,413.4", "0,1,0,413.4"), "not a rotation (a mirror image)"),
        (_FULL.replace("1,0,0,-551.4", ",0,0,-551.4"), "T00 is empty"),
        (_FULL.replace("1,200,0", "1,0.2,0"), "T03, T13 and T23 look like metres"),
        (_FULL.replace("1,200,0", "1,230,0"), "plane at 230 mm on the y axis; correct one"),
    ],
)
def test_faults_of_poses_name_the_remedy(tmp_path, text, words):
    path = _written(tmp_path, text)
    with pytest.raises(CalibrationError) as fault:
        load_poses(path)
    assert words in str(fault.value)
    assert str(fault.value).startswith(f"{path}: ")


def test_poses_are_matched_by_file_name(tmp_path):
    poses = load_poses(_written(tmp_path, "file,distance_mm\na.png,200\nb.png,300\nc.png,400\n"))
    given, notes = match_poses(poses, ["c.png", "a.png"], Path("poses.csv"))
    assert [pose.distance for pose in given] == [0.4, 0.2]
    assert notes == ("poses.csv: without a picture of the board: b.png",)
    assert match_poses(poses, ["a.png", "b.png", "c.png"], Path("p"))[1] == ()


def test_copies_of_a_picture_need_no_pose_but_must_not_have_another(tmp_path):
    text = "file,distance_mm\na.png,200\nb.png,300\nc.png,300\n"
    poses, names = load_poses(_written(tmp_path, text)), ["a.png", "b.png"]
    assert match_poses(poses, names, Path("p"), copies={"c.png": "b.png"})[1] == ()
    assert match_poses(poses, names[:1], Path("p"), copies={"d.png": "a.png"})[0] == poses[:1]
    words = "c.png is a copy of the picture a.png, but their distances are 200 and 300 mm"
    with pytest.raises(CalibrationError, match=words):
        match_poses(poses, names, Path("p"), copies={"c.png": "a.png"})


def test_a_picture_without_a_row_is_refused(tmp_path):
    poses = load_poses(_written(tmp_path, "file,distance_mm\nview_1.png,200\n"))
    with pytest.raises(
        CalibrationError, match=r"has no row for view_01.png; .* is view_1.png mean"
    ):
        match_poses(poses, ["view_01.png"], Path("poses.csv"))


def test_pictures_come_in_natural_order_and_once(tmp_path):
    for name in ("a10.png", "a2.png", "a1.JPG", "notes.txt"):
        (tmp_path / name).write_text("")
    (tmp_path / "._a2.png").touch()  # As macOS leaves them.
    paths = picture_paths([str(tmp_path), str(tmp_path / "a2.png")])
    assert [path.name for path in paths] == ["a1.JPG", "a2.png", "a10.png"]
    assert picture_paths([str(tmp_path / "a*.png")]) == [tmp_path / "a2.png", tmp_path / "a10.png"]


def test_arguments_without_pictures_are_refused(tmp_path):
    with pytest.raises(CalibrationError, match="no pictures given"):
        picture_paths([])
    with pytest.raises(CalibrationError, match="no pictures in this folder"):
        picture_paths([tmp_path])
    with pytest.raises(CalibrationError, match="no file matches this pattern"):
        picture_paths([str(tmp_path / "*.png")])
    with pytest.raises(CalibrationError, match="no such picture or folder"):
        picture_paths([str(tmp_path / "a.png")])
    for folder in ("x", "y"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "a.png").write_text("")
    with pytest.raises(CalibrationError, match="has the same file name as"):
        picture_paths([tmp_path / "x", tmp_path / "y"])


@pytest.mark.samples
def test_the_samples_are_read_as_they_stand(samples):
    rows = load_poses(samples / "lab-paper" / "dome_air" / "poses.csv")
    assert len(rows) == 14
    assert rows[1].distance == pytest.approx(0.276923077)
    exact = load_poses(samples / "lab-paper" / "dome_air_exact" / "poses.csv")
    assert all(row.dome_from_board is not None for row in exact)
