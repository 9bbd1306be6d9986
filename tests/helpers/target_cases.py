"""Made-up pictures of printed targets, with the exact place of every corner."""

import cv2
import numpy as np

from aqualvs.calibration.targets.printed import board_rectangles, marker_rectangles
from aqualvs.calibration.targets.targets import Board, BoardKind, MarkerSet, View
from aqualvs.geometry.transforms import SE3

# Finer pixels, per pixel each way, that are averaged: leaves 0.01 px of jaggies at most.
_FINE = 6
# A square of 8 units with a marker of 6, whose cells are then 1 unit: every edge is a whole number.
UNITS = 8


def charuco(squares=(7, 5), **changes):
    unit = 0.004
    options = {
        "kind": BoardKind.CHARUCO,
        "squares": squares,
        "square": UNITS * unit,
        "marker": 6 * unit,
        "dictionary": "DICT_4X4_250",
        "border": 2 * unit,
    }
    return Board(**(options | changes))


def chessboard(squares=(7, 6)):
    return Board(kind=BoardKind.CHESSBOARD, squares=squares, square=0.032, border=0.016)


def raster(rectangles, unit, size):
    """Cells of a target (rows, columns), 1 where light, from black rectangles in lengths."""
    cells = np.ones(size, np.uint8)
    for x, y, w, h in np.rint(np.asarray(rectangles) / unit).astype(int):
        cells[y : y + h, x : x + w] = 0
    return cells


def board_cells(board):
    """Cells of a board with its light border, and the border in cells."""
    unit = board.square / UNITS
    border = round(board.border / unit)
    n_x, n_y = board.squares
    cells = raster(board_rectangles(board), unit, (UNITS * n_y, UNITS * n_x))
    return np.pad(cells, border, constant_values=1), border


def tag_cells(family, number):
    """Cells of a marker with a light ring of one cell and a bit."""
    cells = raster(marker_rectangles(family, number, np.zeros(2), 8.0), 1.0, (8, 8))
    return np.pad(cells, 2, constant_values=1)


def homography(corners_px, size):
    """Map from cells (x right, y down, from the raster's top left) to pixels."""
    w, h = size
    ends = np.array([[0, 0], [w, 0], [w, h], [0, h]], np.float32)
    return cv2.getPerspectiveTransform(ends, np.asarray(corners_px, np.float32))


def seen(h, points):
    """Pixels of points (N, 2) in cells."""
    return cv2.perspectiveTransform(np.asarray(points, np.float64)[None], h)[0]


def picture(cells, h, size, *, blur=0.7, gamma=1.25, noise=1.0, seed=0, light=180.0, dark=14.0):
    """Photograph cells: blurred light, then gamma, noise, whole grey levels.

    `light` and `dark` are grey levels after gamma; what surrounds the target lies between.
    """
    width, height = size
    low, high = (dark / 255.0) ** gamma, (light / 255.0) ** gamma
    # Middles of cells and of fine pixels are at whole numbers.
    cell = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    off = 0.5 * (_FINE - 1)
    fine = np.array([[_FINE, 0.0, off], [0.0, _FINE, off], [0.0, 0.0, 1.0]])
    linear = cv2.warpPerspective(
        (low + (high - low) * cells).astype(np.float32),
        fine @ h @ cell,
        (_FINE * width, _FINE * height),
        flags=cv2.INTER_NEAREST,
        borderValue=low + (high - low) * 0.4,
    )
    linear = cv2.GaussianBlur(linear, (0, 0), blur * _FINE)
    coarse = cv2.resize(linear, size, interpolation=cv2.INTER_AREA).astype(float)
    grey = 255.0 * coarse ** (1.0 / gamma)
    grey += noise * np.random.default_rng(seed).normal(size=grey.shape)
    return np.rint(np.clip(grey, 0, 255)).astype(np.uint8)


def striped(image, start, end, width=2.0):
    """Lay a bright laser stripe with a faint foot over a picture."""
    height, columns = image.shape
    x, y = np.meshgrid(np.arange(columns), np.arange(height))
    along = np.subtract(end, start) / np.linalg.norm(np.subtract(end, start))
    off = (x - start[0]) * -along[1] + (y - start[1]) * along[0]
    glow = 230.0 * np.exp(-0.5 * (off / width) ** 2) + 12.0 * np.exp(-0.5 * (off / 8.0) ** 2)
    return np.clip(image + glow, 0, 255).astype(np.uint8)


def truth_of_board(board, h):
    """Pixels of a board's inner corners."""
    _, border = board_cells(board)
    return seen(h, board.corner_points()[:, :2] / board.square * UNITS + border)


def index_target():
    """Six tags of 12 mm on a plate 25 cm ahead, turned by 6 degrees, in `dome`."""
    corners = [
        (0.015 * i + a - 0.02, 0.0, 0.015 * j + b - 0.015)
        for i in range(3)
        for j in range(2)
        for a, b in ((0.0, 0.012), (0.012, 0.012), (0.012, 0.0), (0.0, 0.0))
    ]
    placed = SE3.from_rotvec((0.0, 0.0, -0.1), (-0.04, 0.25, -0.02)).apply(corners)
    n_markers = 6
    return MarkerSet(
        frame="dome",
        family="DICT_APRILTAG_36h11",
        ids=np.arange(n_markers),
        corners=placed.reshape(n_markers, 4, 3),
        plane_names=(None,) * n_markers,
    )


def index_view(rig):
    """View of `index_target` by a rig, without noise."""
    points = index_target().points()
    pixels, valid = rig.camera().project(points)
    assert valid.all()
    return View("frame", np.arange(len(points)), points, pixels)
