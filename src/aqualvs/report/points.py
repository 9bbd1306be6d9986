"""Statistics of a run's points, read once and batch by batch.

One pass gathers counts, histograms and random samples of fixed size, so that memory does not grow
with the dive.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.planes import normals_of
from aqualvs.report.run_data import Track
from aqualvs.results.points import plain_column, points_file, stored_batches
from aqualvs.scanning.scan import Label

_BATCH = 1 << 16
_NEEDED = ("frame", "laser", "u_px", "v_px", "x_m", "y_m", "z_m", "label", "used")
_OPTIONAL = ("quality",)
_NONE = np.empty(0, np.int64)
MAX_LASERS = 16

QUALITY_EDGES = np.linspace(0.0, 1.0, 41)
RESIDUAL_EDGES_MM = np.linspace(-50.0, 50.0, 1001)


class FramePoints(NamedTuple):
    """Stripe points of one sample frame, M of them."""

    # Shape (M,).
    laser: IntArray
    label: IntArray
    # Shape (M,): points that entered the posture: the target points.
    used: BoolArray
    # Shape (M, 2).
    pixels: FloatArray
    # Shape (M, 3): metres.
    points_in_dome: FloatArray


def _counts(bins: int) -> IntArray:
    return np.zeros((MAX_LASERS, bins), dtype=np.int64)


@dataclass(slots=True)
class PointSummary:
    """Statistics of all points of a dive for the report; their size does not grow with the dive."""

    # Shape (n_frames, MAX_LASERS): points that entered the posture, per frame and laser: the target
    # points.
    on_target: IntArray
    # Shape (n_frames,): sum of squared distances of target points from the frame's plane, and their
    # number.
    squares_mm2: FloatArray
    n_squares: IntArray
    # Shape (MAX_LASERS, len(Label)): points per laser and label over the dive.
    labels: IntArray = field(default_factory=lambda: _counts(len(Label)))
    # Shape (MAX_LASERS, bins): histograms of the target points over `QUALITY_EDGES` and
    # `RESIDUAL_EDGES_MM`.
    quality: IntArray = field(default_factory=lambda: _counts(len(QUALITY_EDGES) - 1))
    residual: IntArray = field(default_factory=lambda: _counts(len(RESIDUAL_EDGES_MM) - 1))
    # Shape (K, 3) and (K,): random target points of the dive, at most 15,000, the same ones every
    # time: right of the foot of the perpendicular from the dome's centre, beyond the target plane,
    # and up, in metres. Those of all frames lie on each other, wherever the vehicle was.
    cloud_in_target: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    cloud_laser: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    # Frame number to the points of that frame.
    samples: dict[int, FramePoints] = field(default_factory=dict)

    @property
    def n_lasers(self) -> int:
        """Return one more than the highest laser number that has a point."""
        seen = np.flatnonzero(self.labels.sum(axis=1))
        return int(seen[-1]) + 1 if len(seen) else 0

    def rms_mm(self) -> FloatArray:
        """Return the rms distance of target points from the plane per frame; NaN without any."""
        with np.errstate(invalid="ignore", divide="ignore"):
            rms: FloatArray = np.sqrt(self.squares_mm2 / self.n_squares)
        return rms


def summarize_points(
    run_dir: Path, track: Track, sample_frames: list[int]
) -> tuple[PointSummary | None, str]:
    """Read a run's points once, in batches: `points.parquet`, else the journal of a killed run.

    Returns None where there are no points that can be read; and what is wrong, in words, "" if
    nothing.
    """
    gathered = _Gathered(track, sample_frames)
    try:
        for batch in stored_batches(points_file(run_dir), _BATCH, (*_NEEDED, *_OPTIONAL)):
            gathered.add(_columns(batch))
    except FileNotFoundError:
        return None, "points.parquet is missing: no points are shown."
    except KeyError as absent:
        return None, f"points.parquet has no column {absent}: no points are shown."
    except (pa.ArrowInvalid, OSError):
        return None, "points.parquet cannot be read to its end: no points are shown."
    return gathered.summary, ""


def plane_of_posture(posture: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return unit normals (N, 3) and distances (N,), in m, of postures (N, 3) in m and degrees."""
    return normals_of(np.deg2rad(posture[:, 1]), np.deg2rad(posture[:, 2])), posture[:, 0]


def _columns(batch: Any) -> dict[str, NDArray[Any]]:
    """Return the columns that the report needs.

    Raises `KeyError` naming a column that is absent.
    """
    present = [name for name in _OPTIONAL if name in batch.schema.names]
    return {
        name: plain_column(batch.column(name), labels=name == "label")
        for name in (*_NEEDED, *present)
    }


class _Points(NamedTuple):
    """Points of one batch, N of them; shape (N,)."""

    frame: IntArray
    laser: IntArray
    label: IntArray
    used: NDArray[Any]
    xyz: list[FloatArray]  # In `dome`, in metres.
    uv: list[NDArray[Any]]  # In pixels.


class _Gathered:
    """Points of a dive, batch by batch; those of sample frames are kept."""

    def __init__(self, track: Track, sample_frames: list[int]) -> None:
        n = len(track)
        self.summary = PointSummary(
            on_target=np.zeros((n, MAX_LASERS), np.int64),
            squares_mm2=np.zeros(n),
            n_squares=np.zeros(n, np.int64),
        )
        self._track, self._sample_frames = track, sample_frames
        # Normal and distance of the target in every frame, shape (N, 4), NaN where refused.
        self._planes = np.column_stack(plane_of_posture(track.posture))
        self._planes[~track.valid] = np.nan
        # The points with the smallest of all random keys: a uniform sample of any stream.
        self._keys, self._rng = np.zeros(0), np.random.default_rng(20210126)

    def add(self, batch: dict[str, NDArray[Any]]) -> None:
        """Add one batch, as `_columns` gives it."""
        frame, laser, label = (batch[name].astype(np.int64) for name in ("frame", "laser", "label"))
        xyz = [batch[f"{axis}_m"].astype(np.float64) for axis in "xyz"]
        points = _Points(frame, laser, label, batch["used"], xyz, [batch["u_px"], batch["v_px"]])
        target, row = self._add_counts(points)
        planes = self._planes[row]
        self._add_residuals(points, target, row, planes)
        if "quality" in batch:
            quality = batch["quality"][target].astype(np.float64)
            _count(self.summary.quality, QUALITY_EDGES, laser[target], quality)
        self._keep_samples(points)
        # Points of a frame without a posture have no place in the target's frame.
        known = np.isfinite(planes[:, 3])
        self._grow_cloud(points, target[known], planes[known])

    def _add_counts(self, points: _Points) -> tuple[IntArray, IntArray]:
        """Count points by label and by frame.

        Return the numbers of target points, and the rows of their frames in the track. Points of
        frames that the track has not, or of lasers beyond `MAX_LASERS`, are passed over.
        """
        track, laser = self._track, points.laser
        row = np.minimum(np.searchsorted(track.frame, points.frame), len(track) - 1)
        known = (track.frame[row] == points.frame) & (laser >= 0) & (laser < MAX_LASERS)
        labels = self.summary.labels
        _count_cells(labels, laser[known], np.clip(points.label[known], 0, labels.shape[1] - 1))
        used = points.used.astype(np.bool_)
        target = np.flatnonzero(known & used & np.isfinite(points.xyz).all(axis=0))
        # A batch holds some frames of many.
        row = row[target]
        rows = slice(row.min(initial=len(track)), row.max(initial=0) + 1)
        _count_cells(self.summary.on_target[rows], row - rows.start, laser[target])
        return target, row

    def _add_residuals(
        self, points: _Points, target: IntArray, row: IntArray, plane: FloatArray
    ) -> None:
        """Add the distances of target points from their frames' planes."""
        summary = self.summary
        off_mm = 1e3 * (sum(plane[:, k] * points.xyz[k][target] for k in range(3)) - plane[:, 3])
        known = np.isfinite(off_mm)
        off_mm, row = off_mm[known], row[known]
        first = row.min(initial=len(summary.n_squares))
        squares = np.bincount(row - first, off_mm**2)
        rows = slice(first, first + len(squares))
        summary.squares_mm2[rows] += squares
        summary.n_squares[rows] += np.bincount(row - first)
        _count(summary.residual, RESIDUAL_EDGES_MM, points.laser[target][known], off_mm)

    def _keep_samples(self, points: _Points) -> None:
        """Keep the points of sample frames; a frame may go on in the next batch."""
        frame, laser, samples = points.frame, points.laser, self.summary.samples
        if not len(frame):
            return
        first, last = int(frame.min()), int(frame.max())
        for sample in self._sample_frames:
            mine = np.flatnonzero(frame == sample) if first <= sample <= last else _NONE
            mine = mine[(laser[mine] >= 0) & (laser[mine] < MAX_LASERS)]
            if not len(mine):
                continue
            new = FramePoints(
                laser[mine],
                points.label[mine].clip(0, len(Label) - 1),
                points.used[mine],
                np.stack([axis[mine] for axis in points.uv], axis=-1).astype(np.float64),
                np.stack([axis[mine] for axis in points.xyz], axis=-1),
            )
            if sample in samples:
                new = FramePoints._make(map(np.concatenate, zip(samples[sample], new, strict=True)))
            samples[sample] = new

    def _grow_cloud(self, points: _Points, target: IntArray, planes: FloatArray) -> None:
        drawn = self._rng.random(len(target))
        cloud = 15_000
        if len(self._keys) == cloud:
            # Of many points only the few whose key is small enough are looked at again.
            small = np.flatnonzero(drawn < self._keys.max())
            drawn, target, planes = drawn[small], target[small], planes[small]
        summary, keys = self.summary, np.concatenate([self._keys, drawn])
        places = _in_target(np.stack([axis[target] for axis in points.xyz], axis=-1), planes)
        places = np.concatenate([summary.cloud_in_target, places])
        laser = np.concatenate([summary.cloud_laser, points.laser[target]])
        if len(keys) > cloud:
            kept = np.argpartition(keys, cloud)[:cloud]
            keys, places, laser = keys[kept], places[kept], laser[kept]
        self._keys, summary.cloud_in_target, summary.cloud_laser = keys, places, laser


def _count_cells(counts: IntArray, i: IntArray, j: IntArray) -> None:
    """Add 1 to the cell (i, j) of a table for each of N points."""
    cells = np.bincount(i * counts.shape[1] + j, minlength=counts.size)
    counts += cells.reshape(counts.shape)


def _count(histogram: IntArray, edges: FloatArray, laser: IntArray, values: FloatArray) -> None:
    """Add values to the histogram of their laser; those beyond the edges go to the last bins."""
    finite = np.isfinite(values)
    if not finite.all():
        laser, values = laser[finite], values[finite]
    bins = ((values - edges[0]) / (edges[1] - edges[0])).clip(0, histogram.shape[1] - 1)
    _count_cells(histogram, laser, bins.astype(np.int64))


def _in_target(points: FloatArray, planes: FloatArray) -> FloatArray:
    """Return points in `dome` (N, 3) as those of `PointSummary.cloud_in_target`."""
    n, distance = planes[:, :3], planes[:, 3]
    up = np.array([0.0, 0.0, 1.0]) - n[:, 2:] * n
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    axes = np.stack([np.cross(n, up), n, up], axis=1)
    found = np.einsum("nij,nj->ni", axes, points)
    found[:, 1] -= distance
    return np.asarray(found)
