"""What an index estimate knows: the index and the constants of rig and target, jointly Gaussian."""

import math
from dataclasses import dataclass, replace

import numpy as np

from aqualvs.geometry.arrays import FloatArray

N, ANCHOR, BEFORE = 0, 1, 2
"""Index now; when the prior was given; before the last step."""
N_INDICES = 3
POSE = slice(3, 9)
FIRST_CAMERA = 9
FAR = 0.02
"""Changes of the index from which on slopes are taken anew."""

# Motion of the picture over which corners' errors stay the same, and up to which nobody asks.
_SAME_PX, _STILL_PX = 0.4, 0.1


@dataclass(frozen=True, slots=True)
class IndexState:
    """A joint Gaussian; never changed in place.

    Attributes
    ----------
    time : float
        Of the last frame, in seconds.
    mean : array, shape (D,)
        Three indices (`N`, `ANCHOR`, `BEFORE`); errors of the target's place: a turn about its
        middle (radians) and a shift (metres) in `dome`; errors of the camera's numbers; and for
        each corner, what its pixel is always off (x and y).
    covariance : array, shape (D, D)
    ids : tuple of int
        Corners that have such entries, in their order.
    random_variance : float
        Of the index now if all constants were known: the part that more frames reduce.
    n_of_slopes : float
        Index for which derivatives are taken, see `IndexModel.line`.
    seen_at : array, shape (K, 2)
        Pixels of the corners at which their own errors hold; NaN where nothing holds yet.
    """

    time: float
    mean: FloatArray
    covariance: FloatArray
    ids: tuple[int, ...]
    random_variance: float
    n_of_slopes: float
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
        """Index now less that before the last step, and its standard deviation.

        Constants that shift both alike cancel.
        """
        c = self.covariance
        variance = c[N, N] + c[BEFORE, BEFORE] - 2.0 * c[N, BEFORE]
        return float(self.mean[N] - self.mean[BEFORE]), float(np.sqrt(max(variance, 0.0)))

    def later(self, time: float, drift: float) -> "IndexState":
        """Return the state at another time, the index a random walk of `drift` per root second."""
        grown = drift**2 * max(time - self.time, 0.0)
        covariance = self.covariance.copy()
        covariance[N, N] += grown
        return replace(
            self,
            time=time,
            covariance=covariance,
            random_variance=self.random_variance + grown,
        )

    def anchored(self) -> "IndexState":
        """Return the state with the index now kept as that which a prior speaks of."""
        return self._copied(ANCHOR)

    def stepped(self, n: float, sigma: float) -> "IndexState":
        """Return the state after the index has jumped to about `n`; the constants stay known."""
        kept = self._copied(BEFORE)
        mean, covariance = kept.mean.copy(), kept.covariance
        mean[N] = n
        covariance[N, N] += sigma**2
        return replace(
            kept, mean=mean, covariance=covariance, random_variance=self.random_variance + sigma**2
        )

    def with_slopes_near(self) -> "IndexState":
        """Return the state with derivatives taken anew if the index has gone far since."""
        if abs(self.n - self.n_of_slopes) <= FAR:
            return self
        return replace(self, n_of_slopes=self.n)

    def with_corners(self, ids: tuple[int, ...], sigma_px: float) -> "IndexState":
        """Return the state with entries for corners that it does not know yet."""
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
        """Return the state with corners' errors that hold where the corners are seen.

        What a detector is off depends on where in its pixel a corner lies: where the picture has
        moved by a good part of a pixel, fresh errors replace the old ones.

        Parameters
        ----------
        ids : tuple of int
            Corners of a picture, all known.
        pixels : array, shape (M, 2)
            Where they are predicted.
        sigma_px : float
            Standard deviation of the errors.
        """
        rows = [self.ids.index(i) for i in ids]
        moved = pixels - self.seen_at[rows]
        known = np.isfinite(moved[:, 0])
        way = float(np.linalg.norm(np.median(moved[known], axis=0))) if np.any(known) else 0.0
        state, seen_at = self, self.seen_at.copy()
        if way > _STILL_PX:
            kept = math.exp(-((way / _SAME_PX) ** 2))
            state = self._with_corners_renewed(kept, sigma_px)
            seen_at[:] = np.nan
        fresh = ~np.isfinite(seen_at[rows, 0])
        seen_at[np.array(rows)[fresh]] = pixels[fresh]
        return replace(state, seen_at=seen_at)

    def _with_corners_renewed(self, kept: float, sigma_px: float) -> "IndexState":
        mean, covariance = self.mean.copy(), self.covariance.copy()
        first = len(mean) - 2 * len(self.ids)
        mean[first:] *= kept
        covariance[first:] *= kept
        covariance[:, first:] *= kept
        rows = np.arange(first, len(mean))
        covariance[rows, rows] += (1.0 - kept**2) * sigma_px**2
        return replace(self, mean=mean, covariance=covariance)

    def given_anchor(self, n: float, sigma: float) -> "IndexState":
        """Return the state if the anchor is known to be `n` within `sigma` (a Kalman update)."""
        reach = self.covariance[:, ANCHOR]
        variance = reach[ANCHOR] + sigma**2
        return replace(
            self,
            mean=self.mean + reach * ((n - self.mean[ANCHOR]) / variance),
            covariance=self.covariance - np.outer(reach, reach) / variance,
        )

    def _copied(self, entry: int) -> "IndexState":
        mean, covariance = self.mean.copy(), self.covariance.copy()
        mean[entry] = mean[N]
        covariance[entry] = covariance[N]
        covariance[:, entry] = covariance[:, N]
        covariance[entry, entry] = self.covariance[N, N]
        return replace(self, mean=mean, covariance=covariance)


def first_state(
    time: float, n: float, sigma: float, pose_sigmas: FloatArray, camera: FloatArray
) -> IndexState:
    """Return the state before any frame.

    Parameters
    ----------
    time : float
        In seconds.
    n, sigma : float
        Where the index is looked for, and how far around.
    pose_sigmas : array, shape (6,)
        Of the target's place: turn (radians) and shift (metres).
    camera : array, shape (C, C)
        Covariance of the camera's numbers.
    """
    size = FIRST_CAMERA + len(camera)
    mean, covariance = np.zeros(size), np.zeros((size, size))
    mean[:N_INDICES] = n
    covariance[:N_INDICES, :N_INDICES] = sigma**2
    covariance[POSE, POSE] = np.diag(np.asarray(pose_sigmas) ** 2)
    covariance[FIRST_CAMERA:, FIRST_CAMERA:] = camera
    return IndexState(time, mean, covariance, (), sigma**2, n, np.zeros((0, 2)))
