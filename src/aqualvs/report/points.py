"""Statistics of a run's points, read once and batch by batch.

One pass gathers counts, histograms and random samples of fixed size, so that memory does not grow
with the dive.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

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


@dataclass(frozen=True, slots=True)
class FramePoints:
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
    summary = _empty(track)
    rng = np.random.default_rng(20210126)
    keys = np.zeros(0)
    planes = _planes(track)
    try:
        for batch in _batches(run_dir):
            keys = _add(summary, batch, track, planes, sample_frames, keys, rng)
    except FileNotFoundError:
        return None, "points.parquet is missing: no points are shown."
    except KeyError as absent:
        return None, f"points.parquet has no column {absent}: no points are shown."
    except (pa.ArrowInvalid, OSError):
        return None, "points.parquet cannot be read to its end: no points are shown."
    return summary, ""


def plane_of_posture(posture: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return unit normals (N, 3) and distances (N,), in m, of postures (N, 3) in m and degrees."""
    return normals_of(np.deg2rad(posture[:, 1]), np.deg2rad(posture[:, 2])), posture[:, 0]


def _planes(track: Track) -> FloatArray:
    """Return normal and distance of the target in every frame, shape (N, 4), NaN where refused."""
    normal, distance = plane_of_posture(track.posture)
    planes = np.column_stack([normal, distance])
    planes[~track.valid] = np.nan
    return planes


def _counts(bins: int) -> IntArray:
    return np.zeros((MAX_LASERS, bins), dtype=np.int64)


def _empty(track: Track) -> PointSummary:
    n = len(track)
    return PointSummary(
        on_target=np.zeros((n, MAX_LASERS), dtype=np.int64),
        squares_mm2=np.zeros(n),
        n_squares=np.zeros(n, dtype=np.int64),
    )


def _batches(run_dir: Path) -> Iterator[dict[str, NDArray[Any]]]:
    """Yield batches as arrays by column, labels as numbers."""
    path = points_file(run_dir)
    yield from map(_columns, stored_batches(path, _BATCH, (*_NEEDED, *_OPTIONAL)))


def _columns(batch: Any) -> dict[str, NDArray[Any]]:
    """Return the columns that the report needs.

    Raises `KeyError` naming a column that is absent.
    """
    present = [name for name in _OPTIONAL if name in batch.schema.names]
    return {
        name: plain_column(batch.column(name), labels=name == "label")
        for name in (*_NEEDED, *present)
    }


def _add(
    summary: PointSummary,
    batch: dict[str, NDArray[Any]],
    track: Track,
    planes: FloatArray,
    sample_frames: list[int],
    keys: FloatArray,
    rng: np.random.Generator,
) -> FloatArray:
    """Add one batch; returns the sampling keys of the cloud as it now is."""
    frame, laser, label = (batch[name].astype(np.int64) for name in ("frame", "laser", "label"))
    xyz = [batch[f"{axis}_m"].astype(np.float64) for axis in "xyz"]
    target, row = _add_counts(summary, batch["used"], frame, laser, label, xyz, track)
    _add_residuals(summary, laser[target], row, [axis[target] for axis in xyz], planes[row])
    if "quality" in batch:
        quality = batch["quality"][target].astype(np.float64)
        _count(summary.quality, QUALITY_EDGES, laser[target], quality)
    _keep_samples(summary, batch, frame, laser, label, xyz, sample_frames)
    # Points of a frame without a posture have no place in the target's frame.
    of_frames = planes[row]
    known = np.isfinite(of_frames[:, 3])
    return _grow_cloud(summary, xyz, laser, target[known], of_frames[known], keys, rng)


def _add_counts(
    summary: PointSummary,
    used: NDArray[Any],
    frame: IntArray,
    laser: IntArray,
    label: IntArray,
    xyz: list[FloatArray],
    track: Track,
) -> tuple[IntArray, IntArray]:
    """Count points by label and by frame.

    Return the numbers of target points, and the rows of their frames in the track. Points of
    frames that the track has not, or of lasers beyond `MAX_LASERS`, are passed over.
    """
    row = np.minimum(np.searchsorted(track.frame, frame), len(track) - 1)
    known = (track.frame[row] == frame) & (laser >= 0) & (laser < MAX_LASERS)
    n_labels = summary.labels.shape[1]
    _count_cells(summary.labels, laser[known], np.clip(label[known], 0, n_labels - 1))
    target = np.flatnonzero(known & used.astype(np.bool_) & np.isfinite(xyz).all(axis=0))
    # A batch holds some frames of many.
    row = row[target]
    rows = slice(row.min(initial=len(track)), row.max(initial=0) + 1)
    _count_cells(summary.on_target[rows], row - rows.start, laser[target])
    return target, row


def _add_residuals(
    summary: PointSummary, laser: IntArray, row: IntArray, xyz: list[FloatArray], plane: FloatArray
) -> None:
    """Add the distances of target points from their frames' planes."""
    off_mm = 1e3 * (sum(plane[:, k] * xyz[k] for k in range(3)) - plane[:, 3])
    known = np.isfinite(off_mm)
    off_mm, row = off_mm[known], row[known]
    first = row.min(initial=len(summary.n_squares))
    squares = np.bincount(row - first, off_mm**2)
    rows = slice(first, first + len(squares))
    summary.squares_mm2[rows] += squares
    summary.n_squares[rows] += np.bincount(row - first)
    _count(summary.residual, RESIDUAL_EDGES_MM, laser[known], off_mm)


def _count_cells(counts: IntArray, i: IntArray, j: IntArray) -> None:
    """Add 1 to the cell (i, j) of a table for each of N points."""
    cells = np.bincount(i * counts.shape[1] + j, minlength=counts.size)
    counts += cells.reshape(counts.shape)


def _keep_samples(
    summary: PointSummary,
    batch: dict[str, NDArray[Any]],
    frame: IntArray,
    laser: IntArray,
    label: IntArray,
    xyz: list[FloatArray],
    sample_frames: list[int],
) -> None:
    """Keep the points of sample frames; a frame may go on in the next batch."""
    if not len(frame):
        return
    first, last = int(frame.min()), int(frame.max())
    for sample in sample_frames:
        mine = np.flatnonzero(frame == sample) if first <= sample <= last else _NONE
        mine = mine[(laser[mine] >= 0) & (laser[mine] < MAX_LASERS)]
        if not len(mine):
            continue
        new = FramePoints(
            laser[mine],
            label[mine].clip(0, len(Label) - 1),
            batch["used"][mine],
            np.stack([batch["u_px"][mine], batch["v_px"][mine]], axis=-1).astype(np.float64),
            np.stack([axis[mine] for axis in xyz], axis=-1),
        )
        old = summary.samples.get(sample)
        if old is not None:
            names = new.__dataclass_fields__
            new = FramePoints(*(np.concatenate([getattr(p, n) for p in (old, new)]) for n in names))
        summary.samples[sample] = new


def _count(histogram: IntArray, edges: FloatArray, laser: IntArray, values: FloatArray) -> None:
    """Add values to the histogram of their laser; those beyond the edges go to the last bins."""
    finite = np.isfinite(values)
    if not finite.all():
        laser, values = laser[finite], values[finite]
    bins = ((values - edges[0]) / (edges[1] - edges[0])).clip(0, histogram.shape[1] - 1)
    _count_cells(histogram, laser, bins.astype(np.int64))


def _grow_cloud(
    summary: PointSummary,
    xyz: list[FloatArray],
    laser: IntArray,
    target: IntArray,
    planes: FloatArray,
    keys: FloatArray,
    rng: np.random.Generator,
) -> FloatArray:
    """Keep the points with the smallest of all random keys: a uniform sample of any stream."""
    drawn = rng.random(len(target))
    cloud = 15_000
    if len(keys) == cloud:
        # Of many points only the few whose key is small enough are looked at again.
        small = np.flatnonzero(drawn < keys.max())
        drawn, target, planes = drawn[small], target[small], planes[small]
    keys = np.concatenate([keys, drawn])
    points = _in_target(np.stack([axis[target] for axis in xyz], axis=-1), planes)
    points = np.concatenate([summary.cloud_in_target, points])
    laser = np.concatenate([summary.cloud_laser, laser[target]])
    if len(keys) > cloud:
        kept = np.argpartition(keys, cloud)[:cloud]
        keys, points, laser = keys[kept], points[kept], laser[kept]
    summary.cloud_in_target, summary.cloud_laser = points, laser
    return keys


def _in_target(points: FloatArray, planes: FloatArray) -> FloatArray:
    """Return points in `dome` (N, 3) as those of `PointSummary.cloud_in_target`."""
    n, distance = planes[:, :3], planes[:, 3]
    up = np.array([0.0, 0.0, 1.0]) - n[:, 2:] * n
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    axes = np.stack([np.cross(n, up), n, up], axis=1)
    found = np.einsum("nij,nj->ni", axes, points)
    found[:, 1] -= distance
    return np.asarray(found)
