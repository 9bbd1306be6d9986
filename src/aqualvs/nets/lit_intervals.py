"""Lit intervals: the lit, dark and hidden parts of each laser's line across the net in one frame.

A laser sheet cuts the target plane in a line. Every search line of the detector looks at one place
of it, so a frame gives one signal per laser: dark, lit (a strand crosses there), or hidden (not
observable).
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.compiled import kernel
from aqualvs.geometry.planes import Plane, upright_axes
from aqualvs.geometry.transforms import SE3
from aqualvs.nets.occlusion import LaserLines, hidden_lines, light_beyond
from aqualvs.optics.rig import Rig
from aqualvs.optics.sheet import Sheet, sheets_of
from aqualvs.scanning.laser_bands import SearchAxis, plan_bands
from aqualvs.scanning.posture import Posture
from aqualvs.scanning.scan import Label, Scan


class LineState(IntEnum):
    """State of the net at one search line."""

    HIDDEN = 0
    """Nothing: outside the picture, in a crossing zone, behind something."""
    DARK = 1
    """No strand."""
    LIT = 2
    """A strand."""


@dataclass(frozen=True, slots=True)
class NetFrame:
    """The lasers' lines on the net in one frame, L lasers."""

    # As in the `Scan`.
    index: int
    time_s: float
    # Distance of the dome's centre from the net's plane, in metres.
    range: float
    # Shape (L, 2): each laser's line in `net`: the place where `along` is zero and a unit vector.
    # `net` is the target plane, x right and y up, its origin the foot of the perpendicular from the
    # dome's centre. NaN where a laser does not meet the net.
    origin: FloatArray
    direction: FloatArray
    # Shape (L, 2): unit vector in `net` along which each laser's search lines run, where most is
    # seen.
    search: FloatArray
    # Size of a pixel on the net, in metres.
    pixel: float


@dataclass(frozen=True, slots=True)
class NetSignal(NetFrame):
    """Signals of the net along the lasers' lines in a frame; J search lines (padded)."""

    # Shape (L, J): place on the laser's line in metres, ascending or descending; NaN where a search
    # line does not meet it.
    along: FloatArray
    # Shape (L, J): length of laser line per search line, in metres.
    step: FloatArray
    # Shape (L, J): `LineState` values.
    state: NDArray[np.uint8]
    # Shape (L, J): peak of the return above its background in grey levels where lit, else zero.
    height: FloatArray
    # Shape (L, J): full width at half height of the stripe, in metres on the net, where lit, else
    # zero.
    width: FloatArray
    # Shape (L, J): whether the light of a search line is seen on something behind the net.
    beyond: BoolArray


def net_from_dome(normal_in_dome: FloatArray, distance: float) -> SE3:
    """Return the transform into `net`: x right and y up in the plane, z towards the vehicle.

    Parameters
    ----------
    normal_in_dome : array, shape (3,)
        Unit normal of the target plane, away from the vehicle.
    distance : float
        Of the dome's centre from the plane, in metres.
    """
    right, away, up = upright_axes(normal_in_dome).T
    return SE3(np.stack([right, up, -away]), np.array([0.0, 0.0, distance]))


class NetReader:
    """Reader of scans as signals along the lasers' lines.

    `rig`: camera and lasers of the scans.
    """

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self._camera = rig.camera()
        self._laser_bands = plan_bands(rig, self._camera, rig.shutter.field_of(0))
        self._sheets = sheets_of(rig)
        self._planes = [sheet.best_plane(self._camera, rig.working_range) for sheet in self._sheets]
        # Image axis along which each laser's search lines run.
        self._axis = np.array([0 if s.axis is SearchAxis.ALONG_X else 1 for s in self._laser_bands])
        self._line_px = np.array([s.line_px for s in self._laser_bands])
        # Lines of the two fields of an interlaced camera differ by this alone.
        self._shift_px = {
            field: np.array([s.shift_px for s in plan_bands(rig, self._camera, field)])
            for field in {rig.shutter.field_of(index) for index in range(2)}
        }
        self.n_lines = max((len(one.lowest) for one in self._laser_bands), default=0)
        # First and last position (L, J) of a detectable stripe on each search line.
        self._lowest = np.full((len(self._laser_bands), self.n_lines), np.inf)
        self._highest = np.full(self._lowest.shape, -np.inf)
        # The detector needs dark flanks: no stripe is found next to the border.
        border_px = 16.0
        for i, search in enumerate(self._laser_bands):
            n, last = len(search.lowest), rig.size_px[self._axis[i]] - 1
            self._lowest[i, :n] = np.maximum(search.lowest, border_px)
            self._highest[i, :n] = np.minimum(search.highest, last - border_px)

    def read(self, scan: Scan) -> NetSignal | None:
        """Return the signal of one frame, or None where its posture was refused."""
        posture = scan.posture
        if not posture:
            return None
        net = net_from_dome(posture.normal_in_dome, posture.range)
        shift_px = self._shift_px[self.rig.shutter.field_of(scan.index)]
        return self._signal(scan, posture, net, self._lines(net, shift_px), shift_px)

    def _lines(self, net: SE3, shift_px: FloatArray) -> LaserLines:
        """Follow every laser's line across the net's plane."""
        n = len(self._laser_bands)
        lines = [_line_on(plane, net) for plane in self._planes]
        origin, direction = np.stack(lines, axis=1) if n else np.empty((2, 0, 2))
        # A line across the net is followed this far to each side, in ranges.
        reach_in_ranges = 1.3
        n_samples = 129
        reach = reach_in_ranges * float(np.linalg.norm(net.translation))
        s = np.linspace(-reach, reach, n_samples)
        flat = np.zeros((n, n_samples, 3))
        flat[..., :2] = origin[:, None] + s[:, None] * direction[:, None]
        dome_from_net = net.inverse()
        points = dome_from_net.apply(np.nan_to_num(flat))
        for i, sheet in enumerate(self._sheets):
            points[i] = _onto_sheet(points[i], sheet, dome_from_net)
        pixels, valid = self._camera.project(points)
        along, position = np.full((2, n, self.n_lines), np.nan)
        found = LaserLines(origin, direction, along, position, np.zeros(along.shape))
        for i in np.flatnonzero(np.isfinite(direction[:, 0])).tolist():
            search, axis = self._laser_bands[i], self._axis[i]
            _resample(
                s,
                (pixels[i, :, 1 - axis] + 0.5 - shift_px[i]) / search.line_px - 0.5,
                pixels[i, :, axis],
                valid[i],
                len(search.lowest),
                found.along[i],
                found.position[i],
                found.step[i],
            )
        return found

    def _signal(
        self, scan: Scan, posture: Posture, net: SE3, lines: LaserLines, shift_px: FloatArray
    ) -> NetSignal:
        points, distance = scan.points, posture.range
        in_net = net.apply(points.points_in_dome)
        laser = points.laser.astype(np.int64)
        every = np.arange(len(points))
        position = points.pixels[every, self._axis[laser]]
        row = points.pixels[every, 1 - self._axis[laser]]
        row = (row + 0.5 - shift_px[laser]) / self._line_px[laser] - 0.5
        row = np.rint(row).astype(np.int64)
        # Largest distance of light on the net from its plane, as a share of the range.
        off_plane = 0.05
        off = off_plane * distance
        on_net = (np.abs(in_net[:, 2]) < off) & (points.label == Label.NET)
        height, width = np.zeros((2, *lines.along.shape))
        px = np.sqrt(np.sum(points.points_in_dome**2, axis=1)) / self.rig.focal_px
        folded = (points.label == Label.NET) & ~on_net
        lit = laser[on_net], row[on_net]
        np.maximum.at(height, lit, points.intensity[on_net])
        np.maximum.at(width, lit, (points.width * px)[on_net])
        # The lasers are beside the dome, where their sheets are nearest to its centre.
        sources = net.apply(np.array([one.normal * one.offset for one in self._planes]))
        eye = net.apply(self.rig.dome_from_cam.translation)
        hidden = hidden_lines(
            points, in_net, row, position, self._line_px, eye, sources, lines, off
        ) | self._near_crossings(lines, width, distance)
        # Where the net leaves its plane, the state of the plane is not known.
        hidden[laser[folded], row[folded]] = True
        with np.errstate(invalid="ignore"):
            seen = (lines.position > self._lowest) & (lines.position < self._highest) & ~hidden
        state = np.where(seen, np.where(height > 0.0, LineState.LIT, LineState.DARK), 0)
        return NetSignal(
            scan.index,
            scan.time_s,
            distance,
            lines.origin,
            lines.direction,
            self._search_directions(net, lines, seen, shift_px),
            posture.slant_range / self.rig.focal_px,
            lines.along,
            lines.step,
            state.astype(np.uint8),
            height,
            width,
            light_beyond(points, in_net, sources, lines, off),
        )

    def _search_directions(
        self, net: SE3, lines: LaserLines, seen: BoolArray, shift_px: FloatArray
    ) -> FloatArray:
        """Return unit vectors in `net` along the search lines in the middle of what is seen."""
        middle = np.tile(0.5 * (np.array(self.rig.size_px) - 1.0), (len(seen), 1))
        for i, axis in enumerate(self._axis):
            j = np.flatnonzero(seen[i])
            if len(j):
                half_way = j[len(j) // 2]
                middle[i, axis] = lines.position[i, half_way]
                middle[i, 1 - axis] = (half_way + 0.5) * self._line_px[i] - 0.5 + shift_px[i]
        # Distance in the picture of the places that determine directions on the net.
        ahead_px = 30.0
        step = ahead_px * np.eye(2)[self._axis]
        rays = self._camera.rays(np.stack([middle - step, middle + step]))
        origins, ahead = net.apply(rays.origins), net.rotate(rays.directions)
        on_net = origins[..., :2] - origins[..., 2:] / ahead[..., 2:] * ahead[..., :2]
        along = on_net[1] - on_net[0]
        directions: FloatArray = along / np.hypot(*along.T)[:, None]
        return directions

    def _near_crossings(self, lines: LaserLines, width: FloatArray, distance: float) -> BoolArray:
        """Mark the places near another laser's line."""
        px = distance / self.rig.focal_px
        # Width of a stripe where none was measured, in pixels.
        usual_width_px = 5.0
        lit = [row[row > 0.0] for row in width]
        wide = np.array([np.median(one) if len(one) else usual_width_px * px for one in lit])
        # Reach of a crossing, where two lasers' stripes disturb each other: in widths, plus pixels.
        crossing_widths, crossing_px = 1.5, 4.0
        margin = crossing_widths * np.maximum(wide[:, None], wide) + crossing_px * px
        across = lines.direction[:, ::-1] * [-1.0, 1.0]
        start = np.sum((lines.origin[:, None] - lines.origin) * across, axis=-1)
        rate = np.sum(lines.direction[:, None] * across, axis=-1)
        # False where one of the two lines does not meet the net.
        near = np.abs(start[..., None] + rate[..., None] * lines.along[:, None]) < margin[..., None]
        near[np.diag_indices(len(near))] = False
        return np.asarray(near.any(axis=1))


def _line_on(sheet: Plane, net: SE3) -> tuple[FloatArray, FloatArray]:
    """Return origin and unit direction, shape (2,) each, of a sheet's line on the net; or NaN."""
    across = net.rotate(sheet.normal)
    flat = across[:2]
    size = float(np.hypot(*flat))
    # Least sine of the angle between sheet and net for a line on the net.
    min_slope = 1e-3
    if size < min_slope:
        return np.full(2, np.nan), np.full(2, np.nan)
    # A point of the net's plane X has n·(R^T (X - t)) = offset.
    offset = sheet.offset + float(across @ net.translation)
    normal = flat / size
    return normal * (offset / size), np.array([normal[1], -normal[0]])


def _onto_sheet(points: FloatArray, sheet: Sheet, dome_from_net: SE3) -> FloatArray:
    """Move points in the net's plane onto a bent sheet."""
    if sheet.is_plane:
        return points
    normal = dome_from_net.rotation[:, 2]
    for _ in range(2):
        gradient = sheet.gradient(points)
        gradient = gradient - (gradient @ normal)[:, None] * normal
        share = sheet.signed_distance(points) / np.sum(gradient**2, axis=1)
        points = points - share[:, None] * gradient
    return points


@kernel
def _resample(
    s: FloatArray,
    line: FloatArray,
    position: FloatArray,
    valid: BoolArray,
    n_lines: int,
    along: FloatArray,
    where: FloatArray,
    step: FloatArray,
) -> None:
    """Write place, position and step at whole search lines, from samples along a laser's line.

    Nothing is written where the picture folds the line back.
    """
    keep = np.flatnonzero(valid & (line > -n_lines) & (line < 2 * n_lines))
    if len(keep) < 3:
        return
    if line[keep[-1]] < line[keep[0]]:
        keep = keep[::-1]
    for k in range(len(keep) - 1):
        if not line[keep[k + 1]] > line[keep[k]]:
            return
    for k in range(len(keep) - 1):
        a, b = keep[k], keep[k + 1]
        low, high = max(np.ceil(line[a]), 0.0), min(np.floor(line[b]), n_lines - 1.0)
        for j in range(int(low), int(high) + 1):
            share = (j - line[a]) / (line[b] - line[a])
            along[j] = s[a] + share * (s[b] - s[a])
            where[j] = position[a] + share * (position[b] - position[a])
            step[j] = abs((s[b] - s[a]) / (line[b] - line[a]))
