import dataclasses

import cv2
import numpy as np
import pytest

from aqualvs.calibration.detection import boards, detection
from aqualvs.calibration.detection.boards import Markers
from aqualvs.calibration.detection.detection import detect_board, detect_markers
from aqualvs.calibration.detection.saddle_corners import refine_saddles
from aqualvs.calibration.targets.target_files import load_board
from aqualvs.calibration.targets.targets import Board, BoardKind, MarkerSet, View
from target_cases import (
    board_cells,
    charuco,
    chessboard,
    homography,
    picture,
    seen,
    striped,
    tag_cells,
    truth_of_board,
)

_SIZE = (420, 320)
_WHOLE = [[60.3, 40.2], [350.7, 30.9], [380.1, 280.6], [40.8, 290.4]]
_CUT = [[-60.3, -20.2], [330.7, 20.9], [460.1, 330.6], [-40.8, 290.4]]
_SMALL = [[120.3, 90.2], [310.7, 85.9], [320.1, 220.6], [115.8, 230.4]]
# Noise of one grey level, on a contrast of 160, leaves 0.01 px on long edges and 0.03 on those of
# squares of 25 px; jaggies of the rendering 0.01.
_RMS_PX = 0.03
_FARTHEST_PX = 0.15


def _shot(board, corners, **options):
    cells, _ = board_cells(board)
    h = homography(corners, cells.shape[::-1])
    return picture(cells, h, _SIZE, **options), truth_of_board(board, h)


def _errors(view, truth):
    return np.linalg.norm(view.pixels - truth[view.ids], axis=1)


@pytest.mark.parametrize("corners", [_WHOLE, _CUT, _SMALL])
@pytest.mark.parametrize("blur", [0.5, 1.2])
def test_charuco_corners_are_where_they_are_printed(corners, blur):
    board = charuco()
    image, truth = _shot(board, corners, blur=blur)
    view = detect_board(image, board, "a.png")
    assert isinstance(view, View)
    assert view.name == "a.png"
    assert np.array_equal(view.points, board.corner_points()[view.ids])
    inside = np.all((truth > 5.0) & (truth < np.array(_SIZE) - 6.0), axis=1)
    assert set(np.flatnonzero(inside)) <= set(view.ids.tolist())
    errors = _errors(view, truth)
    assert np.sqrt(np.mean(errors**2)) < _RMS_PX
    assert errors.max() < _FARTHEST_PX


def test_a_turned_board_keeps_its_ids():
    board = charuco()
    image, truth = _shot(board, np.roll(_WHOLE, 2, axis=0))
    view = detect_board(image, board, "a.png")
    assert isinstance(view, View)
    assert len(view) == board.n_corners
    assert _errors(view, truth).max() < _FARTHEST_PX


def test_a_legacy_board_is_found_as_one_only():
    board = charuco((7, 6), legacy_pattern=True)
    image, truth = _shot(board, _WHOLE)
    view = detect_board(image, board, "a.png")
    assert isinstance(view, View)
    assert _errors(view, truth).max() < _FARTHEST_PX


def test_a_stripe_costs_corners_but_moves_none():
    board = charuco()
    image, truth = _shot(board, _WHOLE)
    view = detect_board(striped(image, (0.0, 90.0), (420.0, 230.0)), board, "a.png")
    assert isinstance(view, View)
    assert 10 <= len(view) < board.n_corners
    assert _errors(view, truth).max() < 0.3


@pytest.mark.parametrize("turn", [0, 1, 2, 3])
def test_chessboard_corners_come_in_the_boards_order(turn):
    board = chessboard((7, 6))
    image, truth = _shot(board, np.roll(_WHOLE, turn, axis=0))
    view = detect_board(image, board, "a.png")
    assert isinstance(view, View)
    assert len(view) == board.n_corners
    # Seven squares by six have two dark corners on one side: no half-turn goes unnoticed.
    assert _errors(view, truth).max() < _FARTHEST_PX


def test_a_symmetric_chessboard_begins_at_the_top_left():
    board = chessboard((6, 6))
    image, truth = _shot(board, np.roll(_WHOLE, 2, axis=0))
    view = detect_board(image, board, "a.png")
    assert isinstance(view, View)
    assert np.allclose(view.pixels, truth[::-1], atol=_FARTHEST_PX)


@pytest.mark.parametrize("squares", [(9, 6), (8, 6), (7, 5)])
@pytest.mark.parametrize("swapped", [False, True])
@pytest.mark.parametrize("negative", [False, True])
def test_a_chessboard_is_the_same_either_way_round(squares, swapped, negative):
    """Its file may give the counts in either order, and either tone may be in the corner."""
    printed = chessboard(squares)
    cells, border = board_cells(printed)
    if negative:
        cells[border:-border, border:-border] = 1 - cells[border:-border, border:-border]
    h = homography(_WHOLE, cells.shape[::-1])
    image, truth = picture(cells, h, _SIZE), truth_of_board(printed, h)
    asked = dataclasses.replace(printed, squares=squares[::-1]) if swapped else printed
    view = detect_board(image, asked, "a.png")
    assert isinstance(view, View)
    assert len(view) == asked.n_corners
    # All corners, and a map without a mirror from the board asked for: a half or quarter turn.
    apart = np.linalg.norm(view.pixels[:, None] - truth[None], axis=-1)
    assert sorted(np.argmin(apart, axis=1)) == list(range(printed.n_corners))
    assert apart.min(axis=1).max() < _FARTHEST_PX
    x, y = view.pixels[1] - view.pixels[0], view.pixels[asked.corner_grid[0]] - view.pixels[0]
    assert x[0] * y[1] - x[1] * y[0] > 0.0
    # An even and an odd number: half a turn mends the tone. Two odd ones: no turn does. Two even
    # ones: a quarter turn mends it, with the counts in the other order.
    n_odd = sum(n % 2 for n in squares)
    light = {0: negative != swapped, 1: False, 2: negative}[n_odd]
    assert bool(view.notes) == light
    if light:
        assert "first square of the print is light" in view.notes[0]


def _shifted(finder, by):
    """A finder that is one row or column off."""

    def find(image, grid):
        found, corners = finder(image, grid)
        if not found:
            return found, corners
        pixels = np.reshape(corners, (grid[1], grid[0], 2))
        step = pixels[0, 1] - pixels[0, 0] if by == "column" else pixels[1, 0] - pixels[0, 0]
        return found, (pixels + step).reshape(-1, 1, 2)

    return find


@pytest.mark.parametrize("by", ["row", "column"])
@pytest.mark.parametrize("squares", [(7, 6), (8, 6)])
def test_a_grid_that_is_one_line_off_is_shifted_back(monkeypatch, by, squares):
    board = chessboard(squares)
    image, truth = _shot(board, _WHOLE)
    finders = [(name, _shifted(find, by)) for name, find in boards._FINDERS]
    monkeypatch.setattr(boards, "_FINDERS", tuple(finders))
    view = detect_board(image, board, "a.png")
    assert isinstance(view, View)
    assert len(view) == board.n_corners
    assert _errors(view, truth).max() < _FARTHEST_PX
    assert not view.notes


def test_other_finders_are_tried_after_a_wrong_grid(monkeypatch):
    board = chessboard((7, 6))
    image, truth = _shot(board, _WHOLE)
    first, *rest = boards._FINDERS

    def wrong(image, grid):
        return True, np.random.default_rng(1).uniform(50.0, 250.0, (grid[0] * grid[1], 1, 2))

    monkeypatch.setattr(boards, "_FINDERS", ((first[0], wrong), *rest))
    view = detect_board(image, board, "a.png")
    assert isinstance(view, View)
    assert _errors(view, truth).max() < _FARTHEST_PX
    assert view.notes == (
        "board found at a later try (OpenCV's findChessboardCornersSB, in even light)",
    )


def test_a_small_blurred_chessboard_is_found_whole():
    """Blur makes the outline's corners look a little like inner ones; they must not count."""
    board = chessboard((9, 6))
    corners = [[100.0, 60.0], [300.0, 76.0], [272.0, 196.0], [108.0, 184.0]]
    image, truth = _shot(board, corners, blur=1.9)
    view = detect_board(image, board, "a.png")
    assert isinstance(view, View)
    assert len(view) == board.n_corners
    assert _errors(view, truth).max() < _FARTHEST_PX


def test_corners_off_the_board_are_refused():
    board = charuco()
    image, truth = _shot(board, _WHOLE)
    axes = np.broadcast_to(np.diag([40.0, 48.0]), (3, 2, 2))
    # A flat place, the middle of a square's edge, and a corner of the wrong tone.
    flat = np.array([[5.0, 5.0], 0.5 * (truth[0] + truth[1]), truth[0]])
    light = ~board.light_beyond_corners()[[0, 0, 0]]
    fits = refine_saddles(image, flat, axes, light, margin=0.125, bits_from=0.25)
    assert not fits.valid.any()
    assert np.array_equal(fits.pixels, flat)


def test_the_sigma_of_a_corner_is_honest():
    board = chessboard()
    # Turned a little, so that edges cross the pixels at all places.
    ends = [[66.2, 40.1], [346.3, 50.4], [336.7, 296.2], [56.9, 285.8]]
    axes = np.broadcast_to(np.array([[35.0, -1.4], [1.25, 35.0]]), (board.n_corners, 2, 2))
    scores = []
    for seed in range(4):
        image, truth = _shot(board, ends, noise=4.0, seed=seed)
        fits = refine_saddles(
            image, truth, axes, board.light_beyond_corners(), margin=1.0, bits_from=1.0
        )
        assert fits.valid.all()
        scores.append((fits.pixels - truth) / fits.sigma[:, None])
    # 240 coordinates: their spread is known to 5 %, the sigmas themselves to some more.
    assert 0.8 < np.std(scores) < 1.25


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        (charuco((9, 5)), "not as on this board; it looks as if squares_x were 7"),
        (charuco(dictionary="DICT_6X6_250"), "markers of DICT_4X4_1000, not of DICT_6X6_250"),
        (chessboard((12, 9)), "no chessboard of 11 x 8 inner corners"),
    ],
)
def test_a_wrong_board_is_refused_with_the_remedy(asked, words):
    image, _ = _shot(charuco((7, 6)), _WHOLE)
    # Searching for what is not there takes long in large pictures.
    image = cv2.resize(image, None, fx=0.7, fy=0.7, interpolation=cv2.INTER_AREA)
    assert words in detect_board(image, asked, "a.png")


@pytest.mark.parametrize(("every", "is_found"), [(7, True), (3, False)])
def test_a_board_is_found_if_few_markers_are_misread(monkeypatch, every, is_found):
    board = charuco((12, 9), dictionary="DICT_4X4_250")
    read = boards.read_markers

    def misread(*args, **options):
        found = read(*args, **options)
        wrong = found.ids % every == 0
        # The marker of a square elsewhere on the board.
        return Markers(
            np.where(wrong, (found.ids + 25) % board.n_markers, found.ids), found.corners
        )

    monkeypatch.setattr(boards, "read_markers", misread)
    monkeypatch.setattr(detection, "read_markers", misread)
    image, truth = _shot(board, _WHOLE)
    view = detect_board(image, board, "a.png")
    if is_found:
        assert len(view) == board.n_corners
        assert _errors(view, truth).max() < _FARTHEST_PX
    else:
        assert view.endswith("but many are misread; come nearer, or take a sharper picture")


def test_a_larger_dictionary_of_the_same_family_is_named():
    cells, _ = board_cells(charuco((26, 24), dictionary="DICT_4X4_1000"))
    image = np.kron(60 + 140 * cells, np.ones((6, 6), np.uint8)).astype(np.uint8)
    # Rows of markers on both sides of the first 250: half are of the smaller dictionary, too.
    said = detect_board(image[len(image) * 6 // 10 :], charuco(), "a.png")
    assert "are of DICT_4X4_1000: is it the file of another board?" in said
    # Rows of markers beyond the first 250.
    said = detect_board(image[len(image) * 9 // 10 :], charuco(), "a.png")
    assert "markers of DICT_4X4_1000, not of DICT_4X4_250; check the dictionary" in said


def test_an_empty_picture_is_refused():
    image = np.full((100, 140), 90, np.uint8)
    assert detect_board(image, charuco(), "a.png").startswith("no markers of DICT_4X4_250")
    assert "no chessboard" in detect_board(image, chessboard(), "a.png")


def test_too_few_corners_are_refused(monkeypatch):
    monkeypatch.setattr(detection, "MIN_CORNERS", 30)
    board = charuco()
    image, _ = _shot(board, _WHOLE)
    reason = detect_board(image, board, "a.png")
    assert reason.startswith("too few corners of the board (24, at least 30")


def _marker_set(ids):
    corners = np.zeros((len(ids), 4, 3))
    corners[:, :, 0] = np.arange(len(ids))[:, None]
    return MarkerSet(
        frame="dome",
        family="DICT_APRILTAG_36h11",
        ids=np.array(ids),
        corners=corners,
        plane_names=(None,) * len(ids),
    )


def _two_tags():
    cells = np.hstack([tag_cells("DICT_APRILTAG_36h11", number) for number in (7, 3)])
    h = homography([[60, 60], [340, 80], [330, 230], [70, 200]], cells.shape[::-1])
    return picture(cells, h, _SIZE), h


def test_markers_are_matched_by_id():
    image, h = _two_tags()
    view = detect_markers(image, _marker_set([3, 5, 7]), "a.png")
    assert isinstance(view, View)
    assert view.ids.tolist() == [0, 1, 2, 3, 8, 9, 10, 11]
    assert view.points[:, 0].tolist() == [0.0] * 4 + [2.0] * 4
    square = np.array([[2, 2], [10, 2], [10, 10], [2, 10]])
    truth = np.concatenate([seen(h, square + np.array([12, 0])), seen(h, square)])
    assert np.abs(view.pixels - truth).max() < 0.1


def test_missing_markers_are_refused_with_the_remedy():
    image, _ = _two_tags()
    assert "none of the file's (read: 3, 7); check the ids" in detect_markers(
        image, _marker_set([40]), "a.png"
    )
    reason = detect_markers(image, _marker_set([3]), "a.png")
    assert reason.startswith("1 of the markers, but too few clean corners (4, at least 6")


@pytest.mark.samples
def test_real_photographs_of_a_chessboard(samples):
    board = Board(kind=BoardKind.CHESSBOARD, squares=(7, 10), square=0.02909)
    camera = np.array([[1407.86, 0.0, 1083.25], [0.0, 1407.12, 623.67], [0.0, 0.0, 1.0]])
    for i in (1, 4, 9):
        path = samples / "real-laser-on-wall" / f"image{i}.png"
        view = detect_board(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), board, path.name)
        assert isinstance(view, View)
        assert len(view) == 54
        _, turn, place = cv2.solvePnP(view.points, view.pixels, camera, None)
        seen_at, _ = cv2.projectPoints(view.points, turn, place, camera, None)
        off = np.linalg.norm(seen_at[:, 0] - view.pixels, axis=1)
        # The board is paper taped on a wall: half a pixel is its own.
        assert np.sqrt(np.mean(off**2)) < 0.8


@pytest.mark.samples
@pytest.mark.parametrize("name", ["view_00.png", "view_06.png", "view_13.png"])
def test_charuco_behind_a_dome_against_truth(samples, name):
    from sample_truth import board_projection

    folder = samples / "lab-paper" / "dome_air"
    board = load_board(folder / "board.yaml")
    image = cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE)
    view = detect_board(image, board, name)
    assert isinstance(view, View)
    truth, valid = board_projection(samples / "lab-paper", "dome_air", name)(board.corner_points())
    inside = valid & np.all((truth > 4.0) & (truth < np.array([715.0, 571.0])), axis=1)
    assert np.isin(np.flatnonzero(inside), view.ids).mean() > 0.98
    errors = _errors(view, truth)
    assert np.median(errors) < 0.03
    assert errors.max() < 0.3


@pytest.mark.samples
def test_a_wrong_count_of_squares_is_refused_where_some_rows_agree(samples):
    folder = samples / "lab-paper" / "camera_air"
    board = dataclasses.replace(load_board(folder / "board.yaml"), squares=(12, 8))
    image = cv2.imread(str(folder / "view_06.png"), cv2.IMREAD_GRAYSCALE)
    reason = detect_board(image, board, "view_06.png")
    assert isinstance(reason, str)
    assert "it looks as if squares_x were 11" in reason
