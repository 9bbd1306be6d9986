"""Find a plain chessboard, all of it, and put its corners in the board's order.

OpenCV's finders say roughly where the corners are. What they find may be a wrong grid, one row off
onto the paper's border for example; every grid is tested on the picture, and other finders are
tried until one stands the test.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from aqualvs.calibration.corner_grid import Grid, misfits, nothing_known, predict
from aqualvs.calibration.saddle_corners import GreyImage, refine_saddles
from aqualvs.calibration.targets import Board
from aqualvs.geometry.arrays import BoolArray, FloatArray

# OpenCV's finders look at every pixel; above this size a smaller picture finds the same board.
_MAX_WIDTH_PX = 1400
_MISFIT_SHARE = 0.12
# Share of the corners that the picture must bear out, so that no other finder is asked.
_ENOUGH = 0.8

_Finder = Callable[[GreyImage, tuple[int, int]], tuple[bool, cv2.typing.MatLike]]


def _sectors(flags: int) -> _Finder:
    return lambda image, grid: cv2.findChessboardCornersSB(image, grid, flags=flags)


def _quads(flags: int) -> _Finder:
    return lambda image, grid: cv2.findChessboardCorners(image, grid, flags=flags)


# In the order in which they are tried; the first is the best, and the fastest.
_FINDERS: tuple[tuple[str, _Finder], ...] = (
    ("findChessboardCornersSB", _sectors(cv2.CALIB_CB_NORMALIZE_IMAGE)),
    (
        "findChessboardCorners",
        _quads(cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE),
    ),
    (
        "findChessboardCornersSB, exhaustive",
        _sectors(cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE),
    ),
    ("findChessboardCorners, global threshold", _quads(0)),
)


@dataclass(frozen=True, slots=True)
class _Attempt:
    """A grid as the picture bears it out; `first_is_light` as it lies in the picture."""

    grid: Grid
    first_is_light: bool

    @property
    def n_known(self) -> int:
        return int(np.count_nonzero(self.grid.known))


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
    Such a board exists in two prints, with a dark or with a light first square; both are taken,
    and the grid's notes say so.
    """
    best, used = _Attempt(nothing_known(board), first_is_light=False), ""
    for name, rough in _rough_grids(image, board.corner_grid):
        found = _borne_out(image, rough)
        if found.n_known > best.n_known:
            best, used = found, name
        if best.n_known >= _ENOUGH * board.n_corners:
            break
    if not best.n_known:
        return nothing_known(board)
    grid, first_is_light = _in_board_order(best)
    notes = []
    if used != _FINDERS[0][0]:
        notes.append(f"board found at a later try (OpenCV's {used})")
    if first_is_light:
        notes.append(_other_print(board))
    return Grid(grid.pixels, grid.known, tuple(notes))


def _other_print(board: Board) -> str:
    n_x, n_y = board.corner_grid
    return (
        f"the first square of the print is light, as on a board of {n_y} x {n_x} inner corners; "
        f"taken as the same board, with x along the {n_x}"
    )


def _rough_grids(image: GreyImage, grid: tuple[int, int]) -> Iterator[tuple[str, FloatArray]]:
    """Yield corners (rows, columns, 2) as OpenCV's finders have them, each with its name."""
    scale = min(1.0, _MAX_WIDTH_PX / image.shape[1])
    small = image
    if scale < 1.0:
        small = np.asarray(
            cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8
        )
    for name, find in _FINDERS:
        found, corners = find(small, grid)
        if found:
            # The centre of the top-left pixel is (0, 0) in both sizes.
            pixels = (np.asarray(corners, np.float64).reshape(-1, 2) + 0.5) / scale - 0.5
            yield name, _right_handed(pixels.reshape(grid[1], grid[0], 2))


def _right_handed(pixels: FloatArray) -> FloatArray:
    """Mirror the grid, if need be, so that z points into the board."""
    along_x = pixels[:, -1].mean(axis=0) - pixels[:, 0].mean(axis=0)
    along_y = pixels[-1].mean(axis=0) - pixels[0].mean(axis=0)
    mirrored = along_x[0] * along_y[1] - along_x[1] * along_y[0] < 0.0
    return pixels[:, ::-1] if mirrored else pixels


def _borne_out(image: GreyImage, rough: FloatArray) -> _Attempt:
    """Refine a grid and the ring of corners around it, and shift it to where most are."""
    rows, columns = rough.shape[:2]
    pixels = np.pad(rough, ((1, 1), (1, 1), (0, 0)))
    known = np.pad(np.ones((rows, columns), dtype=bool), 1)
    first_is_light = _diagonal_is_light(image, rough)
    light = (np.indices(known.shape).sum(axis=0) % 2 == 1) != first_is_light
    seen = np.zeros_like(known)
    # The second time from neighbours that were seen, not from where the finder has them.
    for first in (True, False):
        expected = predict(pixels, known if first else seen)
        starts = np.where((known & first)[..., None], pixels, expected.pixels)
        tried = ~seen & expected.valid & _inside(starts, image)
        fits = refine_saddles(
            image, starts[tried], expected.axes[tried], light[tried], margin=1.0, bits_from=1.0
        )
        pixels[tried], seen[tried] = fits.pixels, fits.valid
        seen &= ~misfits(pixels, seen, share=_MISFIT_SHARE)
    # The middle first: it stays where the others are no better.
    shifts = sorted(np.ndindex(3, 3), key=lambda s: abs(s[0] - 1) + abs(s[1] - 1))
    dy, dx = max(shifts, key=lambda s: np.count_nonzero(seen[s[0] :, s[1] :][:rows, :columns]))
    window = np.s_[dy : dy + rows, dx : dx + columns]
    grid = Grid(pixels[window], seen[window])
    return _Attempt(grid, first_is_light != bool((dy + dx) % 2))


def _diagonal_is_light(image: GreyImage, pixels: FloatArray) -> bool:
    """Whether the squares with an even sum of row and column are light, that of (0, 0) included."""
    centres = 0.25 * (pixels[1:, 1:] + pixels[:-1, 1:] + pixels[1:, :-1] + pixels[:-1, :-1])
    x, y = np.rint(centres).astype(np.int64).reshape(-1, 2).T
    height, width = image.shape
    tone = image[y.clip(0, height - 1), x.clip(0, width - 1)].reshape(centres.shape[:2])
    even = np.indices(tone.shape).sum(axis=0) % 2 == 0
    return bool(tone[even].mean() > tone[~even].mean())


def _in_board_order(found: _Attempt) -> tuple[Grid, bool]:
    """Turn a grid so that the first square is dark, and say whether it is light all the same."""
    pixels, known = found.grid.pixels, found.grid.known
    rows, columns = known.shape
    # Over which number of squares the first one moves in each quarter turn.
    over = {0: 0, 2: rows + columns}
    if rows == columns:
        over |= {1: columns, 3: rows}
    light = {turn: found.first_is_light != bool(n % 2) for turn, n in over.items()}
    dark = [turn for turn, is_light in light.items() if not is_light]
    best = min(dark or light, key=lambda turn: float(np.rot90(pixels, turn)[0, 0].sum()))
    return Grid(np.rot90(pixels, best), np.rot90(known, best)), not dark


def _inside(pixels: FloatArray, image: GreyImage) -> BoolArray:
    height, width = image.shape
    # NaN, where nothing is predicted, compares false.
    inside: BoolArray = np.all((pixels >= 0.0) & (pixels <= (width - 1, height - 1)), axis=-1)
    return inside
