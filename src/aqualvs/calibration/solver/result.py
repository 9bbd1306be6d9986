"""Results of `calibrate dome` and `calibrate camera`: the solved rig and the fit of each view."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import stdtr

from aqualvs.calibration.solver.bundle import CORNER_SIGMA_PX, Bundle, BundleState
from aqualvs.calibration.solver.least_squares import Solution
from aqualvs.calibration.targets.targets import View
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.rig import Rig, RigUncertainty

# Least number of views in a comparison, and its probability of a false positive.
_MIN_COMPARED, _CHANCE = 3, 0.01


@dataclass(frozen=True, slots=True)
class ViewFit:
    """Fit of one view: pose, residuals and noise."""

    label: str  # Name in messages.
    view: View
    dome_from_target: SE3  # Pose of its target.
    # Shape (6, 6): of the step of `bundle.moved_target`; zero if the pose was exact.
    covariance: FloatArray
    # Shape (N, 2): measured minus predicted pixels; NaN where the target's point cannot be seen.
    residuals: FloatArray
    # Shape (N,): mask of points that were used.
    inliers: BoolArray

    @property
    def rms_px(self) -> float:
        """Root mean square distance of the inliers from their predicted pixels (as OpenCV)."""
        return rms_px(self.residuals[self.inliers])


class FittedViews:
    """Figures of all views of a calibration together."""

    __slots__ = ()
    views: tuple[ViewFit, ...]

    @property
    def rms_px(self) -> float:
        """Root mean square distance of all inliers from their predicted pixels (as OpenCV)."""
        return rms_px(np.concatenate([v.residuals[v.inliers] for v in self.views]))

    @property
    def n_points(self) -> int:
        """Number of inlier corners."""
        return sum(int(np.count_nonzero(v.inliers)) for v in self.views)


class SolvedMedium(NamedTuple):
    """Index of a medium with its uncertainty, 0 if it was taken as exact."""

    name: str
    n: float
    sigma: float


@dataclass(frozen=True, slots=True)
class CrossValidation:
    """Cross-validation of dome and bare lens: prediction of the same unused corners."""

    # Shape (V,): for every view held out, the root mean square distance of its predicted corners
    # with the dome, and with a bare lens of free pose.
    dome_px: FloatArray
    bare_px: FloatArray
    # Shape (V,): numbers of corners that both predicted.
    n_by_view: IntArray

    @property
    def n_views(self) -> int:
        """Number of views held out."""
        return len(self.n_by_view)

    @property
    def n_points(self) -> int:
        """Number of their corners."""
        return int(self.n_by_view.sum())

    @property
    def dome_rms_px(self) -> float:
        """Root mean square distance of all corners with the dome."""
        return float(np.sqrt(np.average(self.dome_px**2, weights=self.n_by_view)))

    @property
    def bare_rms_px(self) -> float:
        """Root mean square distance of all corners with a bare lens."""
        return float(np.sqrt(np.average(self.bare_px**2, weights=self.n_by_view)))

    @property
    def n_dome_better(self) -> int:
        """Number of views that the dome predicts better."""
        return int(np.count_nonzero(self.dome_px < self.bare_px))

    @property
    def p_value(self) -> float:
        """Probability of such an advantage of the dome by chance.

        Student's test of the views' log ratios: errors that both models share cancel in a view, and
        corners of one view are not independent. NaN with fewer than three views.
        """
        if self.n_views < _MIN_COMPARED:
            return float("nan")
        ratios = np.log(self.bare_px / self.dome_px)
        with np.errstate(divide="ignore", invalid="ignore"):
            score = np.mean(ratios) / np.sqrt(np.var(ratios, ddof=1) / len(ratios))
        return float(stdtr(len(ratios) - 1, -score))

    @property
    def dome_is_better(self) -> bool:
        """True if the bare lens is worse, view by view, by more than chance."""
        return self.p_value < _CHANCE


@dataclass(frozen=True, slots=True)
class DomeCalibration(FittedViews):
    """Result of a dome calibration: the solved rig with its uncertainty."""

    rig: Rig  # With lens, rotation, dome and intrinsics as solved; everything else unchanged.
    # Joint covariance of all solved and considered numbers, scaled by the residuals.
    uncertainty: RigUncertainty
    # One for each set.
    media: tuple[SolvedMedium, ...]

    views: tuple[ViewFit, ...]
    # Labels of views, or of their measurements, that were not used, with the reason.
    left_out: dict[str, str]
    # Typical standard deviation of a corner's coordinate.
    noise_px: float
    # Whether boards determined the camera's rotation; if not, it is that of the given rig.
    rotation_is_solved: bool
    # None if not requested, or if there are too few views.
    cross_validation: CrossValidation | None
    # In plain words: what the data determined, and what not.
    findings: tuple[str, ...]


def rms_px(residuals: FloatArray) -> float:
    """Return the root mean square length of residuals (N, 2)."""
    if not len(residuals):
        return float("nan")
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=-1))))


def view_fits(
    labels: Sequence[str], bundle: Bundle, solution: Solution[BundleState], covariance: FloatArray
) -> tuple[ViewFit, ...]:
    """Return the fits of a bundle's views; `covariance` has the bundle's columns."""
    fits = []
    for i, (label, target) in enumerate(zip(labels, bundle.views, strict=True)):
        columns = bundle.pose_columns(i)
        of_pose = covariance[np.ix_(columns, columns)] if len(columns) else np.zeros((6, 6))
        residuals = -CORNER_SIGMA_PX * solution.blocks[i].residuals
        pose, inliers = solution.state.poses[i], solution.inliers[i]
        fits.append(ViewFit(label, target.view, pose, of_pose, residuals, inliers))
    return tuple(fits)
