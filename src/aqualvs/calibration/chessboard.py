"""Find a plain chessboard, all of it, and put its corners in the board's order."""

import cv2
import numpy as np

from aqualvs.calibration.corner_grid import Grid, misfits, nothing_known, predict
from aqualvs.calibration.saddle_corners import GreyImage, refine_saddles
from aqualvs.calibration.targets import Board
from aqualvs.geometry.arrays import FloatArray

# OpenCV's finders look at every pixel; above this size a smaller picture finds the same board.
_MAX_WIDTH_PX = 1400
_MISFIT_SHARE = 0.12


def find_chessboard(image: GreyImage, board: Board) -> Grid:
    """Find the inner corners of a chessboard.

    Returns
    -------
    Grid
        Nothing known where the board is not seen whole. Corners that the picture does not bear
        out, under a laser stripe for example, are not known.

    Notes
    -----
    A board whose number of squares is even in both directions, or odd in both, looks the same
    when it is turned by half a turn: then the corner nearer to the picture's top left comes first.
    """
    n_x, n_y = board.corner_grid
    shape = (n_y, n_x)
    rough = _rough_corners(image, (n_x, n_y))
    if rough is None:
        return nothing_known(board)
    pixels = _in_board_order(image, rough.reshape(*shape, 2), board)
    axes = predict(pixels, np.ones(shape, dtype=bool)).axes
    light = board.light_beyond_corners().reshape(shape)
    fits = refine_saddles(
        image,
        pixels.reshape(-1, 2),
        axes.reshape(-1, 2, 2),
        light.ravel(),
        margin=board.margin_share,
        bits_from=board.margin_share,
    )
    refined, known = fits.pixels.reshape(pixels.shape), fits.valid.reshape(shape)
    return Grid(refined, known & ~misfits(refined, known, share=_MISFIT_SHARE))


def _rough_corners(image: GreyImage, grid: tuple[int, int]) -> FloatArray | None:
    """Return the corners (N, 2) in the order in which OpenCV finds them, None without a board."""
    scale = min(1.0, _MAX_WIDTH_PX / image.shape[1])
    small = image
    if scale < 1.0:
        small = np.asarray(
            cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8
        )
    found, corners = cv2.findChessboardCornersSB(small, grid, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not found:
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = cv2.findChessboardCorners(small, grid, flags=flags)
    if not found:
        return None
    # The centre of the top-left pixel is (0, 0) in both sizes.
    place: FloatArray = (np.asarray(corners, np.float64).reshape(-1, 2) + 0.5) / scale - 0.5
    return place


def _in_board_order(image: GreyImage, pixels: FloatArray, board: Board) -> FloatArray:
    """Turn the grid (rows, columns, 2) so that z points into the board and square 0 is dark."""
    along_x = pixels[:, -1].mean(axis=0) - pixels[:, 0].mean(axis=0)
    along_y = pixels[-1].mean(axis=0) - pixels[0].mean(axis=0)
    if along_x[0] * along_y[1] - along_x[1] * along_y[0] < 0.0:
        pixels = pixels[:, ::-1]
    half_turn = pixels[::-1, ::-1]
    if sum(board.squares) % 2:
        return pixels if _fits_pattern(image, pixels, board) else half_turn
    return pixels if pixels[0, 0].sum() <= half_turn[0, 0].sum() else half_turn


def _fits_pattern(image: GreyImage, pixels: FloatArray, board: Board) -> bool:
    """Whether the squares between the corners are light where the board's are."""
    centres = 0.25 * (pixels[1:, 1:] + pixels[:-1, 1:] + pixels[1:, :-1] + pixels[:-1, :-1])
    x, y = np.rint(centres).astype(np.int64).reshape(-1, 2).T
    height, width = image.shape
    tone = image[y.clip(0, height - 1), x.clip(0, width - 1)].reshape(centres.shape[:2])
    light = board.light_beyond_corners().reshape(pixels.shape[:2])[:-1, :-1]
    return bool(tone[light].mean() > tone[~light].mean())
