"""Where a target is black: rectangles of boards and markers, to print or to render."""

import numpy as np

from aqualvs.calibration.tag_corners import marker_cells
from aqualvs.calibration.targets import Board, BoardKind
from aqualvs.geometry.arrays import FloatArray


def board_rectangles(board: Board) -> FloatArray:
    """Return x, y, width, height (N, 4) of a board's black areas, in `board`, metres."""
    n_x, n_y = board.squares
    column, row = np.meshgrid(np.arange(n_x), np.arange(n_y))
    dark = (column + row) % 2 == (1 if board.first_is_light else 0)
    corner = board.square * np.stack([column[dark], row[dark]], axis=-1).astype(np.float64)
    squares = np.concatenate([corner, np.full_like(corner, board.square)], axis=-1)
    if board.kind is BoardKind.CHESSBOARD:
        return squares
    markers = [
        marker_rectangles(board.dictionary, number, points[0, :2], board.marker)
        for number, points in enumerate(board.marker_points())
    ]
    return np.concatenate([squares, *markers])


def marker_rectangles(family: str, number: int, corner: FloatArray, size: float) -> FloatArray:
    """Return x, y, width, height (N, 4) of a marker's black areas.

    Parameters
    ----------
    family : str
        Name of the dictionary.
    number : int
        Which marker of it.
    corner : array, shape (2,)
        The marker's top-left corner, in the unit of `size`.
    size : float
        Side of the marker.
    """
    cells = marker_cells(family, number)[1:-1, 1:-1]
    cell = size / len(cells)
    rectangles = []
    for row, values in enumerate(cells):
        # Runs of dark cells; the light ends close a run at either side.
        edges = np.flatnonzero(np.diff(np.concatenate([[1.0], values, [1.0]])))
        for first, after in edges.reshape(-1, 2):
            x, y = corner + cell * np.array([first, row])
            rectangles.append([x, y, cell * (after - first), cell])
    return np.array(rectangles)
