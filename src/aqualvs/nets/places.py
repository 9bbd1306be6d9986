"""Places on the net: the lattice's track and the vehicle's log combined.

The track measures every step along the net, to a fraction of a mesh, as long as it lasts; where it
breaks, its pieces have nothing in common. The log has depth and heading all the time, but coarsely.
So the track gives the places within a piece, and the log positions the pieces: depth fixes their
height, the bearing of the net their place along a round cage (`place_net`).

`open_log` and `align_log` read the log beside a dive and align it with the dive's clock;
`ViewedPlaces` gives depth, bearing and heading at the moments of the dive's postures.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.planes import normals_of
from aqualvs.nets.condition import NetStretch
from aqualvs.nets.holes import Hole
from aqualvs.vehicle_logs import (
    OffsetRefusal,
    PostureTrack,
    TimeOffset,
    VehicleLog,
    VehiclePlaces,
    dive_start_utc,
    find_time_offset,
    offset_from_clocks,
    read_vehicle_log,
)


@dataclass(frozen=True, slots=True)
class DivePostures:
    """Postures to the net over a dive, N of them, all valid."""

    time_s: FloatArray  # Shape (N,): dive time, increasing.
    # Shape (N,): metres and radians.
    range: FloatArray
    pitch: FloatArray
    yaw: FloatArray

    def normals(self) -> FloatArray:
        """Return the net's far unit normals in `dome`, shape (N, 3)."""
        return normals_of(self.pitch, self.yaw)


@dataclass(frozen=True, slots=True)
class ViewedPlaces:
    """Depth and bearing of the net at the times of a dive's postures; NaN where not known."""

    time_s: FloatArray  # Shape (N,): dive time.
    # Shape (N,): depth of the foot of the perpendicular on the net, in metres.
    foot_depth: FloatArray
    # Shape (N,): bearing of the net and heading of the vehicle, in radians.
    net: FloatArray
    nose: FloatArray
    # Shape (N,): elevation of the net's far normal, in radians; a level vehicle is assumed where
    # the log has no attitude.
    lean: FloatArray

    @classmethod
    def of(cls, postures: DivePostures, vehicle: VehiclePlaces | None) -> "ViewedPlaces":
        """Look a dive's postures up in the log."""
        normals = postures.normals()
        level = np.arctan2(normals[:, 2], np.hypot(normals[:, 0], normals[:, 1]))
        if vehicle is None:
            nothing = np.full(len(postures.time_s), np.nan)
            return cls(postures.time_s, nothing, nothing, nothing, level)
        at = vehicle.at(postures.time_s, postures.yaw, postures.pitch)
        lean = np.where(at.lean_valid, at.lean, level)
        depth = np.where(at.depth_valid, at.depth, np.nan) - postures.range * np.sin(lean)
        net = np.where(at.bearing_valid, at.bearing, np.nan)
        nose = np.where(at.heading_valid, at.heading, np.nan)
        return cls(postures.time_s, depth, net, nose, lean)

    def upright(self) -> float:
        """Return plumb metres per metre up in the net's plane."""
        return float(np.cos(np.median(self.lean))) if len(self.lean) else 1.0

    def depths(self, times: FloatArray) -> FloatArray:
        """Return the depth of the foot at some times."""
        return np.array([_mean(self._at(self.foot_depth, t, t)) for t in times])

    def bearings(self, times: FloatArray) -> FloatArray:
        """Return the bearing of the net at some times, in [0, 2 pi)."""
        return np.array([_direction(self._at(self.net, t, t)) for t in times])

    def bearing(self, begin_s: float, end_s: float | None = None) -> float | None:
        """Return the net's mean bearing around a moment, or over a time; None if not known."""
        return _known(_direction(self._at(self.net, begin_s, end_s)))

    def heading(self, begin_s: float, end_s: float | None = None) -> float | None:
        """Return the vehicle's mean heading around a moment, or over a time; None if not known."""
        return _known(_direction(self._at(self.nose, begin_s, end_s)))

    def _at(self, values: FloatArray, begin_s: float, end_s: float | None) -> FloatArray:
        """Return the known values between two times, or around the first."""
        last = begin_s if end_s is None else end_s
        # Values at a moment are averaged over this many seconds before and after it.
        moment_s = 0.5
        found = values[slice(*np.searchsorted(self.time_s, (begin_s - moment_s, last + moment_s)))]
        return np.asarray(found[np.isfinite(found)])


def _mean(values: FloatArray) -> float:
    return float(values.mean()) if len(values) else np.nan


def _direction(angles: FloatArray) -> float:
    """Return the mean of directions in [0, 2 pi); NaN without any."""
    if not len(angles):
        return np.nan
    return float(np.arctan2(np.sin(angles).mean(), np.cos(angles).mean())) % (2.0 * np.pi)


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


@dataclass(frozen=True, slots=True)
class AlignedLog:
    """A log and its alignment with the dive's clock."""

    log: VehicleLog  # As it was read.
    # Log time minus dive time, or the reason why it is not known.
    offset: TimeOffset | OffsetRefusal
    # Share of the dive that the log covers.
    covered: float

    @property
    def places(self) -> VehiclePlaces | None:
        """The log's values at dive times; None where it cannot be used."""
        if isinstance(self.offset, OffsetRefusal) or not self.covered:
            return None
        return VehiclePlaces(self.log, self.offset.offset_s)

    def words(self) -> str:
        """Return the alignment of the log as one line of text."""
        if isinstance(self.offset, OffsetRefusal):
            return f"log {self.log.name} is not used: {self.offset.reason} (--log-offset-s)"
        begins, ends = self.log.span_s
        offset = f"{self.offset.offset_s:.2f} s"
        if not self.covered:
            return (
                f"log {self.log.name} is not used: it covers {begins:.1f} to {ends:.1f} s of its "
                f"own clock, and none of the dive with an offset of {offset}; check --log-offset-s"
            )
        sigma = f" ± {self.offset.sigma_s:.2f} s" if self.offset.sigma_s else ""
        how = self.offset.how
        said = f"log {self.log.name}: its clock minus the dive's is {offset}{sigma} ({how})"
        # Less than this is a log of another span, or one with gaps.
        usual = 0.95
        part = f"; it covers {100 * self.covered:.0f} % of the dive"
        return said if self.covered > usual else said + part

    def to_dict(self) -> dict[str, Any]:
        """Return the same for `net.geojson`."""
        found: dict[str, Any] = {"file": self.log.name, "used": self.places is not None}
        if isinstance(self.offset, OffsetRefusal):
            return found | {"refused": self.offset.reason}
        return found | {
            "offset_s": round(self.offset.offset_s, 3),
            "sigma_offset_s": round(self.offset.sigma_s, 3),
            "offset_from": self.offset.how,
            "covered": round(self.covered, 4),
        }


def open_log(path: Path | None, offset_s: float | None) -> VehicleLog | None:
    """Read the log that the user names, if any.

    Raises `SourceError` if it cannot be read. Raises `OptionError` if there is an offset without a
    log, or the log's format needs an extra.
    """
    if path is not None:
        return read_vehicle_log(path)
    if offset_s is not None:
        raise OptionError(f"--log-offset-s {offset_s:g}: there is no log; add --log FILE")
    return None


def align_log(
    log: VehicleLog, postures: DivePostures, offset_s: float | None, video: Path | None
) -> AlignedLog:
    """Align a log with a dive's clock.

    Without an offset from the user (log time minus dive time) it is estimated from the motion
    common to both; the clocks of video and log help where that is ambiguous, and replace it where
    there is no motion.
    """
    given = offset_s is not None and TimeOffset(offset_s, 0.0, None, "given by the user")
    offset = given or _estimate_offset(log, postures, video)
    covered = 0.0
    if not isinstance(offset, OffsetRefusal) and len(postures.time_s):
        state = log.at(postures.time_s + offset.offset_s)
        covered = float((state.depth_valid | state.heading_valid).mean())
    return AlignedLog(log, offset, covered)


def _estimate_offset(
    log: VehicleLog, postures: DivePostures, video: Path | None
) -> TimeOffset | OffsetRefusal:
    clocks = offset_from_clocks(log, None if video is None else dive_start_utc(video))
    start = clocks if isinstance(clocks, TimeOffset) else None
    track = PostureTrack(postures.time_s, postures.yaw, postures.pitch, np.isfinite(postures.range))
    motion = find_time_offset(log, track, start=start)
    return motion if isinstance(motion, TimeOffset) or start is None else start


class PlacedBy(StrEnum):
    """Source of the distance along the net of a place."""

    TRACK = "track"
    """The lattice's own track, from the start of the dive on."""
    BEARING = "bearing"
    """The track since it was found again; the bearing of the net joins the pieces."""
    SPEED = "speed"
    """As before, but the speed before and after joins the pieces, where the track was lost."""
    NOTHING = "nothing"
    """There was no track at all."""


@dataclass(frozen=True, slots=True)
class NetPlace:
    """A place on the unrolled net; None where not known."""

    # Metres to the right and, plumb, above the start of the dive's track.
    along: float
    up: float
    # Metres below the surface.
    depth: float | None
    # Compass direction of the net's far normal, and of the vehicle's nose, in [0, 2 pi).
    bearing: float | None
    heading: float | None
    # Source of `along`.
    placed_by: PlacedBy


@dataclass(frozen=True, slots=True)
class NetPlaces:
    """Places of all stretches and holes of a dive."""

    # Of every stretch.
    begin: list[NetPlace]
    middle: list[NetPlace]
    end: list[NetPlace]
    # Of the middle of every hole.
    holes: list[NetPlace]
    # Height difference in metres between the track and the log's depth; 0 where they agree, or
    # there is no depth. A track that slipped has counted meshes wrongly: its places along the net
    # and its sizes are wrong as well.
    slip: float


def place_net(
    stretches: Sequence[NetStretch],
    holes: Sequence[Hole],
    postures: DivePostures,
    vehicle: VehiclePlaces | None = None,
) -> NetPlaces:
    """Place stretches and holes on the unrolled net.

    Stretches and holes are those of `NetCondition`, in the order of time; the vehicle's log is
    aligned with the dive's clock.

    The net's depth at the foot of the perpendicular follows from the vehicle's depth and attitude
    and from the posture; where the log has no attitude the vehicle counts as level. Its mean over
    15 s before and after corrects the track's height, which limits both the log's noise and the
    track's drift.
    """
    if not stretches:
        return NetPlaces([], [], [], [], 0.0)
    seen = ViewedPlaces.of(postures, vehicle)
    nodes = _Nodes.of(stretches, seen)
    ends = [nodes.place(i, seen) for i in range(len(nodes.time_s))]
    middles = [_middle(ends[i], ends[i + 1], one, seen) for i, one in enumerate(stretches)]
    of_holes = [nodes.place_hole(hole, seen) for hole in holes]
    return NetPlaces(ends[:-1], middles, ends[1:], of_holes, nodes.slip(seen))


def _middle(begin: NetPlace, end: NetPlace, stretch: NetStretch, seen: ViewedPlaces) -> NetPlace:
    depths = [one.depth for one in (begin, end) if one.depth is not None]
    return NetPlace(
        along=0.5 * (begin.along + end.along),
        up=0.5 * (begin.up + end.up),
        depth=sum(depths) / len(depths) if depths else None,
        bearing=seen.bearing(stretch.begin_s, stretch.end_s),
        heading=seen.heading(stretch.begin_s, stretch.end_s),
        placed_by=end.placed_by,
    )


@dataclass(frozen=True, slots=True)
class _Nodes:
    """The start of the first stretch and the ends of all; one more than there are stretches."""

    # Shape (n,): on the unrolled net, all pieces joined.
    time_s: FloatArray
    along: FloatArray
    up: FloatArray
    # Shape (n, 2): places in the track: right, and up in the net's plane.
    raw: FloatArray
    # Shape (n,): piece of track; and run of nodes between which the track gives every step.
    piece: IntArray
    run: IntArray
    # Plumb metres per metre up in the net's plane.
    upright: float
    # Shape (n,): corrected by the log; NaN where the log has none.
    depth: FloatArray

    placed_by: list[PlacedBy]

    @classmethod
    def of(cls, stretches: Sequence[NetStretch], seen: ViewedPlaces) -> "_Nodes":
        """Join the pieces of track."""
        time_s = np.array([stretches[0].begin_s, *(one.end_s for one in stretches)])
        raw = np.array([stretches[0].begin_place, *(one.place for one in stretches)])
        piece = np.array([0, *(one.piece for one in stretches)])
        # Whether the track gives the length of each stretch.
        moved = np.any(np.diff(raw, axis=0) != 0.0, axis=1)
        seen_there = np.array([one.lattice is not None for one in stretches])
        tracked = (np.diff(piece) == 0) & (moved | seen_there)
        run = np.concatenate([[0], np.cumsum(~tracked)])
        upright = seen.upright()
        steps = _steps(np.diff(raw, axis=0) * [1.0, upright], np.diff(time_s), tracked)
        along, up = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]).T
        joined_by, turned = PlacedBy.SPEED, _place_round_cage(along, run, seen.bearings(time_s))
        if turned is not None:
            along, joined_by = turned, PlacedBy.BEARING
        placed_by = [joined_by if r else PlacedBy.TRACK for r in run]
        if turned is None and not tracked.any():
            placed_by = [PlacedBy.NOTHING] * len(run)
        depth = _log_corrected_depths(time_s, up, run, seen.depths(time_s))
        return cls(time_s, along, up, raw, piece, run, upright, depth, placed_by)

    def slip(self, seen: ViewedPlaces) -> float:
        """Return the largest height difference of track and log within a run (`NetPlaces`)."""
        off = seen.depths(self.time_s) + self.up
        known = np.isfinite(off)
        spread = [np.ptp(off[known & (self.run == r)]) for r in np.unique(self.run[known])]
        most = float(max(spread, default=0.0))
        # Difference of height, in metres, at which track and log disagree; waves make less.
        min_slip = 0.5
        return most if most > min_slip else 0.0

    def place(self, i: int, seen: ViewedPlaces) -> NetPlace:
        """Return the place of a node."""
        return NetPlace(
            along=float(self.along[i]),
            up=float(self.up[i]),
            depth=_known(self.depth[i]),
            bearing=seen.bearing(self.time_s[i]),
            heading=seen.heading(self.time_s[i]),
            placed_by=self.placed_by[i],
        )

    def place_hole(self, hole: Hole, seen: ViewedPlaces) -> NetPlace:
        """Return the place of a hole, relative to the nearest node in time of its piece of track.

        A piece that was lost before its first stretch ended has no node; then the hole is placed
        relative to the vehicle at the time of the look.
        """
        mine = np.flatnonzero(self.piece == hole.piece)
        if len(mine):
            i = int(mine[np.argmin(np.abs(self.time_s[mine] - hole.time_s))])
            off, placed_by = hole.place - self.raw[i], self.placed_by[i]
            along, height, depth = self.along[i], self.up[i], self.depth[i]
        else:
            off, placed_by = hole.from_foot, PlacedBy.SPEED
            along = np.interp(hole.time_s, self.time_s, self.along)
            height = np.interp(hole.time_s, self.time_s, self.up)
            depth = seen.depths(np.array([hole.time_s]))[0]
        right, up = off * [1.0, self.upright]
        return NetPlace(
            along=float(along + right),
            up=float(height + up),
            depth=_known(depth - up),
            bearing=seen.bearing(hole.time_s),
            heading=seen.heading(hole.time_s),
            placed_by=placed_by,
        )


def _steps(steps: FloatArray, elapsed: FloatArray, tracked: BoolArray) -> FloatArray:
    """Replace steps (n, 2) that are not tracked by the speed of neighbouring steps."""
    found = steps.copy()
    known = np.flatnonzero(tracked & (elapsed > 0.0))
    for i in np.flatnonzero(~tracked):
        beside = [*known[known < i][-1:], *known[known > i][:1]]
        speeds = [steps[k] / elapsed[k] for k in beside]
        found[i] = np.mean(speeds, axis=0) * elapsed[i] if speeds else 0.0
    return found


def _place_round_cage(along: FloatArray, run: IntArray, bearing: FloatArray) -> FloatArray | None:
    """Place the runs by the bearing of a round cage; None where it shows no roundness."""
    known = np.isfinite(bearing)
    if not run.any() or np.count_nonzero(known) < 3:
        return None
    turn = np.full(len(bearing), np.nan)
    turn[known] = np.unwrap(bearing[known])
    within = [known & (run == r) for r in np.unique(run[known])]
    off_turn = np.concatenate([turn[mine] - turn[mine].mean() for mine in within])
    off_along = np.concatenate([along[mine] - along[mine].mean() for mine in within])
    radius = metres_per_radian(off_turn, off_along)
    if radius is None:
        return None
    lag = np.array([np.mean((radius * turn - along)[mine]) for mine in within])
    numbers = np.array([run[mine][0] for mine in within])
    # A run without bearings is placed with its neighbours.
    return np.asarray(along + np.interp(run, numbers, lag) - np.interp(0, numbers, lag))


def metres_per_radian(turn: FloatArray, along: FloatArray) -> float | None:
    """Return how far along a net its bearing turns by a radian; None where it shows no roundness.

    `turn`, `along`, shape (n,): bearings and places along the net, less their means; negative
    where bearings fall to the right.
    """
    # A round cage is detected by the growth of its bearing along the track: least change (standard
    # deviation), and least coefficient of correlation of the two.
    min_turn, min_agreement = np.deg2rad(5.0), 0.9
    spread = float(np.sqrt(turn @ turn * (along @ along)))
    if np.std(turn) < min_turn or abs(turn @ along) < min_agreement * spread:
        return None
    return float(turn @ along) / float(turn @ turn)


def _log_corrected_depths(
    time_s: FloatArray, up: FloatArray, run: IntArray, depth: FloatArray
) -> FloatArray:
    """Return depths that follow the track in the short term, and the log in the long term."""
    found = np.full(len(time_s), np.nan)
    # Time before and after over which depth is averaged to correct the track's height, in seconds:
    # it averages out waves and the sensor's noise, and the track hardly drifts in it.
    half_window_s = 15.0
    for i in range(len(time_s)):
        near = (run == run[i]) & (np.abs(time_s - time_s[i]) <= half_window_s) & np.isfinite(depth)
        if near.any():
            found[i] = float(np.mean(depth[near] + up[near])) - up[i]
    return found
