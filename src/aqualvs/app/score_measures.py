"""Scores: how often, how well and how honestly a system answered."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aqualvs.app.score_results import Answers
from aqualvs.app.score_set import DiveTruth
from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.simulation.visible import VISIBLE_LIMIT

WRONG_PERCENT = 5.0
"""An answer whose range is off by more is to something else than the target."""


@dataclass(frozen=True, slots=True)
class Frames:
    """Answers against the truth of N frames, of one dive or of many.

    Attributes
    ----------
    valid : bool array, shape (N,)
        Frames with an answer.
    n_visible : array, shape (N,)
        Visible stripe points.
    error : array, shape (N, 3)
        Range in percent of the true one, pitch and yaw in degrees; NaN without answer or target.
    sigma : array, shape (N, 3)
        What the system claims for them, same units.
    """

    valid: BoolArray
    n_visible: FloatArray
    error: FloatArray
    sigma: FloatArray

    @property
    def measurable(self) -> BoolArray:
        """Frames that show enough to be measured, and must be."""
        enough: BoolArray = self.n_visible >= VISIBLE_LIMIT
        return enough


@dataclass(frozen=True, slots=True)
class Spread:
    """Absolute errors in few numbers; NaN without any."""

    rms: float
    median: float
    p95: float
    max: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """How a system did in some frames.

    Attributes
    ----------
    n_frames, n_measurable, n_available : int
        Frames; those with at least `VISIBLE_LIMIT` visible stripe points; those of them with an
        answer.
    available_percent : float
        Share of the last two; NaN where nothing is measurable.
    range_percent, pitch_deg, yaw_deg : Spread
        Errors of the answers in measurable frames.
    n_wrong : int
        Answers off by more than `WRONG_PERCENT` of the range in frames with any visible point.
    n_empty, n_false : int
        Frames without any visible point, and those of them that were answered all the same.
    z_range, z_pitch, z_yaw : float
        Rms of error over claimed sigma in measurable frames: 1 is honest, more is too sure; NaN
        where no sigma is claimed.
    sigma_range_percent, sigma_pitch_deg, sigma_yaw_deg : float
        Medians of the claimed sigmas in measurable frames.
    """

    n_frames: int
    n_measurable: int
    n_available: int
    available_percent: float
    range_percent: Spread
    pitch_deg: Spread
    yaw_deg: Spread
    n_wrong: int
    n_empty: int
    n_false: int
    z_range: float
    z_pitch: float
    z_yaw: float
    sigma_range_percent: float
    sigma_pitch_deg: float
    sigma_yaw_deg: float


def compare(truth: DiveTruth, answers: Answers) -> Frames:
    """Hold the answers to a dive against its truth."""
    shown = np.where(answers.valid[:, None], answers.posture, np.nan)
    error = shown - truth.posture
    scale = 100.0 / truth.posture[:, 0]
    error[:, 0] *= scale
    sigma = np.where(answers.valid[:, None], answers.sigma, np.nan)
    sigma[:, 0] *= scale
    return Frames(answers.valid, truth.n_visible.astype(np.float64), error, sigma)


def pooled(parts: Sequence[Frames]) -> Frames:
    """Return the frames of several dives as one."""
    return Frames(
        np.concatenate([part.valid for part in parts]),
        np.concatenate([part.n_visible for part in parts]),
        np.concatenate([part.error for part in parts]),
        np.concatenate([part.sigma for part in parts]),
    )


def score(frames: Frames) -> Score:
    """Return the score of some frames."""
    measurable, empty = frames.measurable, frames.n_visible == 0
    n_measurable, n_available = int(measurable.sum()), int((measurable & frames.valid).sum())
    off = np.abs(frames.error[:, 0]) > WRONG_PERCENT
    error, sigma = frames.error[measurable], frames.sigma[measurable]
    z = [_normalised(error[:, k], sigma[:, k]) for k in range(3)]
    middle = [_median(sigma[:, k]) for k in range(3)]
    return Score(
        n_frames=len(frames.valid),
        n_measurable=n_measurable,
        n_available=n_available,
        available_percent=100.0 * n_available / n_measurable if n_measurable else np.nan,
        range_percent=_spread(error[:, 0]),
        pitch_deg=_spread(error[:, 1]),
        yaw_deg=_spread(error[:, 2]),
        n_wrong=int((off & ~empty).sum()),
        n_empty=int(empty.sum()),
        n_false=int((empty & frames.valid).sum()),
        z_range=z[0],
        z_pitch=z[1],
        z_yaw=z[2],
        sigma_range_percent=middle[0],
        sigma_pitch_deg=middle[1],
        sigma_yaw_deg=middle[2],
    )


def bars_against(frames: Frames, clear: Frames) -> FloatArray:
    """Return how much longer error bars are than those of the same frames in clear water.

    Parameters
    ----------
    frames, clear : Frames
        Frame by frame the same course before the same target.

    Returns
    -------
    ratios : array, shape (N, 3)
        Sigma of range (in percent), pitch and yaw over that in clear water; NaN where a frame is
        not measurable or lacks one.
    """
    both = frames.measurable & clear.measurable
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(both[:, None], frames.sigma / clear.sigma, np.nan)


def _spread(errors: FloatArray) -> Spread:
    sizes = np.abs(errors[np.isfinite(errors)])
    if not len(sizes):
        return Spread(np.nan, np.nan, np.nan, np.nan)
    rms = float(np.sqrt(np.mean(sizes**2)))
    return Spread(
        rms, float(np.median(sizes)), float(np.percentile(sizes, 95.0)), float(sizes.max())
    )


def _normalised(errors: FloatArray, sigmas: FloatArray) -> float:
    known = np.isfinite(errors) & (sigmas > 0.0)
    if not known.any():
        return np.nan
    return float(np.sqrt(np.mean((errors[known] / sigmas[known]) ** 2)))


def _median(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else np.nan
