"""What an index estimate knows: the index and the constants of rig and target, jointly Gaussian."""

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
    """

    time: float
    mean: FloatArray
    covariance: FloatArray
    ids: tuple[int, ...]
    random_variance: float
    n_of_slopes: float

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
        mean = np.concatenate([self.mean, np.zeros(more)])
        return replace(self, mean=mean, covariance=covariance, ids=self.ids + new)

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
    return IndexState(time, mean, covariance, (), sigma**2, n)
