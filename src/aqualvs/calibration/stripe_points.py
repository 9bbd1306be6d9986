"""What one picture says of the lasers: points on stripes, whichever laser drew them."""

from dataclasses import dataclass

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class StripePoints:
    """Points on laser stripes, found in one picture.

    Attributes
    ----------
    name : str
        File name of the picture, for messages and reports.
    pixels : array, shape (N, 2)
        Sub-pixel centres, in `image`.
    across : array, shape (N, 2)
        Unit vectors in `image` at right angles to the stripe: only along these is a point measured.
    chain : int array, shape (N,)
        Which unbroken piece of a stripe a point belongs to; pieces may bend.
    sigma_px : array, shape (N,)
        Nominal standard deviation along `across`; solves estimate the real one.
    """

    name: str
    pixels: FloatArray
    across: FloatArray
    chain: IntArray
    sigma_px: FloatArray

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.chain)

    def thinned(self, n_points: int) -> "StripePoints":
        """Return every second, third... point, so that hardly more than `n_points` are left."""
        every = -(-len(self) // n_points) if len(self) else 1
        return self if every == 1 else self.where(np.arange(len(self)) % every == 0)

    def where(self, keep: BoolArray) -> "StripePoints":
        """Return the points that `keep` (N,) marks."""
        return self.at(np.flatnonzero(keep))

    def at(self, index: IntArray) -> "StripePoints":
        """Return the points with these indices (M,)."""
        return StripePoints(
            self.name,
            self.pixels[index],
            self.across[index],
            self.chain[index],
            self.sigma_px[index],
        )
