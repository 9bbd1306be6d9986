import cv2
import numpy as np
import pytest

from aqualvs.calibration.targets.targets import (
    DICTIONARIES,
    Board,
    BoardKind,
    aruco_dictionary,
    dictionary_id,
)
from aqualvs.errors import CalibrationError
from target_cases import charuco

# OpenCV keeps its boards in single precision.
_SINGLE = 1e-6


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("squares", [(5, 4), (4, 5), (5, 5), (6, 4), (11, 8)])
def test_charuco_points_are_those_of_opencv(squares, legacy):
    board = charuco(squares, legacy_pattern=legacy)
    theirs = cv2.aruco.CharucoBoard(
        squares, board.square, board.marker, aruco_dictionary(board.dictionary)
    )
    theirs.setLegacyPattern(legacy)
    markers = np.array(theirs.getObjPoints())
    assert len(markers) == board.n_markers
    assert np.allclose(board.marker_points(), markers, atol=_SINGLE)
    assert np.allclose(board.corner_points(), theirs.getChessboardCorners(), atol=_SINGLE)


def test_corners_alternate_and_the_first_square_is_dark():
    board = charuco((5, 4))
    # Square (1, 1) is dark like square (0, 0); its right neighbour is light.
    assert board.light_beyond_corners()[:2].tolist() == [False, True]
    legacy = charuco((5, 4), legacy_pattern=True)
    assert legacy.light_beyond_corners()[:2].tolist() == [True, False]
    assert board.n_corners == 12
    assert board.size == pytest.approx((0.16, 0.128))


def test_a_chessboard_has_no_markers():
    board = Board(kind=BoardKind.CHESSBOARD, squares=(7, 10), square=0.029)
    assert board.n_markers == 0
    assert board.margin_share == 1.0
    assert board.describe() == "chessboard of 7 x 10 squares of 29 mm"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"squares": (2, 5)}, "needs 3 each way"),
        ({"square": 0.0}, "must be positive"),
        ({"square": float("nan")}, "must be positive"),
        ({"border": -0.01}, "must be positive"),
        ({"marker": 0.04}, "smaller than its square"),
        ({"marker": 0.0}, "smaller than its square"),
        ({"dictionary": "DICT_9X9"}, "unknown; use DICT_4X4_N"),
        ({"squares": (30, 30)}, "450 markers, but DICT_4X4_250 only 250"),
    ],
)
def test_boards_that_cannot_be_are_refused(changes, words):
    with pytest.raises(CalibrationError, match=words):
        charuco(**changes)


def test_apriltag_families_have_two_spellings():
    assert dictionary_id("DICT_APRILTAG_36h11") == dictionary_id("DICT_APRILTAG_36H11")
    assert dictionary_id("DICT_APRILTAG_36h11") == cv2.aruco.DICT_APRILTAG_36h11
    assert dictionary_id("DICT_4X4_51") is None
    assert all(dictionary_id(name) is not None for name in DICTIONARIES)
    with pytest.raises(CalibrationError, match="'tag36h11' is unknown"):
        aruco_dictionary("tag36h11")
