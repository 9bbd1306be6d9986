"""State of the index estimate: index and constants of rig and target, jointly Gaussian.

With it: the prior of a medium's index, before a camera has looked at it (`IndexPrior`, from air or
from temperature and salinity), and the options, readings and alarms that an estimate reports.

A jump of the index is detected by a two-sided cumulative sum over the normalised innovations of the
frames (`CusumTest`; Page 1954, Continuous inspection schemes, Biometrika 41, 100,
doi:10.1093/biomet/41.1-2.100).
"""

import math
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from aqualvs.errors import OptionError, check_not_negative
from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.water import (
    GREEN_NM,
    GREEN_SIGMA_NM,
    N_AIR,
    seawater_index_slopes,
    seawater_index_vacuum,
)


@dataclass(frozen=True, slots=True)
class IndexPrior:
    """Prior of a refractive index.

    Raises `OptionError` if the index is impossible or sigma is not positive.
    """

    n: float  # Relative to vacuum.
    sigma: float  # Standard deviation, positive.
    source: str = "given"  # Its origin, for reports.

    def __post_init__(self) -> None:
        if not 1.0 <= self.n <= 2.0:
            raise OptionError(
                f"index prior is {self.n:g}; give the medium's index relative to vacuum, 1 to 2"
            )
        if not (math.isfinite(self.sigma) and self.sigma > 0.0):
            raise OptionError(
                f"index prior has sigma {self.sigma:g}; give a positive standard deviation"
            )

    @classmethod
    def air(cls, n_air: float = N_AIR) -> "IndexPrior":
        """Return the prior of air: a vehicle on deck that looks at its target learns from it.

        The accuracy that target place and lens reach with this index is kept when the vehicle goes
        into the water.
        """
        # Air's index less one goes with its density: 3 K or 10 hPa change it by 1 %, 3e-6.
        sigma_air = 1e-5
        return cls(n_air, sigma_air, "air")

    @classmethod
    def seawater(
        cls, temperature_c: float, salinity_permille: float, *, n_air: float = N_AIR
    ) -> "IndexPrior":
        """Return the prior from temperature and salinity, by Quan & Fry (1995).

        The target is seen in green or white light.

        Parameters
        ----------
        temperature_c, salinity_permille : float
            0 to 30 degrees Celsius and 0 to 40 per mille.
        n_air : float
            Index of air relative to vacuum, a factor on the formula.

        Raises
        ------
        OptionError
            If a value lies outside the formula's range.
        """
        # Standard deviations. The last is of the fit of Quan & Fry (1995) to its data.
        sigma_c, sigma_permille, sigma_formula = 0.5, 0.5, 1.5e-5
        step_nm = 1.0
        n = float(seawater_index_vacuum(temperature_c, salinity_permille))
        slopes = seawater_index_slopes(temperature_c, salinity_permille)
        beside = seawater_index_vacuum(temperature_c, salinity_permille, GREEN_NM + step_nm)
        parts = (
            float(slopes.by_temperature) * sigma_c,
            float(slopes.by_salinity) * sigma_permille,
            (float(beside) - n) / step_nm * GREEN_SIGMA_NM,
            sigma_formula,
        )
        source = f"{temperature_c:g} °C, {salinity_permille:g} per mille"
        return cls(n / N_AIR * n_air, math.hypot(*parts), source)


N, ANCHOR, BEFORE = 0, 1, 2
"""Present index; index at the first frame, of which the prior is; index before the last step."""
N_INDICES = 3
POSE = slice(3, 9)
FIRST_CAMERA = 9
WIDE = 0.2
"""Standard deviation of an unknown index, or of one that has just jumped."""
FAR = 0.02
"""Change of the index from which derivatives are taken anew."""


@dataclass(frozen=True, slots=True)
class IndexState:
    """State of the estimate, a joint Gaussian; immutable."""

    time: float  # Of the last frame, in seconds.
    # Shape (D,): three indices (`N`, `ANCHOR`, `BEFORE`); errors of the target's place: a turn
    # about its middle (radians) and a shift (metres) in `dome`; errors of the camera's numbers; and
    # for each corner, the constant error of its pixel (x and y).
    mean: FloatArray
    # Shape (D, D).
    covariance: FloatArray
    # Corners with such entries, in order.
    ids: tuple[int, ...]
    # Of the index now if all constants were known: the part that more frames reduce.
    random_variance: float
    # Index at which derivatives are taken, see `IndexModel.line`.
    n_of_slopes: float
    # Shape (K, 2): pixels of the corners for which their errors are valid; NaN before the first.
    seen_at: FloatArray

    @property
    def n(self) -> float:
        """Index now."""
        return float(self.mean[N])

    @property
    def sigma(self) -> float:
        """Standard deviation of `n`."""
        return float(np.sqrt(self.covariance[N, N]))

    @property
    def step(self) -> tuple[float, float]:
        """Change of the index at the last step, and its standard deviation.

        Errors of the constants that shift both indices alike cancel.
        """
        c = self.covariance
        variance = c[N, N] + c[BEFORE, BEFORE] - 2.0 * c[N, BEFORE]
        return float(self.mean[N] - self.mean[BEFORE]), float(np.sqrt(max(variance, 0.0)))

    def later(self, time: float, drift: float) -> "IndexState":
        """Return the state at another time: a random walk of the index, `drift` per root second."""
        grown = drift**2 * max(time - self.time, 0.0)
        covariance = self.covariance.copy()
        covariance[N, N] += grown
        return replace(
            self, time=time, covariance=covariance, random_variance=self.random_variance + grown
        )

    def stepped(self, n: float) -> "IndexState":
        """Return the state after the index has jumped to about `n`; the constants stay known."""
        mean, covariance = self.mean.copy(), self.covariance.copy()
        mean[BEFORE], mean[N] = mean[N], n
        covariance[BEFORE] = covariance[N]
        covariance[:, BEFORE] = covariance[:, N]
        covariance[N, N] += WIDE**2
        return replace(
            self, mean=mean, covariance=covariance, random_variance=self.random_variance + WIDE**2
        )

    def with_corners(self, ids: tuple[int, ...], sigma_px: float) -> "IndexState":
        """Return the state with entries for new corners."""
        new = tuple(i for i in ids if i not in self.ids)
        if not new:
            return self
        size, more = len(self.mean), 2 * len(new)
        covariance = np.zeros((size + more, size + more))
        covariance[:size, :size] = self.covariance
        covariance[size:, size:] = sigma_px**2 * np.eye(more)
        return replace(
            self,
            mean=np.concatenate([self.mean, np.zeros(more)]),
            covariance=covariance,
            ids=self.ids + new,
            seen_at=np.concatenate([self.seen_at, np.full((len(new), 2), np.nan)]),
        )

    def with_corners_at(
        self, ids: tuple[int, ...], pixels: FloatArray, sigma_px: float
    ) -> "IndexState":
        """Return the state with corner errors valid at the pixels of the corners.

        The error of a detector depends on the place of a corner within its pixel: after a motion of
        the picture by a good part of a pixel, new errors replace the old ones.

        Parameters
        ----------
        ids : tuple of int
            Corners of a picture, all known.
        pixels : array, shape (M, 2)
            Their predicted places.
        sigma_px : float
            Standard deviation of the errors.
        """
        rows = [self.ids.index(i) for i in ids]
        moved = pixels - self.seen_at[rows]
        known = np.isfinite(moved[:, 0])
        way = float(np.linalg.norm(np.median(moved[known], axis=0))) if np.any(known) else 0.0
        state, seen_at = self, self.seen_at.copy()
        # Correlation length of corners' errors over the motion of the picture, and motion below
        # which errors are kept.
        same_px, still_px = 0.4, 0.1
        if way > still_px:
            kept = math.exp(-((way / same_px) ** 2))
            mean, covariance = self.mean.copy(), self.covariance.copy()
            first = len(mean) - 2 * len(self.ids)
            mean[first:] *= kept
            covariance[first:] *= kept
            covariance[:, first:] *= kept
            corners = np.arange(first, len(mean))
            covariance[corners, corners] += (1.0 - kept**2) * sigma_px**2
            state = replace(self, mean=mean, covariance=covariance)
            seen_at[:] = np.nan
        fresh = ~np.isfinite(seen_at[rows, 0])
        seen_at[np.array(rows)[fresh]] = pixels[fresh]
        return replace(state, seen_at=seen_at)

    def given_anchor(self, n: float, sigma: float) -> "IndexState":
        """Return the state after a Kalman update of the anchor with `n` and `sigma`."""
        reach = self.covariance[:, ANCHOR]
        variance = reach[ANCHOR] + sigma**2
        return replace(
            self,
            mean=self.mean + reach * ((n - self.mean[ANCHOR]) / variance),
            covariance=self.covariance - np.outer(reach, reach) / variance,
        )


def first_state(time: float, n: float, pose_sigmas: FloatArray, camera: FloatArray) -> IndexState:
    """Return the state before any frame.

    Parameters
    ----------
    time : float
        In seconds.
    n : float
        Initial guess of the index.
    pose_sigmas : array, shape (6,)
        Of the target's place: turn (radians) and shift (metres).
    camera : array, shape (C, C)
        Covariance of the camera's numbers.
    """
    size = FIRST_CAMERA + len(camera)
    mean, covariance = np.zeros(size), np.zeros((size, size))
    mean[:N_INDICES] = n
    covariance[:N_INDICES, :N_INDICES] = WIDE**2
    covariance[POSE, POSE] = np.diag(np.asarray(pose_sigmas) ** 2)
    covariance[FIRST_CAMERA:, FIRST_CAMERA:] = camera
    return IndexState(time, mean, covariance, (), WIDE**2, n, np.zeros((0, 2)))


@dataclass(frozen=True, slots=True, kw_only=True)
class IndexOptions:
    """Options: assumptions about target and medium.

    Raises `OptionError` if a value is negative or not finite.
    """

    # Standard deviation of the target's place on the vehicle, along each axis of `dome`, in metres.
    sigma_place: float = 0.2e-3
    # The same of its turn about each axis, in radians.
    sigma_turn: float = math.radians(0.1)
    # Standard deviation of a corner's constant error, by its printing and its detection.
    sigma_corner_px: float = 0.05
    # Random walk of the index per root second.
    drift: float = 1e-5
    # Smallest step that raises an alarm.
    smallest_step: float = 3e-4
    # Without a prior, an index known less well than this is called unobservable.
    largest_sigma: float = 2e-3

    def __post_init__(self) -> None:
        check_not_negative("water index", self, *self.__slots__)

    @classmethod
    def of_target(cls, place_sigma_mm: float = 0.2, turn_sigma_deg: float = 0.1) -> Self:
        """Return the options for a target with given uncertainties of its place on the vehicle.

        The defaults are the accuracy of a user's measurement, as in `aqualvs calibrate water`. An
        index counts as observable if it separates fresh water from sea water.
        """
        # Fresh water and sea water differ by 0.008: an index known to half of that still separates
        # them.
        largest_sigma = 4e-3
        return cls(
            sigma_place=place_sigma_mm / 1e3,
            sigma_turn=math.radians(turn_sigma_deg),
            largest_sigma=largest_sigma,
        )

    @property
    def pose_sigmas(self) -> FloatArray:
        """Standard deviations of turn and shift of the target, shape (6,)."""
        return np.array([self.sigma_turn] * 3 + [self.sigma_place] * 3)


@dataclass(frozen=True, slots=True)
class IndexStep:
    """A sudden change of the index."""

    time: float  # Of the first frame after it, in seconds.
    # Change of the index and its standard deviation.
    size: float
    sigma: float
    # False if no change of index explains the corners' motion: then the target or the lens has
    # moved, and `size` means nothing.
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
    """Estimate of the index after a frame."""

    name: str  # Of the picture.
    time: float  # In seconds.
    refused: str = ""  # Reason why the frame was left out; empty for a used one.
    # Present index of the medium and its standard deviation, prior included; NaN and infinite
    # before the first used frame without a prior.
    n: float
    sigma: float
    # Part of `sigma` that more frames reduce; about the smallest visible change.
    sigma_random: float
    # `n` and `sigma` without the prior.
    n_pictures: float
    sigma_pictures: float
    # From this frame alone, with the present constants, and its noise.
    n_frame: float = math.nan
    sigma_frame: float = math.inf
    # Number of used corners.
    n_points: int = 0
    # Root mean square residual of their coordinates.
    rms_px: float = math.nan
    # Whether the pictures determine the index: False if they give less information than the prior,
    # or, without one, than `IndexOptions.largest_sigma`.
    observable: bool
    # False without a prior, and if it contradicts the pictures.
    prior_used: bool
    # The alarm, in the frame that raises it.
    step: IndexStep | None = None
    # Remarks for the user, one sentence each.
    remarks: tuple[str, ...]

    def __bool__(self) -> bool:
        """Return whether the frame was used."""
        return not self.refused


@dataclass(slots=True)
class CusumTest:
    """Two-sided cumulative sum (CUSUM) test of the innovations of frames."""

    # Standard deviation of the innovations over blocks of frames, at least 1: factor on the noise
    # of corners, because the errors of neighbouring corners and frames are correlated.
    inflation: float = 1.0

    _sums: list[float] = field(default_factory=lambda: [0.0, 0.0])
    _lengths: list[int] = field(default_factory=lambda: [0, 0])
    _block: list[float] = field(default_factory=list)
    _n_blocks: int = 0

    def add(self, standardised: float) -> int:
        """Add the innovation of a frame, in standard deviations.

        Returns the number of frames since the start of the change, this one included, if it raises
        the alarm; else 0.
        """
        # Change to be detected: one standard deviation of a frame.
        allowance = 0.5
        # Independent normal innovations give a false alarm every exp(2 * 0.5 * 21) frames: years at
        # 25 fps.
        limit = 20.0
        # Limit of a single frame, so that one wrong picture raises no alarm; four in a row do.
        largest = 7.0
        for side, sign in enumerate((1.0, -1.0)):
            bounded = min(max(sign * standardised, -largest), largest)
            total = max(self._sums[side] + bounded - allowance, 0.0)
            self._sums[side] = total
            self._lengths[side] = self._lengths[side] + 1 if total > 0.0 else 0
            if total > limit:
                began = self._lengths[side]
                # As after a jump; the inflation stays.
                self._sums, self._lengths, self._block = [0.0, 0.0], [0, 0], []
                return began
        self._spread(standardised)
        return 0

    def _spread(self, standardised: float) -> None:
        self._block.append(standardised)
        # Compression repeats its errors over a group of pictures: frames are correlated that long.
        block = 12
        memory = 100
        if len(self._block) < block:
            return
        self._n_blocks += 1
        square = min(float(np.sum(self._block)) ** 2 / block, 9.0)
        share = 1.0 / min(self._n_blocks + 8, memory)
        # Innovations are in units of the inflated noise: a spread above 1 raises the inflation.
        squared = self.inflation**2 * (1.0 + share * (square - 1.0))
        self.inflation = float(np.sqrt(min(max(squared, 1.0), 100.0)))
        self._block = []
