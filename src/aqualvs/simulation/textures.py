"""Textures: printed panels, and periodic noise tiles for natural surfaces.

The texture of a panel (board, wall with markers, mottled ground) is a grid of equal square cells of
one albedo each, so that every printed edge lies on an edge of the grid: the mean over an area is
exact, and no raster adds jagged edges of its own.

Kernels look noise up in periodic tiles instead of computing it for every ray (`noise_tiles`).
"""

from dataclasses import dataclass, field
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.compiled import inline_borrowing_kernel

TILE_SIZE = 512
_MASK = TILE_SIZE - 1
_WHITE_MASK = 255


class Tiles(NamedTuple):
    """Tiles of noise that repeat seamlessly."""

    # Shape (512, 512): fractal noise whose values are uniform in [0, 1): a threshold of f covers a
    # fraction f.
    smooth: NDArray[np.float32]
    # Shape (512, 512): bright network on dark ground, mean 1: light focused by waves.
    ridges: NDArray[np.float32]
    white: NDArray[np.float32]  # Shape (256, 256): independent uniform values.


@cache
def noise_tiles() -> Tiles:
    """Return the tiles; the same in every process, because their seed is fixed."""
    rng = np.random.default_rng(532)
    smooth = _uniform(_fractal(rng, exponent=1.25, low=2.0))
    waves = _uniform(_fractal(rng, exponent=3.0, low=6.0))
    ridges = 1.0 / (0.07 + np.abs(waves - 0.5))
    white = rng.random((_WHITE_MASK + 1, _WHITE_MASK + 1))
    return Tiles(
        smooth.astype(np.float32),
        (ridges / ridges.mean()).astype(np.float32),
        white.astype(np.float32),
    )


def _fractal(rng: np.random.Generator, exponent: float, low: float) -> NDArray[np.float64]:
    """Return Gaussian noise with amplitude 1/f^exponent above `low` cycles a tile."""
    f = np.fft.fftfreq(TILE_SIZE) * TILE_SIZE
    radius = np.hypot(f[:, None], f[None, :])
    spectrum = np.fft.fft2(rng.standard_normal((TILE_SIZE, TILE_SIZE)))
    shaped = np.fft.ifft2(spectrum / np.maximum(radius, low) ** exponent).real
    return np.asarray(shaped, dtype=np.float64)


def _uniform(field: NDArray[np.float64]) -> NDArray[np.float64]:
    """Replace values by their rank, which makes them uniform in [0, 1)."""
    ranks = np.empty(field.size)
    ranks[np.argsort(field, axis=None)] = np.arange(field.size)
    return ranks.reshape(field.shape) / field.size


@inline_borrowing_kernel
def sample(tile: NDArray[np.float32], x: float, y: float) -> float:
    """Return the bilinear value of a periodic 512-square tile at (x, y) in texels."""
    fx, fy = np.floor(x), np.floor(y)
    i, j = int(fx) & _MASK, int(fy) & _MASK
    i1, j1 = (i + 1) & _MASK, (j + 1) & _MASK
    ax, ay = x - fx, y - fy
    top = tile[j, i] * (1.0 - ax) + tile[j, i1] * ax
    bottom = tile[j1, i] * (1.0 - ax) + tile[j1, i1] * ax
    return float(top * (1.0 - ay) + bottom * ay)


@inline_borrowing_kernel
def white_at(white: NDArray[np.float32], i: int, j: int) -> float:
    """Return the uniform value that belongs to a pair of whole numbers."""
    return float(white[i & _WHITE_MASK, j & _WHITE_MASK])


PAPER, INK = 0.82, 0.05
"""Albedo of white paper and of black ink."""

# Cells of a marker's black frame, each side.
_FRAME = 1
_EXACT = 1e-6


@dataclass(frozen=True, slots=True)
class Texture:
    """A grid of square cells."""

    albedo: FloatArray  # Shape (rows, columns): diffuse reflectance; rows go down, as in an image.
    cell: float  # Side of a cell, in metres.

    @property
    def size(self) -> tuple[float, float]:
        """Width and height, in metres."""
        rows, columns = self.albedo.shape
        return columns * self.cell, rows * self.cell


@dataclass(frozen=True, slots=True, kw_only=True)
class CharucoPrint:
    """Printed ChArUco board (OpenCV's current pattern)."""

    squares: tuple[int, int]  # Number of squares along x and y.
    # Side of a square and of a marker, width of the light border, in metres.
    square: float
    marker: float
    border: float
    dictionary: str  # OpenCV's name of the markers' dictionary.


@dataclass(frozen=True, slots=True, kw_only=True)
class MarkerPrint:
    """Markers on one flat sheet, in cells of a texture."""

    dictionary: str  # OpenCV's name of their dictionary.
    ids: IntArray  # Shape (M,): number of each in the dictionary.
    # Shape (M, 2): column and row of each one's top-left corner, in cells.
    corners: IntArray = field(repr=False)
    side: int  # Cells along a marker's side; a multiple of its bits and its frame together.
    ring: int  # Cells of white paper around each.


def charuco_texture(board: CharucoPrint) -> Texture:
    """Return a ChArUco board with its border.

    Raises `OptionError` if square, marker and border are not whole numbers of the markers' cells,
    or the dictionary has too few markers.
    """
    book = _dictionary(board.dictionary)
    cell = board.marker / (book.markerSize + 2 * _FRAME)
    side, margin, border = (
        _whole(length, cell, what)
        for length, what in (
            (board.square, "square"),
            (0.5 * (board.square - board.marker), "margin around a marker"),
            (board.border, "border"),
        )
    )
    n_x, n_y = board.squares
    if margin < 1 or n_x * n_y // 2 > len(book.bytesList):
        raise OptionError(
            f"a board of {n_x} x {n_y} squares with {board.dictionary}: too many markers for the "
            "dictionary or for their squares; take fewer or smaller ones"
        )
    pattern = cv2.aruco.CharucoBoard(board.squares, board.square, board.marker, book)
    white = pattern.generateImage((n_x * side, n_y * side), marginSize=0) > 127
    return Texture(np.where(np.pad(white, border, constant_values=True), PAPER, INK), cell)


def marker_texture(ground: FloatArray, cell: float, prints: MarkerPrint) -> Texture:
    """Return a ground with markers on it, each in a ring of white paper.

    `ground`, shape (rows, columns): albedo under the markers; not changed. `cell`: side of a cell,
    in metres. Raises `OptionError` if a marker's side is no multiple of its cells, or it does not
    lie on the ground.
    """
    book = _dictionary(prints.dictionary)
    n_cells = book.markerSize + 2 * _FRAME
    if prints.side % n_cells:
        raise OptionError(f"a marker of {prints.side} cells; take a multiple of {n_cells}")
    albedo = ground.copy()
    reach = prints.side + prints.ring
    for number, (column, row) in zip(prints.ids, prints.corners, strict=True):
        top, left = row - prints.ring, column - prints.ring
        if min(top, left) < 0 or row + reach > len(albedo) or column + reach > albedo.shape[1]:
            raise OptionError(f"marker {number} at cell ({column}, {row}) is off its panel")
        albedo[top : row + reach, left : column + reach] = PAPER
        white = book.generateImageMarker(int(number), prints.side, borderBits=_FRAME) > 127
        albedo[row : row + prints.side, column : column + prints.side] = np.where(white, PAPER, INK)
    return Texture(albedo, cell)


def mottled(
    shape: tuple[int, int], albedo: float, contrast: float, *, scale: float = 1.0, shift: int = 0
) -> FloatArray:
    """Return the albedo (rows, columns) of an uneven ground, such as concrete or plywood.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    albedo : float
        Mean.
    contrast : float
        Half the spread over the mean.
    scale : float
        Cells over which a texel of the noise is stretched.
    shift : int
        Offset in the noise, so that panels differ.
    """
    tile = noise_tiles().smooth
    rows, columns = (((np.arange(n) / scale).astype(int) + shift) % len(tile) for n in shape)
    noise = tile[np.ix_(rows, columns)].astype(np.float64)
    return np.asarray(albedo * (1.0 + contrast * (2.0 * noise - 1.0)))


def grid_corners(columns: ArrayLike, rows: ArrayLike) -> IntArray:
    """Return the cells (M, 2), column and row, of a grid of markers, row by row."""
    c, r = np.meshgrid(np.asarray(columns, np.int64), np.asarray(rows, np.int64))
    return np.stack([c.ravel(), r.ravel()], axis=-1)


def _dictionary(name: str) -> cv2.aruco.Dictionary:
    number = getattr(cv2.aruco, name.replace("h", "H"), None)
    if number is None or not name.startswith("DICT_"):
        raise OptionError(f"dictionary {name!r} is unknown; take one of OpenCV's, DICT_4X4_250 say")
    return cv2.aruco.getPredefinedDictionary(number)


def _whole(length: float, cell: float, what: str) -> int:
    count = round(length / cell)
    if abs(count * cell - length) > _EXACT * cell:
        raise OptionError(
            f"{what} is {1e3 * length:g} mm, no multiple of a marker's cell of {1e3 * cell:g} mm"
        )
    return count
