"""Points and reflections that are said to lie on the net, against those that do."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.scanning.paper_filter import FilteredPoints
from aqualvs.scanning.scan import Label, ScanPoints

# The true points are a sample along the stripe, some 4 px apart.
_SAME_PX, _FOUND_PX = 9.0, 3.0
# True points of one reflection lie no farther apart.
_NEXT_PX = 6.0


class Judged(NamedTuple):
    """Shares between 0 and 1: of what was said to be net, and of what is net."""

    precision: float
    recall: float


@dataclass(frozen=True, slots=True)
class LitTruth:
    """Points that the lasers light and the camera sees, N of them.

    Attributes
    ----------
    pixels : array, shape (N, 2)
    laser : int array, shape (N,)
    on_net : bool array, shape (N,)
    """

    pixels: FloatArray
    laser: IntArray
    on_net: BoolArray

    @classmethod
    def read(cls, path: Path) -> "LitTruth":
        """Read a `points_FFFF.npz` of `simulate_dive`."""
        with np.load(path) as stored:
            net = stored["labels"].tolist().index("net")
            return cls(
                stored["px"], stored["laser"].astype(np.int64), np.asarray(stored["label"] == net)
            )


def judge(points: ScanPoints, truth: LitTruth) -> Judged:
    """Compare the points labelled net with the true points; see `judge_pixels`."""
    said = points.label == Label.NET
    return judge_pixels(points.pixels[said], points.laser[said].astype(np.int64), truth)


def judge_pixels(pixels: FloatArray, laser: IntArray, truth: LitTruth) -> Judged:
    """Compare points that are said to lie on the net with the true points of the same laser.

    A point counts as what the nearest true point within 9 px is; a true point of the net is found
    where such a point lies within 3 px.

    Parameters
    ----------
    pixels : array, shape (N, 2)
    laser : int array, shape (N,)
    truth : LitTruth

    Returns
    -------
    Judged
        Precision is NaN where nothing can be judged, recall where there is no net.
    """
    right = judged = found = true = 0
    for one in np.unique(truth.laser):
        there = truth.laser == one
        said, net = pixels[laser == one], truth.pixels[there & truth.on_net]
        true += len(net)
        if not len(said):
            continue
        distance, nearest = map(np.asarray, cKDTree(truth.pixels[there]).query(said))
        near = distance < _SAME_PX
        judged += int(np.count_nonzero(near))
        right += int(np.count_nonzero(truth.on_net[there][nearest[near]]))
        if len(net):
            gap, _ = cKDTree(said).query(net)
            found += int(np.count_nonzero(gap < _FOUND_PX))
    return Judged(right / judged if judged else np.nan, found / true if true else np.nan)


def judge_reflections(found: FilteredPoints, truth: LitTruth) -> Judged:
    """Compare the reflections that are said to lie on the net with the true ones.

    A reflection is a group of pixels of one laser that touch by sides or corners, and said to lie
    on the net if more than half of its pixels are. It counts as what most of its pixels are, each
    judged by the nearest true point within 9 px. A true reflection is a group of true points of
    one laser and the net, no more than 6 px from one to the next; it is found if pixels of
    reflections that are said to lie on the net lie within 3 px of more than half of its points.

    Parameters
    ----------
    found : FilteredPoints
        All pixels of the frame, and which of them are said to lie on the net.
    truth : LitTruth

    Returns
    -------
    Judged
        As `judge_pixels`.
    """
    right = judged = n_found = n_true = 0
    for one in np.unique(truth.laser):
        there, mine = truth.laser == one, found.laser == one
        net, pixels = truth.pixels[there & truth.on_net], found.pixels[mine]
        group = _groups(net)
        n_true += int(group.max(initial=-1)) + 1
        if not found.on_mesh[mine].any():
            continue
        blob = _blobs(pixels)
        kept = _mostly(found.on_mesh[mine], blob)
        said = kept[blob]
        if not said.any():
            continue
        distance, nearest = map(np.asarray, cKDTree(truth.pixels[there]).query(pixels))
        near = distance < _SAME_PX
        true = _mostly(truth.on_net[there][nearest[near]], blob[near], len(kept))
        known = kept & (np.bincount(blob[near], minlength=len(kept)) > 0)
        judged += int(np.count_nonzero(known))
        right += int(np.count_nonzero(known & true))
        if len(net):
            gap, _ = cKDTree(pixels[said]).query(net)
            n_found += int(np.count_nonzero(_mostly(np.asarray(gap) < _FOUND_PX, group)))
    return Judged(right / judged if judged else np.nan, n_found / n_true if n_true else np.nan)


def _blobs(pixels: FloatArray) -> IntArray:
    """Return the group of each pixel; those of one group touch by sides or corners."""
    if not len(pixels):
        return np.empty(0, np.int64)
    x, y = (np.floor(pixels) - np.floor(pixels).min(axis=0)).astype(np.int64).T
    picture = np.zeros((y.max() + 1, x.max() + 1), np.uint8)
    picture[y, x] = 1
    return np.asarray(cv2.connectedComponents(picture, connectivity=8)[1][y, x] - 1, np.int64)


def _groups(places: FloatArray) -> IntArray:
    """Return the group of each true point; those of one group follow one another."""
    n = len(places)
    if not n:
        return np.empty(0, np.int64)
    first, second = cKDTree(places).query_pairs(_NEXT_PX, output_type="ndarray").T
    graph = coo_array((np.ones(len(first), np.bool_), (first, second)), shape=(n, n))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def _mostly(holds: BoolArray, group: IntArray, n: int = 0) -> BoolArray:
    """Return for each group whether something holds for more than half of its members."""
    total = np.bincount(group, minlength=n)
    return np.asarray(2 * np.bincount(group[holds], minlength=len(total)) > total)


def mean_judged(found: Sequence[Judged]) -> Judged:
    """Return the mean over frames; NaN where no frame says anything."""
    columns = np.array(found, np.float64).reshape(-1, 2)
    said = np.isfinite(columns)
    means = [
        float(column[here].mean()) if here.any() else np.nan
        for column, here in zip(columns.T, said.T, strict=True)
    ]
    return Judged(*means)
