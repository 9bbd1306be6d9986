"""Points that are said to lie on the net, against those that do."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.scanning.scan import Label, ScanPoints

# The true points are a sample along the stripe, some 4 px apart.
_SAME_PX, _FOUND_PX = 9.0, 3.0


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


def mean_judged(found: Sequence[Judged]) -> Judged:
    """Return the mean over frames; NaN where no frame says anything."""
    columns = np.array(found, np.float64).reshape(-1, 2)
    said = np.isfinite(columns)
    means = [
        float(column[here].mean()) if here.any() else np.nan
        for column, here in zip(columns.T, said.T, strict=True)
    ]
    return Judged(*means)
