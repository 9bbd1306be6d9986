import numpy as np
import pytest

from aqualvs.calibration.targets.target_files import (
    load_board,
    load_box,
    load_target,
    save_board,
    save_markers,
)
from aqualvs.calibration.targets.targets import BoardKind, MarkerSet
from aqualvs.errors import CalibrationError, OutputError
from aqualvs.geometry.planes import Plane
from target_cases import charuco, chessboard

_BOARD = """\
squares_x: 11
squares_y: 8
square_mm: 24.0
marker_mm: 18.0
dictionary: DICT_4X4_250
border_mm: 12.0
note: ChArUco; unquoted: text
"""
_BOX = """\
frame: G: origin at the middle of the open mouth, mm; plane: normal . X = d
planes:
  forward:
    normal: [0.0, 2.0, 0.0]
    d: 1400.0
  down:
    normal: [0.0, 0.0, 1.0]
    d: -190.0
family: DICT_APRILTAG_36h11
corner_order: as OpenCV reports: top-left, top-right, bottom-right, bottom-left of the marker
markers:
  - id: 4
    plane: forward
    size_mm: 48.0
    corners: [[-24, 700, 24], [24, 700, 24], [24, 700, -24], [-24, 700, -24]]
  - id: 9
    plane: down
    size_mm: 48.0
    corners: [[-24, 624, -190], [24, 624, -190], [24, 576, -190], [-24, 576, -190]]
medium:
  n_outside_nominal: 1.333
"""
_TARGET = """\
family: DICT_APRILTAG_36h11
markers:
  - id: 300
    size_mm: 12.0
    corners: [[-60, 250, 0], [-48, 250, 0], [-48, 250, -12], [-60, 250, -12]]
"""


def _written(tmp_path, text):
    path = tmp_path / "file.yaml"
    path.write_text(text)
    return path


def test_a_board_is_read_in_metres(tmp_path):
    board = load_board(_written(tmp_path, _BOARD))
    assert board.kind is BoardKind.CHARUCO
    assert board.squares == (11, 8)
    assert (board.square, board.marker, board.border) == (0.024, 0.018, 0.012)


def test_inner_corners_are_one_less_than_squares(tmp_path):
    text = "{inner_corners_x: 6, inner_corners_y: 9, square_mm: 29.09}"
    board = load_board(_written(tmp_path, text))
    assert board.kind is BoardKind.CHESSBOARD
    assert board.squares == (7, 10)


@pytest.mark.parametrize(
    "board", [charuco(), charuco((6, 6), legacy_pattern=True), chessboard((5, 4))]
)
def test_a_board_survives_its_file(tmp_path, board):
    path = tmp_path / "deep" / "board.yaml"
    save_board(board, path, note="a: b")
    assert load_board(path) == board


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("square_mm: 24.0", "square_cm: 2.4", "square_cm is not a key of this file; did you mean"),
        ("square_mm: 24.0\n", "", "square_mm is missing; add it, for example 'square_mm: 24.0'"),
        ("square_mm: 24.0", "square_mm: 0.024", "0.024; it looks like metres"),
        ("square_mm: 24.0", "square_mm: 2.4", "2.4; it looks like centimetres"),
        ("square_mm: 24.0", "square_mm: 24000", "no camera sees one whole"),
        ("square_mm: 24.0", "square_mm: .nan", "square_mm is nan; write a finite number"),
        ("square_mm: 24.0", "square_mm: '24'", "square_mm is '24'; write a plain number"),
        ("squares_x: 11", "squares_x: 11.5", "squares_x is 11.5; write a whole number"),
        ("squares_x: 11\n", "", "the number of squares is missing; write squares_x"),
        ("squares_x: 11", "squares_x: 11\ninner_corners_x: 10", "keep squares_x and squares_y"),
        ("squares_x: 11", "squares_x: 11\nsquares_x: 12", "'squares_x' appears twice"),
        ("marker_mm: 18.0", "marker_mm: 25.0", "a marker is smaller than its square"),
        ("marker_mm: 18.0\n", "", "marker_mm is missing; a ChArUco board has markers"),
        ("DICT_4X4_250", "DICT_4x4_251", "did you mean DICT_4X4_250"),
        ("DICT_4X4_250", "tags", "'tags', which is unknown; use DICT_4X4_N, "),
        ("DICT_4X4_250", "4x4_250", "did you mean DICT_4X4_250"),
        ("DICT_4X4_250", "DICT_9X9_250", "N = 50, 100, 250 or 1000, or one of DICT_APRILTAG_16H5"),
        ("squares_x: 11", "kind: chessboard\nsquares_x: 11", "but kind is chessboard"),
        ("squares_x: 11", "kind: charucco\nsquares_x: 11", "kind is 'charucco'; write"),
        ("squares_x: 11", "squares_x: [11", "is not YAML"),
    ],
)
def test_faults_of_a_board_name_the_remedy(tmp_path, old, new, words):
    path = _written(tmp_path, _BOARD.replace(old, new))
    with pytest.raises(CalibrationError) as fault:
        load_board(path)
    assert words in str(fault.value)
    assert str(fault.value).startswith(f"{path}: ")
    assert str(fault.value).count(str(path)) == 1
    assert "\n" not in str(fault.value)


def test_files_that_are_none_are_refused(tmp_path):
    with pytest.raises(CalibrationError, match=r"no such file; give the path of a board\.yaml"):
        load_board(tmp_path / "no.yaml")
    with pytest.raises(CalibrationError, match=r"is a folder; give the path of a box\.yaml in it"):
        load_box(tmp_path)
    (tmp_path / "bytes").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(CalibrationError, match="is not text"):
        load_target(tmp_path / "bytes")
    with pytest.raises(CalibrationError, match="holds no keys"):
        load_target(_written(tmp_path, "- 1"))


def test_a_box_is_read_in_metres(tmp_path):
    markers, n_nominal = load_box(_written(tmp_path, _BOX))
    assert n_nominal == 1.333
    assert markers.frame == "box"
    assert markers.ids.tolist() == [4, 9]
    assert markers.plane_names == ("forward", "down")
    # normal . X = d holds for the normal as it is written, whatever its length.
    assert markers.planes["forward"] == Plane(pytest.approx(np.array([0.0, 1.0, 0.0])), 0.7)
    assert np.allclose(markers.points()[1], [0.024, 0.7, 0.024])


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("id: 9", "id: 4", "marker 4 is listed twice"),
        ("id: 9", "id: 587", "marker 587 is not in DICT_APRILTAG_36h11, which has ids 0 to 586"),
        ("id: 9", "di: 9", "markers[1].di is not a key of this file; did you mean 'id'?"),
        ("plane: down", "plane: dwn", "plane 'dwn' is not in planes; did you mean 'down'?"),
        ("    plane: down\n", "", "markers[1].plane is missing (id 9)"),
        ("d: -190.0", "d: -200.0", "marker 9: corner 0 lies 10.0 mm off plane 'down'"),
        ("normal: [0.0, 0.0, 1.0]", "normal: [0, 0, 0]", "planes.down.normal"),
        ("normal: [0.0, 0.0, 1.0]", "normal: [0, 1]", "planes.down.normal is [0, 1]; write 3"),
        ("size_mm: 48.0", "size_mm: 0.048", "size_mm is 0.048; it looks like metres"),
        ("size_mm: 48.0", "size_mm: 1.2", "size_mm is 1.2; it looks like centimetres"),
        ("size_mm: 48.0", "size_mm: 480.0", "the corners look like centimetres"),
        ("size_mm: 48.0", "size_mm: 48000.0", "the corners look like metres"),
        ("size_mm: 48.0", "size_mm: 50.0", "48.00 mm apart, but size_mm is 50"),
        ("[24, 700, 24], [24, 700, -24]", "[24, 700, -24], [24, 700, 24]", "not in order around"),
        ("[24, 700, 24], [24, 700, -24]", "[29, 700, 24], [29, 700, -24]", "apart, but size_mm"),
        ("top-left, top-right,", "top-left, bottom-left,", "so reorder the corners"),
        ("DICT_APRILTAG_36h11", "DICT_APRILTAG_36h12", "family is 'DICT_APRILTAG_36h12'"),
        ("n_outside_nominal: 1.333", "n_outside_nominal: 133", "it must be at most 2"),
    ],
)
def test_faults_of_a_box_name_the_remedy(tmp_path, old, new, words):
    path = _written(tmp_path, _BOX.replace(old, new))
    with pytest.raises(CalibrationError) as fault:
        load_box(path)
    assert words in str(fault.value)
    assert str(fault.value).startswith(f"{path}: ")
    assert "\n" not in str(fault.value)


def test_a_box_without_planes_is_refused(tmp_path):
    with pytest.raises(CalibrationError, match="planes is missing; a box has planes"):
        load_box(_written(tmp_path, _TARGET))


def test_a_mirrored_marker_is_refused(tmp_path):
    mirrored = "[[24, 700, 24], [-24, 700, 24], [-24, 700, -24], [24, 700, -24]]"
    text = _BOX.replace(
        "[[-24, 700, 24], [24, 700, 24], [24, 700, -24], [-24, 700, -24]]", mirrored
    )
    with pytest.raises(CalibrationError, match="marker 4: seen from the camera its corners run"):
        load_box(_written(tmp_path, text))


def test_a_leaning_rhombus_is_refused(tmp_path):
    rhombus = "[[-24, 700, 24], [24, 700, 24], [34, 700, -22.9], [-14, 700, -22.9]]"
    text = _BOX.replace("[[-24, 700, 24], [24, 700, 24], [24, 700, -24], [-24, 700, -24]]", rhombus)
    with pytest.raises(CalibrationError, match="so it is not a square"):
        load_box(_written(tmp_path, text))


def test_a_target_is_read_in_the_domes_frame(tmp_path):
    target = load_target(_written(tmp_path, _TARGET))
    assert target.frame == "dome"
    assert target.plane_names == (None,)
    assert np.allclose(target.corners[0, 0], [-0.06, 0.25, 0.0])


def test_a_target_inside_the_dome_is_refused(tmp_path):
    text = _TARGET.replace("250", "25").replace("-60", "-6").replace("-48", "6")
    with pytest.raises(CalibrationError, match="inside any dome; check the units"):
        load_target(_written(tmp_path, text))


def test_a_plate_whose_place_is_not_known_is_refused(tmp_path):
    path = _written(tmp_path, "frame: plate (x right)\n" + _TARGET)
    with pytest.raises(
        CalibrationError, match="frame is plate, so its corners are not in the dome"
    ):
        load_target(path)


def test_markers_survive_their_file(tmp_path):
    corners = np.array([[[-24, 700, 24], [24, 700, 24], [24, 700, -24], [-24, 700, -24]]]) / 1e3
    markers = MarkerSet(
        frame="box",
        family="DICT_APRILTAG_36h11",
        ids=np.array([3]),
        corners=corners,
        plane_names=("forward",),
        planes={"forward": Plane(np.array([0.0, 1.0, 0.0]), 0.7)},
    )
    save_markers(markers, tmp_path / "box.yaml")
    again, n_nominal = load_box(tmp_path / "box.yaml")
    assert n_nominal is None
    assert np.array_equal(again.corners, corners)
    assert again.planes["forward"].offset == 0.7


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        save_board(charuco(), tmp_path / "file" / "board.yaml")


@pytest.mark.samples
def test_the_samples_are_read_as_they_stand(samples):
    lab = samples / "lab-paper"
    assert load_board(lab / "camera_air" / "board.yaml").squares == (11, 8)
    assert load_board(lab / "dome_air" / "board.yaml").n_markers == 570
    box, n_nominal = load_box(lab / "box" / "box.yaml")
    assert len(box) == 101
    assert n_nominal == 1.0003
    assert set(box.planes) == {"left", "right", "forward", "down"}
    assert load_box(lab / "box_water" / "box.yaml")[1] == 1.333
    assert len(load_target(lab / "index" / "target.yaml")) == 6
