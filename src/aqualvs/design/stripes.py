"""Information that a stripe gives on the plane of a wall ahead, for many sheets and ranges.

A wall square ahead is m·X = 1 with m = (0, 1/range, 0). The scanner fits m by least squares, each
point weighted by the effect of a pixel's error on m·X. A stripe contributes one matrix,
sum w X X', and for every error that its points share a vector, sum w X d(m·X)/d(error). Both add
up over lasers, so that any combination of sheets follows from the sums of its parts.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aqualvs.design.settings import Mount
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.optics.camera import Camera
from aqualvs.scanning.laser_bands import pixels_per_line

OWN_ERRORS = ("shift", "tilt", "laser_tilt_1", "laser_tilt_2", "laser_offset")
"""Errors that all points of one stripe share: in pixels, radians, metres.

The laser's tilts turn the sheet's normal towards the stripe and towards the beam.
"""

# Points and passes of the search for the ends of a stripe; nodes of the Gauss quadrature over it.
_N_SEARCH, _N_PASSES, _N_SUM = 33, 2, 24


@dataclass(frozen=True, slots=True)
class Stripes:
    """Sums over the visible parts of the stripes of K sheets on W walls."""

    # Shape (K, W): number of search lines that see the stripe, one point each; 0 if it is out of
    # the picture.
    lines: FloatArray
    # Shape (K, W): visible length on the wall, metres.
    length: FloatArray
    # Shape (K, W, 3, 3): sum w X X', each point weighted by its inverse variance for an error of 1
    # px.
    matrix: FloatArray
    # Shape (K, W, 5, 3): sum w X d(m·X)/d(error) for `OWN_ERRORS`.
    own: FloatArray
    # Shape (K, W, G, 3): the same for errors that all stripes share.
    common: FloatArray
    # Shapes (K, W, 3) and (K, 3): the stripe's line on the wall, in `dome`.
    centre: FloatArray
    along: FloatArray
    # Shape (K, W, 2): begin and end of the visible part along it, in metres; NaN if there is none.
    ends: FloatArray

    def take(self, rows: Sequence[int]) -> "Stripes":
        """Return the stripes of these indices."""
        picked = list(rows)
        return Stripes(*(getattr(self, name)[picked] for name in self.__dataclass_fields__))

    def joined(self, other: "Stripes") -> "Stripes":
        """Return these stripes followed by others."""
        names = self.__dataclass_fields__
        return Stripes(*(np.concatenate([getattr(s, n) for s in (self, other)]) for n in names))


def see_stripes(
    camera: Camera,
    mounts: Sequence[Mount],
    ranges: FloatArray,
    common: FloatArray,
    margin: float = 0.0,
) -> Stripes:
    """Return the sums over a camera's view of the stripes of K mounts on walls square ahead.

    `ranges`, shape (W,): metres. `common`, shape (P, G): G errors of the camera as steps of its
    parameters, see `parameter_names`. `margin`: width of the picture's ignored border, in pixels.
    """
    axes = [mount.axes for mount in mounts]
    along, beam = (np.array([one[i] for one in axes]).reshape(-1, 3) for i in (0, 2))
    position = np.array([mount.position for mount in mounts]).reshape(-1, 3)
    distance = (ranges[None, :] - position[:, 1, None]) / beam[:, 1, None]
    centre = position[:, None] + distance[..., None] * beam[:, None]
    reach = np.array([_reach(mount) for mount in mounts]).reshape(-1, 2)
    fan = np.where((distance > 0.0)[..., None], distance[..., None] * reach[:, None], np.nan)
    ends = _visible_ends(camera, centre, along, fan, margin)
    return _summed(camera, centre, along, beam, ends, ranges, common)


def _reach(mount: Mount) -> tuple[float, float]:
    """Return the ends of the fan along the stripe, at a distance of 1."""
    low, high = mount.swing - 0.5 * mount.fan, mount.swing + 0.5 * mount.fan
    # Limit of the fan to either side of the beam: light beyond it hits no wall nearby.
    widest = np.deg2rad(80.0)
    return float(np.tan(max(low, -widest))), float(np.tan(min(high, widest)))


def _visible_ends(
    camera: Camera, centre: FloatArray, along: FloatArray, fan: FloatArray, margin: float
) -> FloatArray:
    """Return the ends (K, W, 2) of the visible part along the stripe, in metres; NaN if none."""
    share = np.linspace(0.0, 1.0, _N_SEARCH)
    (width, height), free = camera.size_px, 2.0 * margin
    # The first pass covers the whole fan, which may be much wider than the picture.
    for _ in range(_N_PASSES):
        place = fan[..., :1] + share * (fan[..., 1:] - fan[..., :1])
        pixels, valid = camera.project(points_along(centre, along, place))
        x, y = pixels[..., 0] + 0.5 - margin, pixels[..., 1] + 0.5 - margin
        # Distance to the picture's border in pixels, negative outside; NaN if not seen.
        inside = np.minimum(np.minimum(x, width - free - x), np.minimum(y, height - free - y))
        inside = np.where(valid, inside, np.nan)
        seen = inside > 0.0
        first = np.argmax(seen, axis=-1)
        last = _N_SEARCH - 1 - np.argmax(seen[..., ::-1], axis=-1)
        ends = np.stack([_at(place, first - 1), _at(place, last + 1)], axis=-1)
        fan = np.where(seen.any(axis=-1, keepdims=True), ends, fan)
    begin = _edge(place, inside, first, -1)
    end = _edge(place, inside, last, 1)
    some: BoolArray = np.asarray(seen.any(axis=-1) & (end > begin))
    return np.where(some[..., None], np.stack([begin, end], axis=-1), np.nan)


def points_along(centre: FloatArray, along: FloatArray, place: FloatArray) -> FloatArray:
    """Return the points (K, W, S, 3) at `place` (K, W, S), in metres, along stripes' lines."""
    return centre[..., None, :] + place[..., None] * along[:, None, None, :]


def _at(values: FloatArray, i: IntArray) -> FloatArray:
    """Return values (K, W, S) at indices (K, W), clipped to the ends."""
    row = np.clip(i, 0, values.shape[-1] - 1)[..., None]
    return np.take_along_axis(values, row, -1)[..., 0]


def _edge(place: FloatArray, inside: FloatArray, i: IntArray, step: int) -> FloatArray:
    """Interpolate the border of the picture between the outermost point inside and the next."""
    here, there = _at(inside, i), _at(inside, i + step)
    at, to = _at(place, i), _at(place, i + step)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = here / (here - there)
    # Beyond the lens model, or the fan, the length of the stripe is unknown.
    share = np.where((there <= 0.0) & np.isfinite(share), share, 0.0)
    return at + share * (to - at)


def _summed(
    camera: Camera,
    centre: FloatArray,
    along: FloatArray,
    beam: FloatArray,
    ends: FloatArray,
    ranges: FloatArray,
    common: FloatArray,
) -> Stripes:
    """Integrate the sums over the visible parts of stripes; see `Stripes`. Beams: shape (K, 3)."""
    node, weight = np.polynomial.legendre.leggauss(_N_SUM)
    half = 0.5 * (ends[..., 1:] - ends[..., :1])
    points = points_along(centre, along, 0.5 * ends.sum(axis=-1, keepdims=True) + half * node)
    pixels, valid, by_point, by_parameter = camera.project_with_parameter_jacobian(points)
    seen: BoolArray = np.asarray(valid.all(axis=-1))
    path = np.einsum("kwsij,kj->kwsi", by_point, along)
    # The scanner searches upright stripes by rows.
    across, down = (np.abs(path[..., i]).mean(axis=-1) for i in range(2))
    is_row: BoolArray = (down > across)[..., None]
    lines = np.abs(np.where(is_row, path[..., 1], path[..., 0])) * (weight * half)
    lines = lines / pixels_per_line(camera.size_px)
    normal = np.cross(along, beam)
    by_x, by_y, by_normal, by_common = _sensitivity(normal, ranges, by_point, by_parameter @ common)
    per_px = np.where(is_row, by_x, by_y)
    # Positions along the stripe, from -1 at one border of the picture to 1 at the other.
    x, y = (2.0 * pixels[..., i] / (camera.size_px[i] - 1) - 1.0 for i in range(2))
    place = np.where(is_row, y, x)
    # A stripe without depth (its sheet runs through the lens) has no information.
    with np.errstate(divide="ignore", invalid="ignore"):
        line_weight = np.where(seen[..., None] & (per_px != 0.0), lines / per_px**2, 0.0)
    weighted = line_weight[..., None] * np.where(np.isfinite(points), points, 0.0)
    # A normal that turns towards t moves the sheet by -t·X along the old normal.
    turned = -np.stack([np.einsum("kwsi,ki->kws", points, t) for t in (along, beam)], axis=-1)
    pixel = np.stack([per_px, per_px * place], axis=-1)
    by_offset = by_normal[..., None]
    by_error = np.concatenate([pixel, turned * by_offset, by_offset], axis=-1)
    safe = [np.where(np.isfinite(a), a, 0.0) for a in (points, by_error, by_common)]
    return Stripes(
        lines=np.where(seen, lines.sum(axis=-1), 0.0),
        length=np.where(seen, 2.0 * half[..., 0], 0.0),
        matrix=np.einsum("kwsi,kwsj->kwij", weighted, safe[0]),
        own=np.einsum("kwsi,kwse->kwei", weighted, safe[1]),
        common=np.einsum("kwsi,kwsg->kwgi", weighted, safe[2]),
        centre=centre,
        along=along,
        ends=np.where(seen[..., None], ends, np.nan),
    )


def _sensitivity(
    normals: FloatArray, ranges: FloatArray, by_point: FloatArray, steps: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the derivatives of m·X at the points (K, W, S) that fixed pixels triangulate to.

    By a pixel's x and y, in 1/px; by a step of the sheet along its normal, in 1/m; and, shape
    (K, W, S, G), by the camera's errors. [J; n] dX = (du, dv, dn) is solved by cross products.
    """
    row_x, row_y = by_point[..., 0, :], by_point[..., 1, :]
    normal = normals[:, None, None, :]
    # Only the forward part of dX changes m·X = y / range.
    x_n, n_y = _cross_y(row_y, normal), _cross_y(normal, row_x)
    across = np.cross(row_x, row_y)
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y, z = (normal[..., i] * across[..., i] for i in range(3))
        volume = (x + y + z) * ranges[None, :, None]
        by_x, by_y, by_normal = x_n / volume, n_y / volume, across[..., 1] / volume
        # At a fixed pixel a step of the camera acts like the opposite step of the pixel.
        by_common = -(by_x[..., None] * steps[..., 0, :] + by_y[..., None] * steps[..., 1, :])
    return by_x, by_y, by_normal, by_common


def _cross_y(a: FloatArray, b: FloatArray) -> FloatArray:
    return a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
