"""The paper's filter for mesh-like structures (section 4).

A laser plane cuts the threads of a net at intervals that lie between two limits. Seen in the laser
plane, a reflection of a thread therefore has a small lit core, nothing around it, and the right
amount of light in the ring where its two neighbours must be. docs/mesh-filter.md states the reading
chosen where the paper's text is ambiguous.

`mesh_filter_dense` is Algorithm 1 line by line, `mesh_filter` its compiled form: it counts the lit
cells near each lit cell, in strips of the laser plane (`keep_cells`).
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from aqualvs.errors import OptionError, check_positive
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray, as_vectors
from aqualvs.geometry.compiled import kernel
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import SE3


@kernel
def keep_cells(
    strip: IntArray,
    m: IntArray,
    n: IntArray,
    reach: int,
    squared_radii: tuple[int, int, int],
    dg: int,
    keep: BoolArray,
) -> None:
    """Run Algorithm 1 of the paper for distinct lit cells (m, n).

    Parameters
    ----------
    strip, m, n : int array, shape (N,)
        Cells, sorted by their strip, which is n // reach, then by m.
    reach : int
        Radius of region C in cells, rounded up.
    squared_radii, dg
        As in `MeshFilterOptions`.
    keep : bool array, shape (N,)
        Written.
    """
    a, b, c = squared_radii
    first = np.zeros(3, np.int64)
    for i in range(m.shape[0]):
        in_a, in_ab, in_abc = 0, 0, 0
        for s in range(3):
            beside, k = strip[i] + s - 1, first[s]
            while k < m.shape[0] and (
                strip[k] < beside or (strip[k] == beside and m[k] < m[i] - reach)
            ):
                k += 1
            first[s] = k
            # Counts only grow: most cells on a wall or a fish need no further counting.
            while (
                k < m.shape[0] and strip[k] == beside and m[k] <= m[i] + reach and in_abc <= 3 * dg
            ):
                dm, dn = m[k] - m[i], n[k] - n[i]
                distance = dm * dm + dn * dn
                in_a += distance <= a
                in_ab += distance <= b
                in_abc += distance <= c
                k += 1
        in_c = in_abc - in_ab
        keep[i] = (
            (dg + 1) // 2 <= in_a <= dg and in_ab <= dg and (3 * dg + 1) // 2 <= in_c <= 2 * dg
        )


_FORWARD, _UP = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
# Tolerance of rounding for lengths that are integer multiples of a cell, as a share.
_ROUNDING = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class MeshFilterOptions:
    """Parameters of the mesh filter, in metres; defaults from section 5.2 of the paper.

    Raises
    ------
    OptionError
        If a length is not positive, r_min is not below r_max, or rd_theta is not below r_max.
    """

    rd_theta: float = 10e-3  # Size of a thread's reflection along the stripe.
    dd: float = 1e-3  # Side of a cell of the laser-plane image.
    # Smallest and largest distance of consecutive threads, centre to centre, in the laser plane.
    r_min: float = 15e-3
    r_max: float = 35e-3

    def __post_init__(self) -> None:
        check_positive("mesh filter", self, *self.__slots__)
        if not self.r_min < self.r_max:
            raise OptionError(
                f"mesh filter: r_min is {self.r_min * 1e3:g} mm and r_max {self.r_max * 1e3:g} mm; "
                "r_min must be the smaller"
            )
        if not self.rd_theta < self.r_max:
            raise OptionError(
                f"mesh filter: rd_theta is {self.rd_theta * 1e3:g} mm, not below r_max of "
                f"{self.r_max * 1e3:g} mm; reflections as long as the mesh show no period"
            )

    @classmethod
    def from_thread(
        cls, *, d_theta: float, theta_lt: float, dd: float, r_min: float, r_max: float
    ) -> "MeshFilterOptions":
        """Make options from a thread's diameter and its angle to the laser plane.

        Parameters
        ----------
        d_theta : float
            Thread diameter in metres.
        theta_lt : float
            Angle in radians, as the paper uses it: rd_theta = d_theta / cos(theta_lt). The
            paper's 2 mm thread with a reflection of 10 mm has acos(2/10), 78 degrees.
        dd, r_min, r_max : float
            As the attributes.
        """
        return cls(rd_theta=d_theta / math.cos(theta_lt), dd=dd, r_min=r_min, r_max=r_max)

    @property
    def dg_theta(self) -> int:
        """Largest number of cells of a thread's reflection, dg_theta = ceil(rd_theta / dd) + 1."""
        return math.ceil(self.rd_theta / self.dd - _ROUNDING) + 1

    @property
    def squared_radii(self) -> tuple[int, int, int]:
        """Largest squared distance, in cells, of cells in the regions A, B and C.

        B and C begin where the region before them ends; B is empty when r_min <= rd_theta.
        """
        half = self.rd_theta / 2.0
        radii = (half, max(self.r_min - half, half), self.r_max + half)
        a, b, c = (math.floor((r / self.dd) ** 2 * (1.0 + _ROUNDING)) for r in radii)
        return a, b, c

    @property
    def padding(self) -> int:
        """Reach of the regions in cells, rho_pad = ceil((r_max + rd_theta / 2) / dd)."""
        return math.ceil((self.r_max + self.rd_theta / 2.0) / self.dd - _ROUNDING)


@dataclass(frozen=True, slots=True)
class LaserImage:
    """The laser-plane image (paper, Eq. 41-42)."""

    lit: BoolArray  # Shape (n_x, n_y): im(m, n): whether a cell holds points.
    # Shape (N, 2): cell (m, n) of every point: S_idx(m, n) is where `cells` equals (m, n).
    cells: IntArray


def laser_frame(plane: Plane) -> SE3:
    """Return `laser_from_dome` of a laser plane (paper, Eq. 37-40).

    e_z is the plane's normal, e_y the dome's forward axis projected into the plane, and
    e_x = e_y x e_z. A plane square to the forward axis has no such projection: there e_y is the
    dome's z axis, so that e_x points right or left as the normal points forward or back.

    Parameters
    ----------
    plane : Plane
        In `dome`.

    Returns
    -------
    SE3
        Its origin is the foot of the perpendicular from the dome's centre; points on the plane
        have z = 0 in `laser`.
    """
    e_z = plane.normal
    # Least length of the forward axis projected into the laser plane; rounding dominates below.
    degenerate = 1e-6
    square_to_forward = math.hypot(e_z[0], e_z[2]) < degenerate
    e_y = _in_plane(_UP if square_to_forward else _FORWARD, e_z)
    rotation = np.stack([np.cross(e_y, e_z), e_y, e_z])
    return SE3(rotation, np.array([0.0, 0.0, -plane.offset]))


def _in_plane(axis: FloatArray, normal: FloatArray) -> FloatArray:
    """Return the unit vector of an axis projected into a plane to which it is not normal."""
    direction = axis - normal * (normal @ axis)
    direction /= np.linalg.norm(direction)
    # Again, because normalising a short projection magnifies its rounding error along the normal.
    direction -= normal * (normal @ direction)
    return direction / np.linalg.norm(direction)


def laser_cells(points_in_laser: FloatArray, dd: float) -> IntArray:
    """Return the cell (m, n) of every point, shape (N, 2), counted from the least x and y.

    Eq. 41 with its erratum: m·dx <= x - x_L < (m + 1)·dx, and so for n.
    """
    xy = points_in_laser[:, :2]
    low = xy.min(axis=0) if len(xy) else np.zeros(2)
    return np.floor((xy - low) / dd).astype(np.int64)


def laser_plane_image(points_in_laser: FloatArray, dd: float) -> LaserImage:
    """Rasterise the points of one laser (N, 2 or 3) in its plane (paper, Eq. 41-42)."""
    cells = laser_cells(points_in_laser, dd)
    n_x, n_y = cells.max(axis=0) + 1 if len(cells) else (0, 0)
    lit = np.zeros((n_x, n_y), dtype=np.bool_)
    lit[cells[:, 0], cells[:, 1]] = True
    return LaserImage(lit, cells)


def structuring_elements(options: MeshFilterOptions) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Return Str_A, Str_B and Str_C, each of shape (2 rho_pad + 1, 2 rho_pad + 1).

    A is the disc of diameter rd_theta, B the ring from A out to r_min - rd_theta/2, C the ring
    from B out to r_max + rd_theta/2; a cell belongs where its centre lies.
    """
    offsets = np.arange(-options.padding, options.padding + 1)
    squared = offsets[:, None] ** 2 + offsets[None, :] ** 2
    a, b, c = options.squared_radii
    return squared <= a, (squared > a) & (squared <= b), (squared > b) & (squared <= c)


def mesh_filter_dense(
    points: ArrayLike,
    plane: Plane,
    options: MeshFilterOptions | None = None,
    *,
    working_range: tuple[float, float] | None = None,
) -> BoolArray:
    """Return which points belong to a mesh: Algorithm 1 of the paper, line by line.

    The reference for `mesh_filter`, whose parameters and result it has; its cost grows with the
    area of the laser-plane image.
    """
    options = options or MeshFilterOptions()
    in_laser, usable = _usable_in_laser(points, plane, working_range)
    image = laser_plane_image(in_laser[usable], options.dd)
    kept = _algorithm_1(image.lit, options)
    keep = np.zeros(len(usable), dtype=np.bool_)
    keep[usable] = kept[image.cells[:, 0], image.cells[:, 1]]
    return keep


def _algorithm_1(lit: BoolArray, options: MeshFilterOptions) -> BoolArray:
    """Return Im'' from Im (paper, Algorithm 1, lines 1-10)."""
    str_a, str_b, str_c = structuring_elements(options)
    pad, dg = options.padding, options.dg_theta
    padded = np.pad(lit, pad)
    kept = np.zeros_like(lit)
    for m in range(lit.shape[0]):
        for n in range(lit.shape[1]):
            window = padded[m : m + 2 * pad + 1, n : n + 2 * pad + 1]
            in_a = np.count_nonzero(window & str_a)
            in_b = np.count_nonzero(window & str_b)
            in_c = np.count_nonzero(window & str_c)
            kept[m, n] = (
                math.ceil(dg / 2) <= in_a <= dg
                and 0 <= in_b <= dg - in_a
                and math.ceil(3 * dg / 2) <= in_c <= 2 * dg
            )
    return kept


def mesh_filter(
    points: ArrayLike,
    plane: Plane,
    options: MeshFilterOptions | None = None,
    *,
    working_range: tuple[float, float] | None = None,
) -> BoolArray:
    """Return which points of one laser belong to a mesh (paper, section 4).

    Parameters
    ----------
    points : array, shape (N, 3) or (N, 2)
        Points of one laser in metres: in `dome`, or with two columns in `laser` of `plane`.
        Rows that are not finite are not kept.
    plane : Plane
        The laser's plane in `dome`.
    options : MeshFilterOptions, optional
        The paper's values if left out.
    working_range : (float, float), optional
        Points whose distance from the dome's centre lies outside, in metres, are dropped before
        the filter sees them: they neither count nor are kept.

    Returns
    -------
    keep : bool array, shape (N,)

    Raises
    ------
    ValueError
        If the points have another shape.

    Notes
    -----
    Equal to `mesh_filter_dense` point by point. Only cells that hold points are visited, so the
    cost grows with the number of points and not with the area they span.
    """
    options = options or MeshFilterOptions()
    in_laser, usable = _usable_in_laser(points, plane, working_range)
    m, n = laser_cells(in_laser[usable], options.dd).T
    reach = options.padding
    strip = n // reach
    order = np.lexsort((n, m, strip))
    m, n, strip = m[order], n[order], strip[order]
    distinct = np.ones(len(order), dtype=np.bool_)
    distinct[1:] = (np.diff(m) != 0) | (np.diff(n) != 0)
    kept = np.empty(np.count_nonzero(distinct), dtype=np.bool_)
    lit = strip[distinct], m[distinct], n[distinct]
    keep_cells(*lit, reach, options.squared_radii, options.dg_theta, kept)
    keep = np.zeros(len(usable), dtype=np.bool_)
    keep[np.flatnonzero(usable)[order]] = kept[np.cumsum(distinct) - 1]
    return keep


def _usable_in_laser(
    points: ArrayLike, plane: Plane, working_range: tuple[float, float] | None
) -> tuple[FloatArray, BoolArray]:
    """Return the points (N, 2) in `laser`, and which of them the filter may see."""
    array = np.asarray(points, dtype=np.float64)
    if array.size == 0:
        array = array.reshape(0, 3)
    if array.ndim != 2 or array.shape[1] not in (2, 3):
        raise ValueError(f"points has shape {array.shape} but expected (N, 3) or (N, 2)")
    in_laser = as_vectors(array, 2, "points") if array.shape[1] == 2 else _flatten(array, plane)
    with np.errstate(invalid="ignore", over="ignore"):
        distance = np.sqrt(in_laser[:, 0] ** 2 + in_laser[:, 1] ** 2 + plane.offset**2)
    # Farther than any laser reaches, near enough for cells to be whole numbers.
    farthest = 1e6
    near, far = (0.0, farthest) if working_range is None else working_range
    # Comparisons with NaN are false, so points that do not exist are not usable.
    usable: BoolArray = (distance >= near) & (distance <= min(far, farthest))
    return in_laser, usable


def _flatten(points_in_dome: FloatArray, plane: Plane) -> FloatArray:
    with np.errstate(invalid="ignore"):
        return np.ascontiguousarray(laser_frame(plane).apply(points_in_dome)[:, :2])
