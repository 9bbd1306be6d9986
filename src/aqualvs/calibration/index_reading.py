"""What an index estimate reports: options, readings, alarms, and what they mean in words."""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from aqualvs.calibration.index_prior import IndexPrior
from aqualvs.calibration.index_state import ANCHOR, POSE, IndexState
from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray

# Beyond so many standard deviations the target is not where it should be.
_MOVED = 4.0
_LOST_FRAMES = 10
# Corners that are off by so many times what was expected of them.
_CROOKED = 2.0
# Fresh water and sea water are 0.008 apart: an index known half as well still says which.
_LARGEST_SIGMA = 4e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class IndexOptions:
    """What is assumed of the target and the medium.

    Attributes
    ----------
    sigma_place : float
        How well the target's place on the vehicle is known, along each axis of `dome`, in metres.
    sigma_turn : float
        The same of its turn about each axis, in radians.
    sigma_corner_px : float
        What a corner is always off, by its printing and its detection.
    drift : float
        Random walk of the index per root second.
    smallest_step : float
        Steps below this ring no alarm.
    largest_sigma : float
        Without a prior, an index known less well than this is called unobservable.

    Raises
    ------
    OptionError
        If a value is negative or not finite.
    """

    sigma_place: float = 0.2e-3
    sigma_turn: float = math.radians(0.1)
    sigma_corner_px: float = 0.05
    drift: float = 1e-5
    smallest_step: float = 3e-4
    largest_sigma: float = 2e-3

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise OptionError(f"{name} is {value:g}; give a number that is not negative")

    @classmethod
    def of_target(cls, place_sigma_mm: float, turn_sigma_deg: float) -> Self:
        """Return the options for a target whose place on the vehicle is known so well.

        An index counts as observable where it still tells fresh water from sea water.
        """
        return cls(
            sigma_place=place_sigma_mm / 1e3,
            sigma_turn=math.radians(turn_sigma_deg),
            largest_sigma=_LARGEST_SIGMA,
        )

    @property
    def pose_sigmas(self) -> FloatArray:
        """Turn and shift of the target, shape (6,)."""
        return np.array([self.sigma_turn] * 3 + [self.sigma_place] * 3)


@dataclass(frozen=True, slots=True)
class IndexStep:
    """A sudden change of the index.

    Attributes
    ----------
    time : float
        Of the first frame after it, in seconds.
    size, sigma : float
        Change of the index and its standard deviation.
    by_medium : bool
        False where the corners moved as no index moves them: then the target or the lens has
        moved, and `size` means nothing.
    """

    time: float
    size: float
    sigma: float
    by_medium: bool

    def text(self) -> str:
        """Return the alarm as one line."""
        if not self.by_medium:
            return (
                f"at {self.time:.1f} s the target or the lens has moved; fix and measure it again"
            )
        return (
            f"at {self.time:.1f} s the index stepped by {self.size:+.4f} ± {self.sigma:.4f}: "
            "other water, a leak or a pollutant"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class IndexReading:
    """What is known of the index after a frame.

    Attributes
    ----------
    name : str
        Of the picture.
    time : float
        In seconds.
    refused : str
        Why the frame was left out; empty where it counts.
    n, sigma : float
        Index of the medium now and its standard deviation, prior included; NaN and infinite
        before the first frame that counts, where there is no prior.
    sigma_random : float
        Part of `sigma` that more frames reduce. Changes are seen to about this.
    n_pictures, sigma_pictures : float
        `n` and `sigma` without the prior.
    n_frame, sigma_frame : float
        From this frame alone, with all constants as they are known by now, and its noise.
    n_points : int
        Corners that counted.
    rms_px : float
        Root mean square residual of their coordinates.
    observable : bool
        Whether the index rests on the pictures: False where they say less than the prior, or,
        without one, less than `IndexOptions.largest_sigma`.
    prior_used : bool
        False without a prior, and where it contradicts the pictures.
    step : IndexStep or None
        The alarm, in the frame that rings it.
    remarks : tuple of str
        What a user should know, one sentence each.
    """

    name: str
    time: float
    refused: str = ""
    n: float
    sigma: float
    sigma_random: float
    n_pictures: float
    sigma_pictures: float
    n_frame: float = math.nan
    sigma_frame: float = math.inf
    n_points: int = 0
    rms_px: float = math.nan
    observable: bool
    prior_used: bool
    step: IndexStep | None = None
    remarks: tuple[str, ...]

    def __bool__(self) -> bool:
        """Whether the frame counted."""
        return not self.refused


@dataclass(frozen=True, slots=True, kw_only=True)
class Knowledge:
    """All that decides whether an index is observable and what is to be said of it.

    Attributes
    ----------
    own, joint : IndexState or None
        Without and with the prior; None before the first frame that counts.
    prior : IndexPrior or None
        As given.
    contradicted : bool
        Whether it disagrees with the pictures.
    since_prior : float
        Variance that the index has gathered since the prior was given, by drift and steps.
    sigma_frame : float
        Noise of the index from one frame.
    decentring : float
        Distance of the lens from the dome's centre, metres.
    n_lost : int
        Frames since the target was last where it should be.
    moved : bool
        Whether a step was none of the medium's.
    n_camera : int
        Uncertain numbers of the camera in the states.
    options : IndexOptions
        As given.
    """

    own: IndexState | None
    joint: IndexState | None
    prior: IndexPrior | None
    contradicted: bool
    since_prior: float
    sigma_frame: float
    decentring: float
    n_lost: int
    moved: bool
    n_camera: int
    options: IndexOptions

    @property
    def observable(self) -> bool:
        """Whether the index rests on the pictures."""
        if self.own is None or self.joint is None or self.moved or self.n_lost >= _LOST_FRAMES:
            return False
        if self.prior is None or self.contradicted:
            return self.own.sigma < self.options.largest_sigma
        alone = math.sqrt(self.prior.sigma**2 + self.since_prior)
        # After a step the prior speaks of another medium; what it taught about the target stays.
        stepped = alone > self.options.largest_sigma
        sigma = self.joint.sigma if stepped else self.own.sigma
        return sigma < min(alone, self.options.largest_sigma)

    def remarks(self) -> tuple[str, ...]:
        """Return what a user should know, one sentence each."""
        found = [self._about_sight(), self._about_prior(), self._about_place()]
        if self.n_lost >= _LOST_FRAMES:
            found.append(
                f"the target has not been where it should be for {self.n_lost} frames: it is "
                "hidden or has moved, and the index is that from before"
            )
        return tuple(remark for remark in found if remark)

    def _about_sight(self) -> str:
        if self.observable or self.own is None or self.moved or self.n_lost >= _LOST_FRAMES:
            return ""
        if self.sigma_frame > self.options.largest_sigma:
            return (
                f"unobservable: the lens is {self.decentring * 1e3:.1f} mm from the dome's centre, "
                "so the picture of the target hardly moves with the index; give temperature and "
                "salinity"
            )
        if self.prior is not None and not self.contradicted:
            return (
                f"unobservable: the pictures alone know the index to {self.own.sigma:.1e}, the "
                f"prior ({self.prior.source}) to {self.prior.sigma:.1e}; changes are still seen"
            )
        return (
            f"unobservable: what is not known of the target's place and of the camera leaves the "
            f"index open by {self.own.sigma:.1e}; measure them better, begin with pictures in "
            "air, or give temperature and salinity; changes are still seen"
        )

    def _about_prior(self) -> str:
        if self.prior is None or self.own is None or not self.contradicted:
            return ""
        n = float(self.own.mean[ANCHOR])
        sigma = math.sqrt(self.own.covariance[ANCHOR, ANCHOR])
        return (
            f"the pictures give {n:.4f} +- {sigma:.4f}, the prior ({self.prior.source}) "
            f"{self.prior.n:.4f} +- {self.prior.sigma:.4f}: a leak, a pollutant, another medium "
            "than the prior's, or a target that is not where target.yaml has it; the prior is "
            "left out"
        )

    def _about_place(self) -> str:
        if self.moved:
            return (
                "the target or the lens has moved: the index cannot be trusted until the target "
                "is measured anew"
            )
        if self.joint is None:
            return ""
        moved = np.abs(self.joint.mean[POSE])
        sigmas = self.options.pose_sigmas
        if np.any(moved > _MOVED * sigmas):
            turn, shift = np.rad2deg(np.linalg.norm(moved[:3])), 1e3 * np.linalg.norm(moved[3:])
            return (
                f"the target seems {shift:.2f} mm and {turn:.2f}° from where target.yaml has it, "
                "more than its place is said to be uncertain"
            )
        corners = self.joint.mean[POSE.stop + self.n_camera :]
        off = float(np.sqrt(np.mean(corners**2))) if len(corners) else 0.0
        if off > _CROOKED * self.options.sigma_corner_px:
            return (
                f"corners are always off by {off:.2f} px, more than was assumed; check the "
                "target's print and the camera's calibration"
            )
        return ""


def contradicts(own: IndexState, prior: IndexPrior, before: bool) -> bool:
    """Return whether pictures and prior disagree; `before` is what this said last.

    They do beyond four standard deviations, and cease to below three.
    """
    apart = abs(float(own.mean[ANCHOR]) - prior.n)
    sigma = math.hypot(math.sqrt(own.covariance[ANCHOR, ANCHOR]), prior.sigma)
    return apart > (3.0 if before else 4.0) * sigma
