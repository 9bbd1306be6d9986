"""Which small things each part of the image can show, so that other rays need not try them."""

from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.optics.camera import Camera
from aqualvs.simulation.surfaces import Surfaces

# Side of a square part of the image, in pixels.
TILE = 32
# The outline of a sphere is sampled at points of a box around it; this covers what lies between.
_MARGIN_PX = 4.0
# A thing this far off, in metres, that cannot be projected anywhere is out of sight.
_NEAR = 0.2


class TileMembers(NamedTuple):
    """Rows of the tables that each tile can show, as one list with its starts.

    Attributes
    ----------
    n_columns : int
        Tiles beside each other.
    ellipsoids, bubbles : int arrays
        Rows, tile after tile.
    ellipsoid_start, bubble_start : int arrays, shape (n_tiles + 1,)
        Where each tile's part begins.
    """

    n_columns: int
    ellipsoids: IntArray
    ellipsoid_start: IntArray
    bubbles: IntArray
    bubble_start: IntArray


def tile_members(camera: Camera, size_px: tuple[int, int], surfaces: Surfaces) -> TileMembers:
    """List for every tile the ellipsoids and bubbles whose outline can reach it.

    A thing that can be projected in part only (near the dome, or at the edge of the lens model)
    is listed everywhere: the answer may be slow but is never wrong.
    """
    columns, rows = (-(-side // TILE) for side in size_px)
    e, b = surfaces.ellipsoids, surfaces.bubbles
    reach = [1.0 / np.linalg.norm(row[3:12].reshape(3, 3), axis=1).min() for row in e]
    ellipsoids = _lists(camera, e[:, :3], np.array(reach), columns, rows)
    bubbles = _lists(camera, b[:, :3], b[:, 3], columns, rows)
    return TileMembers(columns, *ellipsoids, *bubbles)


def _lists(
    camera: Camera, centres: FloatArray, radii: FloatArray, columns: int, rows: int
) -> tuple[IntArray, IntArray]:
    shown = np.zeros((rows, columns, len(centres)), dtype=np.bool_)
    for i, (centre, radius) in enumerate(zip(centres, radii, strict=True)):
        shown[..., i] = _tiles_of(camera, centre, float(radius), columns, rows)
    flat = shown.reshape(rows * columns, len(centres))
    start = np.concatenate([[0], np.cumsum(flat.sum(axis=1))]).astype(np.int64)
    return np.nonzero(flat)[1].astype(np.int64), start


def _tiles_of(
    camera: Camera, centre: FloatArray, radius: float, columns: int, rows: int
) -> BoolArray:
    """Mark the tiles under the box around a sphere."""
    steps = np.linspace(-1.0, 1.0, 3)
    grid = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    pixels, valid = camera.project(centre + radius * grid)
    marked = np.ones((rows, columns), dtype=np.bool_)
    if not valid.any() and np.linalg.norm(centre) > radius + _NEAR:
        return ~marked
    if not valid.all():
        return marked
    low, high = pixels.min(axis=0) - _MARGIN_PX, pixels.max(axis=0) + _MARGIN_PX
    x, y = np.arange(columns) * TILE, np.arange(rows) * TILE
    marked &= ((x + TILE > low[0]) & (x < high[0]))[None, :]
    marked &= ((y + TILE > low[1]) & (y < high[1]))[:, None]
    return marked
