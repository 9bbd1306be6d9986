"""From pictures to views: find a board or markers, to a few hundredths of a pixel."""

import numpy as np

from aqualvs.calibration.charuco import find_charuco
from aqualvs.calibration.chessboard import find_chessboard
from aqualvs.calibration.corner_grid import Grid
from aqualvs.calibration.diagnosis import why_no_board, why_no_markers
from aqualvs.calibration.markers import read_markers
from aqualvs.calibration.saddle_corners import GreyImage
from aqualvs.calibration.tag_corners import refine_tags
from aqualvs.calibration.targets import Board, BoardKind, MarkerSet
from aqualvs.calibration.view import View

MIN_CORNERS = 6
"""Fewer corners than this fix neither a pose nor their own mistakes."""


def detect_board(
    image: GreyImage, board: Board, name: str, *, min_corners: int = MIN_CORNERS
) -> View | str:
    """Find the inner corners of a board.

    Parameters
    ----------
    image : uint8 array, shape (height, width)
        Grey picture.
    board : Board
        What to look for. A ChArUco board may be seen in part, a chessboard only whole.
    name : str
        How messages call the picture.
    min_corners : int
        Fewer corners are no view.

    Returns
    -------
    View or str
        Points in `board`, ids count the inner corners row by row; or, in a clause, why there is
        none.
    """
    find = find_charuco if board.kind is BoardKind.CHARUCO else find_chessboard
    grid = find(image, board)
    n = int(np.count_nonzero(grid.known))
    if n < min_corners:
        return why_no_board(image, board, n, min_corners)
    return _view(grid, board, name)


def _view(grid: Grid, board: Board, name: str) -> View:
    ids = np.flatnonzero(grid.known).astype(np.int64)
    return View(name, ids, board.corner_points()[ids], grid.pixels.reshape(-1, 2)[ids], grid.notes)


def detect_markers(
    image: GreyImage, marker_set: MarkerSet, name: str, *, min_corners: int = MIN_CORNERS
) -> View | str:
    """Find the corners of the markers of a set.

    Parameters
    ----------
    image : uint8 array, shape (height, width)
        Grey picture.
    marker_set : MarkerSet
        What to look for; other markers of the family are ignored.
    name : str
        How messages call the picture.
    min_corners : int
        Fewer corners are no view.

    Returns
    -------
    View or str
        Points in the set's frame, ids are four times the index in the set plus the corner's place;
        or why there is none, in a clause. Corners that could not be refined cleanly, under a laser
        stripe for example, are missing.
    """
    markers = read_markers(image, marker_set.family)
    index = {int(number): i for i, number in enumerate(marker_set.ids)}
    ours = np.array([i for i, number in enumerate(markers.ids) if int(number) in index], np.int64)
    tags = refine_tags(image, markers.ids[ours], markers.corners[ours], marker_set.family)
    places = np.array([index[int(number)] for number in markers.ids[ours]], np.int64)
    ids = (4 * places[:, None] + np.arange(4))[tags.valid]
    if len(ids) < min_corners:
        return why_no_markers(image, marker_set, markers, len(ids), min_corners)
    order = np.argsort(ids, kind="stable")
    return View(name, ids[order], marker_set.points()[ids[order]], tags.pixels[tags.valid][order])
