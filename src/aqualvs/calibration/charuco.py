"""Find a ChArUco board: a few markers say where it is, then corner leads to corner.

Reading a marker is slow, and near the picture's border or under a laser stripe many cannot be
read. So markers are read in the middle of the picture first, and only until enough of them agree;
all other corners are found from their neighbours and borne out by the picture.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from aqualvs.calibration.corner_grid import Grid, misfits, nothing_known, predict
from aqualvs.calibration.markers import Markers, read_markers
from aqualvs.calibration.saddle_corners import GreyImage, SaddleFit, refine_saddles
from aqualvs.calibration.targets import Board, aruco_dictionary
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray

# Parts of the picture, about its centre, in which markers are looked for in turn.
_CROPS = (0.25, 0.5, 1.0)
# Pairs of markers that agree, enough to find the other corners from.
_ENOUGH_AGREED = 8
# Window of the local threshold for a quick look at a part, as a share of the picture's width.
_QUICK_WINDOW = 0.01
# Markers so many squares apart must agree on how they lie, to this share of their distance: blur
# makes them look a seventh too small, and on a tilted board squares grow. One square off, as on a
# board of other make, is a third or more.
_NEIGHBOUR_SQUARES = 3
_AGREEMENT = 0.25
# A marker supports the grid whose corner it sees this near, in sides, and contradicts it from so
# far; most must support it, and but a few, which were misread, may contradict it.
_SUPPORT = 0.25
_SUPPORTED_SHARE = 0.6
_CONTRADICTION = 0.5
_CONTRADICTED_SHARE = 0.05
# A corner that the picture did not bear out is tried again when more neighbours are known.
_MAX_TRIES = 3
_MISFIT_SHARE = 0.12


@dataclass(frozen=True, slots=True)
class Seeds:
    """Corners that markers agree on.

    Attributes
    ----------
    corners : int array, shape (K,)
        Which inner corners of the board.
    pixels : array, shape (K, 2)
        About where they are, in `image`.
    axes : array, shape (K, 2, 2)
        A square's sides along the board's x and y there, as columns, in pixels.
    n_agreed : int
        How many pairs of markers agree across rows.
    """

    corners: IntArray
    pixels: FloatArray
    axes: FloatArray
    n_agreed: int


def find_charuco(image: GreyImage, board: Board) -> Grid:
    """Find the corners of a ChArUco board.

    Returns
    -------
    Grid
        Nothing known where no two markers agree on a corner.
    """
    quick_px = 2 * max(round(0.5 * _QUICK_WINDOW * image.shape[1]), 1) + 1
    for part, offset in _parts(image):
        window_px = None if part.shape == image.shape else quick_px
        found = read_markers(part, board.dictionary, n_first=board.n_markers, window_px=window_px)
        markers = Markers(found.ids, found.corners + offset)
        seeds = agreed_corners(markers, board)
        if seeds.n_agreed >= _ENOUGH_AGREED:
            break
    grid = _grow(image, board, seeds)
    return grid if _supported(grid, markers, board) else nothing_known(board)


def _parts(image: GreyImage) -> Iterator[tuple[GreyImage, FloatArray]]:
    height, width = image.shape
    for share in _CROPS:
        x, y = round(0.5 * (1.0 - share) * width), round(0.5 * (1.0 - share) * height)
        part = np.ascontiguousarray(image[y : height - y, x : width - x])
        yield part, np.array([x, y], dtype=np.float64)


def _by_markers(markers: Markers, board: Board) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return what each marker says of the corners of its square, by its own homography.

    Returns
    -------
    places : int array, shape (K, 4, 2)
        Column and row of the square's corners in the grid; outside it at the board's edge.
    pixels : array, shape (K, 4, 2)
        Where they should be.
    axes : array, shape (K, 2, 2)
        The square's sides along the board's x and y, as columns, in pixels.
    """
    squares = board.marker_squares()
    near, far = board.margin_share, 1.0 - board.margin_share
    inside = np.array([[near, near], [far, near], [far, far], [near, far]], np.float32)
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.int64)
    ours = np.flatnonzero(markers.ids < len(squares))
    places = squares[markers.ids[ours]][:, None, :] - 1 + unit
    pixels = np.empty((len(ours), 4, 2))
    for k, i in enumerate(ours):
        homography = cv2.getPerspectiveTransform(inside, markers.corners[i].astype(np.float32))
        pixels[k] = cv2.perspectiveTransform(unit[None].astype(np.float32), homography)[0]
    along_x = 0.5 * (pixels[:, 1] - pixels[:, 0] + pixels[:, 2] - pixels[:, 3])
    along_y = 0.5 * (pixels[:, 3] - pixels[:, 0] + pixels[:, 2] - pixels[:, 1])
    return places, pixels, np.stack([along_x, along_y], axis=-1)


def agreed_corners(markers: Markers, board: Board) -> Seeds:
    """Return the corners of those markers that agree with their neighbours.

    Markers whose squares are near each other on the board must be as near in the picture. One that
    was read wrongly, or on a board of another make, contradicts more neighbours than it has
    friends.
    """
    n_x, n_y = board.corner_grid
    places, pixels, axes = _by_markers(markers, board)
    agree, disagree = _neighbours(places[:, 0], pixels.mean(axis=1), axes)
    trusted = np.count_nonzero(agree, axis=1) > np.count_nonzero(disagree, axis=1)
    inside = np.all((places >= 0) & (places < (n_x, n_y)), axis=-1)
    chosen = trusted[:, None] & inside
    seeds, first = np.unique((places[..., 0] + n_x * places[..., 1])[chosen], return_index=True)
    # Markers of one row agree on a board of any width.
    across = agree & (places[:, None, 0, 1] != places[None, :, 0, 1])
    across &= trusted[:, None] & trusted[None, :]
    return Seeds(
        seeds,
        pixels[chosen][first],
        np.broadcast_to(axes[:, None], (*inside.shape, 2, 2))[chosen][first],
        int(np.count_nonzero(across)) // 2,
    )


def _neighbours(
    squares: IntArray, centres: FloatArray, axes: FloatArray
) -> tuple[BoolArray, BoolArray]:
    """Return which pairs (K, K) of near markers agree on how they lie, and which do not."""
    step = squares[None, :] - squares[:, None]
    distance = np.max(np.abs(step), axis=-1)
    near = distance <= _NEIGHBOUR_SQUARES
    np.fill_diagonal(near, val=False)
    mean_axes = 0.5 * (axes[None, :] + axes[:, None])
    expected = np.einsum("ijkl,ijl->ijk", mean_axes, step.astype(np.float64))
    off = np.linalg.norm(centres[None, :] - centres[:, None] - expected, axis=-1)
    side = np.sqrt(np.abs(np.linalg.det(mean_axes)))
    agree: BoolArray = near & (off < _AGREEMENT * side * distance)
    return agree, near & ~agree


def _grow(image: GreyImage, board: Board, seeds: Seeds) -> Grid:
    """Refine the seeds, then go from known corners to their neighbours until none is new."""
    shape = board.corner_grid[::-1]
    pixels, known = np.zeros((*shape, 2)), np.zeros(shape, dtype=bool)
    tries = np.zeros(shape, dtype=np.int64)
    light = board.light_beyond_corners()
    fits = _refine(image, board, seeds.pixels, seeds.axes, light[seeds.corners])
    pixels.reshape(-1, 2)[seeds.corners] = fits.pixels
    known.reshape(-1)[seeds.corners] = fits.valid
    known &= ~misfits(pixels, known, share=_MISFIT_SHARE)
    while True:
        expected = predict(pixels, known)
        new = ~known & expected.valid & (tries < _MAX_TRIES) & _inside(expected.pixels, image)
        if not np.any(new):
            break
        tries[new] += 1
        fits = _refine(
            image, board, expected.pixels[new], expected.axes[new], light.reshape(shape)[new]
        )
        pixels[new], known[new] = fits.pixels, fits.valid
        known &= ~misfits(pixels, known, share=_MISFIT_SHARE)
    return Grid(pixels, known)


def _supported(grid: Grid, markers: Markers, board: Board) -> bool:
    """Whether most markers that were read lie where the grid has them, or would have them.

    On a board of another make, with other counts of squares say, some rows agree by chance.
    """
    n_x, n_y = board.corner_grid
    places, pixels, axes = _by_markers(markers, board)
    inside = np.all((places >= 0) & (places < (n_x, n_y)), axis=-1)
    column, row = np.moveaxis(places.clip(0, (n_x - 1, n_y - 1)), -1, 0)
    expected = np.where(grid.known[..., None], grid.pixels, predict(grid.pixels, grid.known).pixels)
    # NaN, where nothing is expected, is neither near nor far.
    apart = np.linalg.norm(expected[row, column] - pixels, axis=-1)
    share = apart / np.sqrt(np.abs(np.linalg.det(axes)))[:, None]
    supporting = inside & grid.known[row, column] & (share < _SUPPORT)
    contradicting = inside & (share > _CONTRADICTION)
    n_for, n_against = (
        int(np.count_nonzero(np.any(which, axis=1))) for which in (supporting, contradicting)
    )
    n = len(places)
    return n_for >= _SUPPORTED_SHARE * n and n_against <= max(1.0, _CONTRADICTED_SHARE * n)


def _refine(
    image: GreyImage, board: Board, starts: FloatArray, axes: FloatArray, light: BoolArray
) -> SaddleFit:
    # The first cell of a marker is its dark border; its bits follow.
    cell = board.marker / board.square / (aruco_dictionary(board.dictionary).markerSize + 2)
    return refine_saddles(
        image,
        starts,
        axes,
        light,
        margin=board.margin_share,
        bits_from=board.margin_share + cell,
    )


def _inside(pixels: FloatArray, image: GreyImage) -> BoolArray:
    height, width = image.shape
    inside: BoolArray = np.all((pixels >= 0.0) & (pixels <= (width - 1, height - 1)), axis=-1)
    return inside
