"""Detection of ChArUco boards and chessboards: inner corners, each found with its neighbours' help.

ChArUco boards: reading a marker is slow, and near the picture's border or under a laser stripe many
markers cannot be read. Markers are therefore read with OpenCV (number and rough corners) in the
middle of the picture first, and only until enough of them agree. All other corners are predicted
from their neighbours by an affine map and confirmed in the picture.

Chessboards: OpenCV's finders give rough corners. Their grid may be wrong, for example one row off
onto the paper's border. Every grid is tested on the picture, and further finders are tried until
one passes the test; the corners are then put in the board's order. The whole board must be seen.

Both refine corners with `saddle_corners` and reject those that their neighbours contradict.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from aqualvs.calibration.detection.saddle_corners import GreyImage, SaddleFit, refine_saddles
from aqualvs.calibration.targets.targets import Board, aruco_dictionary
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Markers:
    """Markers as read by OpenCV, not refined."""

    ids: IntArray  # Shape (M,): numbers in the dictionary.
    corners: FloatArray  # Shape (M, 4, 2): in `image`, in OpenCV's order.

    def __len__(self) -> int:
        """Return the number of markers."""
        return len(self.ids)


def read_markers(
    image: GreyImage, dictionary: str, *, n_first: int | None = None, window_px: int | None = None
) -> Markers:
    """Read markers in a picture, by contour, to about half a pixel.

    Parameters
    ----------
    image : uint8 array, shape (height, width)
        Grey picture.
    n_first : int or None
        Read only the first `n_first` markers of the dictionary, which is faster.
    window_px : int or None
        Odd width of the only local threshold; None tries several.
    """
    parameters = cv2.aruco.DetectorParameters()
    # Widest window of the local threshold, as a share of the picture's width.
    widest_window = 0.03
    if window_px is not None:
        parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax = window_px
    else:
        widest = widest_window * image.shape[1]
        parameters.adaptiveThreshWinSizeMax = max(parameters.adaptiveThreshWinSizeMax, int(widest))
    markers = aruco_dictionary(dictionary)
    if n_first is not None:
        markers = cv2.aruco.Dictionary(
            markers.bytesList[:n_first], markers.markerSize, markers.maxCorrectionBits
        )
    corners, ids, _ = cv2.aruco.ArucoDetector(markers, parameters).detectMarkers(image)
    if ids is None or len(ids) == 0:
        return Markers(np.zeros(0, np.int64), np.zeros((0, 4, 2)))
    return Markers(
        np.asarray(ids, np.int64).ravel(), np.asarray(corners, np.float64).reshape(-1, 4, 2)
    )


@dataclass(frozen=True, slots=True)
class CornerGrid:
    """Corners of a board in one picture."""

    pixels: FloatArray  # Shape (rows, columns, 2): in `image`.
    known: BoolArray  # Shape (rows, columns): True for corners that were found.
    notes: tuple[str, ...] = ()  # Remarks for the user on the detection.

    @property
    def n_known(self) -> int:
        """Number of corners that were found."""
        return int(np.count_nonzero(self.known))


@dataclass(frozen=True, slots=True)
class PredictedCorners:
    """Places of the grid points as predicted from their neighbours."""

    pixels: FloatArray  # Shape (rows, columns, 2): in `image`; NaN where not valid.
    # Shape (rows, columns, 2, 2): side of a square along the board's x (`[..., 0]`) and y (`[...,
    # 1]`), in pixels.
    axes: FloatArray
    # Shape (rows, columns): False where too few neighbours are known, or all on one line.
    valid: BoolArray


def nothing_known(board: Board) -> CornerGrid:
    """Return the grid of a board without any corner found."""
    shape = board.corner_grid[::-1]
    return CornerGrid(np.zeros((*shape, 2)), np.zeros(shape, dtype=bool))


def predict(pixels: FloatArray, known: BoolArray) -> PredictedCorners:
    """Fit an affine map to the known neighbours of every grid point, without the point itself.

    Parameters
    ----------
    pixels : array, shape (rows, columns, 2)
        Corners in `image`.
    known : bool array, shape (rows, columns)
        True for known corners; others are ignored, even if NaN.
    """
    rows, columns = known.shape
    # Greatest distance, in squares, of the neighbours that predict a corner.
    reach = 2
    weight = np.pad(known.astype(np.float64), reach)
    values = np.where(known, np.moveaxis(pixels, -1, 0), 0.0)
    values = np.pad(values, ((0, 0), (reach,) * 2, (reach,) * 2))
    # The grid is the last two axes of all sums, which makes them ten times as fast.
    normal, right = np.zeros((3, 3, rows, columns)), np.zeros((3, 2, rows, columns))
    count = np.zeros((rows, columns), dtype=np.int64)
    # Nearer neighbours get more weight, because the map is affine only locally.
    fall = 0.7
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            if dx == dy == 0:
                continue
            here = np.s_[..., reach + dy : reach + dy + rows, reach + dx : reach + dx + columns]
            basis = np.array([1.0, dx, dy])
            share = weight[here] * np.exp(-fall * (dx * dx + dy * dy))
            normal += np.outer(basis, basis)[..., None, None] * share
            right += basis[:, None, None, None] * (share * values[here])
            count += weight[here] > 0.0
    normal, right = (np.moveaxis(sums, (0, 1), (-2, -1)) for sums in (normal, right))
    # An affine map needs three neighbours; a fourth guards it.
    min_neighbours = 4
    # They must span a plane.
    mass = np.maximum(normal[..., 0, 0], 1e-12)
    mean = normal[..., 0, 1:] / mass[..., None]
    spread = normal[..., 1:, 1:] / mass[..., None, None]
    spread = spread - mean[..., :, None] * mean[..., None, :]
    valid = (count >= min_neighbours) & (np.linalg.det(spread) > 1e-2)
    safe = np.where(valid[..., None, None], normal, np.eye(3))
    solution = np.linalg.solve(safe, right)
    found = np.where(valid[..., None], solution[..., 0, :], np.nan)
    axes = np.swapaxes(solution[..., 1:, :], -1, -2)
    return PredictedCorners(found, axes, valid)


def misfits(
    pixels: FloatArray, known: BoolArray, expected: PredictedCorners, *, share: float
) -> BoolArray:
    """Return the mask of known points that contradict their neighbours.

    `expected` is what `predict` returns for them, `share` the allowed distance from the prediction,
    in sides of a square.
    """
    side = np.sqrt(np.min(np.sum(np.square(expected.axes), axis=-2), axis=-1))
    distance = np.linalg.norm(pixels - expected.pixels, axis=-1)
    odd: BoolArray = known & expected.valid & (distance > share * side)
    return odd


def _without_misfits(pixels: FloatArray, known: BoolArray) -> tuple[BoolArray, PredictedCorners]:
    """Return the known points that fit their neighbours, and what those points predict."""
    expected = predict(pixels, known)
    odd = misfits(pixels, known, expected, share=_MISFIT_SHARE)
    if odd.any():
        known = known & ~odd
        expected = predict(pixels, known)
    return known, expected


# OpenCV's finders look at every pixel; above this size a smaller picture finds the same board.
_MAX_WIDTH_PX = 1400
_MISFIT_SHARE = 0.12

_Finder = Callable[[GreyImage, tuple[int, int]], tuple[bool, cv2.typing.MatLike]]


def _in_even_light(image: GreyImage) -> GreyImage:
    """Divide by the mean around every pixel: lamps, shadows and flicker light a board unevenly."""
    # Width of the mean, as a share of the picture's, and the grey level that it becomes.
    around, level = 1.0 / 30.0, 110.0
    width = 2 * round(0.5 * around * image.shape[1]) + 1
    mean = cv2.boxFilter(image, cv2.CV_32F, (width, width), borderType=cv2.BORDER_REFLECT)
    return np.asarray(np.clip(level * (image + 1.0) / (mean + 1.0), 0.0, 255.0), np.uint8)


def _sectors(flags: int) -> _Finder:
    return lambda image, grid: cv2.findChessboardCornersSB(image, grid, flags=flags)


def _quads(flags: int) -> _Finder:
    return lambda image, grid: cv2.findChessboardCorners(image, grid, flags=flags)


# In the order of use; the first is the best and the fastest.
_FINDERS: tuple[tuple[str, _Finder], ...] = (
    ("findChessboardCornersSB", _sectors(cv2.CALIB_CB_NORMALIZE_IMAGE)),
    (
        "findChessboardCornersSB, in even light",
        lambda image, grid: cv2.findChessboardCornersSB(_in_even_light(image), grid),
    ),
    ("findChessboardCorners", _quads(cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE)),
    (
        "findChessboardCornersSB, exhaustive",
        _sectors(cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE),
    ),
    ("findChessboardCorners, global threshold", _quads(0)),
)


def find_chessboard(image: GreyImage, board: Board) -> CornerGrid:
    """Find the inner corners of a chessboard.

    Returns
    -------
    CornerGrid
        No corner known if the board is not seen whole. Corners that the picture does not
        confirm, under a laser stripe for example, are not known.

    Notes
    -----
    A board whose number of squares is even in both directions, or odd in both, looks the same
    when it is turned by half a turn: then the corner nearer to the picture's top left comes first.
    Such a board exists in two prints, with a dark or with a light first square; both are taken,
    and the grid's notes say so.
    """
    best, first_is_light, used = nothing_known(board), False, ""
    # Share of the corners that must be confirmed by the picture to stop trying finders.
    enough = 0.8
    for name, rough in _rough_grids(image, board.corner_grid):
        found, is_light = _borne_out(image, rough)
        if found.n_known > best.n_known:
            best, first_is_light, used = found, is_light, name
        if best.n_known >= enough * board.n_corners:
            break
    if not best.n_known:
        return best
    grid, first_is_light = _in_board_order(best, first_is_light=first_is_light)
    notes = []
    if used != _FINDERS[0][0]:
        notes.append(f"board found at a later try (OpenCV's {used})")
    if first_is_light:
        n_x, n_y = board.corner_grid
        notes.append(
            "the first square of the print is light, as on a board of "
            f"{n_y} x {n_x} inner corners; taken as the same board, with x along the {n_x}"
        )
    return replace(grid, notes=tuple(notes))


def _rough_grids(image: GreyImage, grid: tuple[int, int]) -> Iterator[tuple[str, FloatArray]]:
    """Yield corners (rows, columns, 2) found by each of OpenCV's finders, with its name."""
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
            pixels = pixels.reshape(grid[1], grid[0], 2)
            # Mirrored, if need be, so that z points into the board.
            along_x = pixels[:, -1].mean(axis=0) - pixels[:, 0].mean(axis=0)
            along_y = pixels[-1].mean(axis=0) - pixels[0].mean(axis=0)
            mirrored = along_x[0] * along_y[1] - along_x[1] * along_y[0] < 0.0
            yield name, pixels[:, ::-1] if mirrored else pixels


def _borne_out(image: GreyImage, rough: FloatArray) -> tuple[CornerGrid, bool]:
    """Refine a grid and the ring of corners around it; shift it to where most are confirmed.

    Return it with whether its first square, in the picture's orientation, is light.
    """
    rows, columns = rough.shape[:2]
    pixels = np.pad(rough, ((1, 1), (1, 1), (0, 0)))
    known = np.pad(np.ones((rows, columns), dtype=bool), 1)
    first_is_light = _diagonal_is_light(image, rough)
    light = (np.indices(known.shape).sum(axis=0) % 2 == 1) != first_is_light
    seen = np.zeros_like(known)
    # The second pass starts from neighbours that were seen, not from the finder's corners.
    for first in (True, False):
        expected = predict(pixels, known if first else seen)
        starts = np.where((known & first)[..., None], pixels, expected.pixels)
        tried = ~seen & expected.valid & _inside(starts, image)
        fits = refine_saddles(
            image, starts[tried], expected.axes[tried], light[tried], margin=1.0, bits_from=1.0
        )
        pixels[tried], seen[tried] = fits.pixels, fits.valid
        seen, _ = _without_misfits(pixels, seen)
    # The middle first: it wins ties.
    shifts = sorted(np.ndindex(3, 3), key=lambda s: abs(s[0] - 1) + abs(s[1] - 1))
    dy, dx = max(shifts, key=lambda s: np.count_nonzero(seen[s[0] :, s[1] :][:rows, :columns]))
    window = np.s_[dy : dy + rows, dx : dx + columns]
    return CornerGrid(pixels[window], seen[window]), first_is_light != bool((dy + dx) % 2)


def _diagonal_is_light(image: GreyImage, pixels: FloatArray) -> bool:
    """Return whether squares with an even sum of row and column, (0, 0) included, are light."""
    centres = 0.25 * (pixels[1:, 1:] + pixels[:-1, 1:] + pixels[1:, :-1] + pixels[:-1, :-1])
    x, y = np.rint(centres).astype(np.int64).reshape(-1, 2).T
    height, width = image.shape
    tone = image[y.clip(0, height - 1), x.clip(0, width - 1)].reshape(centres.shape[:2])
    even = np.indices(tone.shape).sum(axis=0) % 2 == 0
    return bool(tone[even].mean() > tone[~even].mean())


def _in_board_order(grid: CornerGrid, *, first_is_light: bool) -> tuple[CornerGrid, bool]:
    """Turn a grid so that the first square is dark; return whether it is light nevertheless."""
    pixels, known = grid.pixels, grid.known
    rows, columns = known.shape
    # Number of squares by which the first one moves in each quarter turn.
    over = {0: 0, 2: rows + columns}
    if rows == columns:
        over |= {1: columns, 3: rows}
    light = {turn: first_is_light != bool(n % 2) for turn, n in over.items()}
    dark = [turn for turn, is_light in light.items() if not is_light]
    best = min(dark or light, key=lambda turn: float(np.rot90(pixels, turn)[0, 0].sum()))
    return CornerGrid(np.rot90(pixels, best), np.rot90(known, best)), not dark


def _inside(pixels: FloatArray, image: GreyImage) -> BoolArray:
    height, width = image.shape
    # NaN, where nothing is predicted, compares false.
    inside: BoolArray = np.all((pixels >= 0.0) & (pixels <= (width - 1, height - 1)), axis=-1)
    return inside


@dataclass(frozen=True, slots=True)
class Seeds:
    """Corners on which neighbouring markers agree."""

    corners: IntArray  # Shape (K,): indices of inner corners of the board.
    pixels: FloatArray  # Shape (K, 2): their approximate places, in `image`.
    # Shape (K, 2, 2): sides of a square along the board's x and y there, as columns, in pixels.
    axes: FloatArray
    # Number of pairs of markers that agree across rows.
    n_agreed: int


def find_charuco(image: GreyImage, board: Board) -> CornerGrid:
    """Find the corners of a ChArUco board; none is known if no two markers agree on one."""
    # Window of the local threshold for a quick look at a part, as a share of the picture's width.
    quick_window = 0.01
    quick_px = 2 * max(round(0.5 * quick_window * image.shape[1]), 1) + 1
    # Number of agreeing pairs of markers that suffices to find the other corners.
    enough_agreed = 8
    for part, offset in _parts(image):
        window_px = None if part.shape == image.shape else quick_px
        found = read_markers(part, board.dictionary, n_first=board.n_markers, window_px=window_px)
        markers = Markers(found.ids, found.corners + offset)
        seeds = agreed_corners(markers, board)
        if seeds.n_agreed >= enough_agreed:
            break
    grid = _grow(image, board, seeds)
    return grid if _supported(grid, markers, board) else nothing_known(board)


def _parts(image: GreyImage) -> Iterator[tuple[GreyImage, FloatArray]]:
    height, width = image.shape
    # Parts of the picture, about its centre, that are searched for markers in turn.
    crops = (0.25, 0.5, 1.0)
    for share in crops:
        x, y = round(0.5 * (1.0 - share) * width), round(0.5 * (1.0 - share) * height)
        part = np.ascontiguousarray(image[y : height - y, x : width - x])
        yield part, np.array([x, y], dtype=np.float64)


def _by_markers(markers: Markers, board: Board) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return the corners of each marker's square, predicted by the marker's own homography.

    They are column and row (K, 4, 2) of the corners in the grid, outside it at the board's edge,
    the predicted pixels (K, 4, 2), and the sides (K, 2, 2) of the square along the board's x and y,
    as columns, in pixels.
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
    """Return the corners of markers that agree with their neighbours.

    Markers whose squares are near each other on the board must be as near in the picture. A marker
    that was misread, or is on a board of another pattern, contradicts more neighbours than it
    agrees with.
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
    """Return the masks (K, K) of near markers that agree on their offset, and that do not."""
    step = squares[None, :] - squares[:, None]
    distance = np.max(np.abs(step), axis=-1)
    # Markers up to this many squares apart must agree on their offset, to this share of their
    # distance: blur makes them look a seventh too small, and on a tilted board squares grow. An
    # error of one square, as on a board of another pattern, is a third or more.
    neighbour_squares = 3
    agreement = 0.25
    near = distance <= neighbour_squares
    np.fill_diagonal(near, val=False)
    mean_axes = 0.5 * (axes[None, :] + axes[:, None])
    expected = np.einsum("ijkl,ijl->ijk", mean_axes, step.astype(np.float64))
    off = np.linalg.norm(centres[None, :] - centres[:, None] - expected, axis=-1)
    side = np.sqrt(np.abs(np.linalg.det(mean_axes)))
    agree: BoolArray = near & (off < agreement * side * distance)
    return agree, near & ~agree


def _grow(image: GreyImage, board: Board, seeds: Seeds) -> CornerGrid:
    """Refine the seeds, then proceed from known corners to neighbours until none is new."""
    shape = board.corner_grid[::-1]
    pixels, known = np.zeros((*shape, 2)), np.zeros(shape, dtype=bool)
    tries = np.zeros(shape, dtype=np.int64)
    light = board.light_beyond_corners()
    fits = _refine(image, board, seeds.pixels, seeds.axes, light[seeds.corners])
    pixels.reshape(-1, 2)[seeds.corners] = fits.pixels
    known.reshape(-1)[seeds.corners] = fits.valid
    known, expected = _without_misfits(pixels, known)
    # A corner that the picture did not confirm is tried again when more neighbours are known.
    max_tries = 3
    while True:
        new = ~known & expected.valid & (tries < max_tries) & _inside(expected.pixels, image)
        if not np.any(new):
            break
        tries[new] += 1
        fits = _refine(
            image, board, expected.pixels[new], expected.axes[new], light.reshape(shape)[new]
        )
        pixels[new], known[new] = fits.pixels, fits.valid
        known, expected = _without_misfits(pixels, known)
    return CornerGrid(pixels, known)


def _supported(grid: CornerGrid, markers: Markers, board: Board) -> bool:
    """Return whether most markers lie where the grid predicts them.

    On a board of another pattern, for example with other counts of squares, some rows agree by
    chance.
    """
    n_x, n_y = board.corner_grid
    places, pixels, axes = _by_markers(markers, board)
    inside = np.all((places >= 0) & (places < (n_x, n_y)), axis=-1)
    column, row = np.moveaxis(places.clip(0, (n_x - 1, n_y - 1)), -1, 0)
    expected = np.where(grid.known[..., None], grid.pixels, predict(grid.pixels, grid.known).pixels)
    # NaN, where nothing is expected, is neither near nor far.
    apart = np.linalg.norm(expected[row, column] - pixels, axis=-1)
    share = apart / np.sqrt(np.abs(np.linalg.det(axes)))[:, None]
    # A marker supports the grid if their corners are this near, in sides, and contradicts it beyond
    # the second distance. Most must support it; only misread ones may contradict it: a tenth of
    # those that are 14 pixels wide in a JPEG. Boards of other patterns have 0.45 and more.
    support = 0.25
    supported_share = 0.6
    contradiction = 0.5
    contradicted_share = 0.2
    supporting = inside & grid.known[row, column] & (share < support)
    contradicting = inside & (share > contradiction)
    n_for, n_against = (
        int(np.count_nonzero(np.any(which, axis=1))) for which in (supporting, contradicting)
    )
    n = len(places)
    return n_for >= supported_share * n and n_against <= max(1.0, contradicted_share * n)


def _refine(
    image: GreyImage, board: Board, starts: FloatArray, axes: FloatArray, light: BoolArray
) -> SaddleFit:
    # The first cell of a marker is its dark border; its bits follow.
    cell = board.marker / board.square / (aruco_dictionary(board.dictionary).markerSize + 2)
    return refine_saddles(
        image, starts, axes, light, margin=board.margin_share, bits_from=board.margin_share + cell
    )
