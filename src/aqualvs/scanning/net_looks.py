"""Looks at strands that a net should have: what each says for a hole, and what they say together.

A look finds a strand or misses it. How often strands that are there are missed, the dive itself
tells. Looks of one laser at one small cell of the net are alike and count as one, however many.
"""

from dataclasses import dataclass, field

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray

# Pieces of strand that are always dark without a hole, as a share; light where the net has a hole
# (a fish, a loose end); and how much the looks at one cell say at most against a hole.
_DARK, _FALSE_LIGHT, _MOST_SOUND = 0.03, 0.03, 4.0
# Of one laser's crossings with one family, so many count as seen beforehand: with few, the share
# that is missed is not known. The same for a piece of its line.
# Where this share takes turns, all that is missed there counts; where more is missed than the last
# share, missing strands tell nothing.
_BEFORE, _BEFORE_HERE, _SCARCE, _TOO_MANY = 20.0, 5.0, 0.12, 0.3
# What hides the net for a while, and shows no light of its own, leaves some of the strands to be
# seen; so many are in a hole, and it must not be less likely than the other by this logarithm.
_LIT_IN_HOLE, _LEAST_OVER_HIDDEN = 0.05, -3.0
# A hole that one laser alone tells of must stay so for so many frames: those in which a line sweeps
# over three bars at the fastest pace at which the net can be followed.
_ALONE_FRAMES = 8

HERE = 0.1
"""Length of a piece of a laser's line, in ranges."""

LASERS = 1 << 5
"""Keys of cells are multiples of this, and of two more for the outcome."""


@dataclass(slots=True)
class Looks:
    """Looks at cells, each of one laser and one outcome; n of them.

    Attributes
    ----------
    keys : int array, shape (n,)
        Cell, laser, and whether the strands were missed.
    sums : array, shape (n, 4)
        Number of looks, sums of their places and of what they say for a hole.
    frames : int array, shape (n, 2)
        The first and the last that they are of.
    """

    keys: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    sums: FloatArray = field(default_factory=lambda: np.empty((0, 4)))
    frames: IntArray = field(default_factory=lambda: np.empty((0, 2), np.int64))

    def added(self, keys: IntArray, rows: FloatArray, frame: IntArray) -> "Looks":
        """Return these and more of them."""
        every, index = np.unique(np.concatenate([self.keys, keys]), return_inverse=True)
        both = np.concatenate([self.sums, rows])
        sums = [np.bincount(index, column, minlength=len(every)) for column in both.T]
        frames = np.tile([np.iinfo(np.int64).max, -1], (len(every), 1))
        np.minimum.at(frames[:, 0], index, np.concatenate([self.frames[:, 0], frame]))
        np.maximum.at(frames[:, 1], index, np.concatenate([self.frames[:, 1], frame]))
        return Looks(every, np.stack(sums, axis=1), frames)

    def kept(self, mask: BoolArray) -> "Looks":
        """Return some of them."""
        return Looks(self.keys[mask], self.sums[mask], self.frames[mask])

    @property
    def places(self) -> FloatArray:
        """Mean places, shape (n, 2)."""
        return self.sums[:, 1:3] / self.sums[:, :1]

    @property
    def missed(self) -> BoolArray:
        """Which are of missed strands (n,)."""
        return np.asarray((self.keys & 1) == 1)

    @property
    def shares(self) -> FloatArray:
        """Share of each among the looks of its laser at its cell (n,)."""
        number = self.sums[:, 0]
        _, index = np.unique(self.keys >> 1, return_inverse=True)
        return np.asarray(number / np.bincount(index, number)[index])

    def weights(self) -> FloatArray:
        """Say how much each speaks for a hole (n,): as one look, less where both were seen."""
        number = self.sums[:, 0]
        margin = np.maximum(2.0 * self.shares - 1.0, 0.0)
        mean = self.sums[:, 3] / number
        says = np.where(self.missed, mean, np.maximum(mean * number, -_MOST_SOUND))
        return np.asarray(says * margin)

    def stays_dark(self, middle: FloatArray, radius: float) -> bool:
        """Tell whether a round patch is a hole, not hidden for a while by what shows no light.

        A hole is there for every laser and whenever it is looked at. What drifts or swims by hides
        strands that are seen before and after, or by another laser from another side.
        """
        inside = np.hypot(*(self.places - middle).T) < radius
        share, missed = self.shares[inside], self.missed[inside]
        dark, lit = float(share[missed].sum()), float(share[~missed].sum())
        if dark == 0.0:
            return False
        hidden = max(lit / (dark + lit), _LIT_IN_HOLE)
        over_lit = lit * np.log(_LIT_IN_HOLE / hidden)
        over = over_lit + dark * np.log((1.0 - _LIT_IN_HOLE) / (1.0 - hidden))
        if over < _LEAST_OVER_HIDDEN:
            return False
        laser = (self.keys[inside] >> 1) % LASERS
        balance = np.bincount(laser, np.where(missed, share, -share))
        telling = np.flatnonzero(balance > 0.0)
        frames = self.frames[inside][missed & np.isin(laser, telling)]
        span = int(np.ptp(frames)) + 1 if len(frames) else 0
        return len(telling) > 1 or span >= _ALONE_FRAMES


def looks_say(
    laser: IntArray, family: IntArray, here: FloatArray, missed: BoolArray, run: IntArray
) -> FloatArray:
    """Log-likelihood of a hole over sound net, of every crossing (N,).

    Parameters
    ----------
    laser, family, missed, run
        As in `Strands`.
    here : array, shape (N,)
        Number of the piece of the laser's line.
    """
    share = np.maximum(_missed_share(laser, family, missed, run), _missed_here(laser, here, missed))
    dark = np.where(share < _TOO_MANY, -np.log(_DARK + share), 0.0)
    return np.asarray(np.where(missed, dark, np.log(_FALSE_LIGHT / (1.0 - share))))


def _missed_share(
    laser: IntArray, family: IntArray, missed: BoolArray, run: IntArray
) -> FloatArray:
    """Share of strands that are missed though they are there, for every crossing (N,).

    Told from single ones, between others that are seen, of the same laser and family.
    """
    kind = laser * (int(family.max(initial=0)) + 1) + family
    seen = np.bincount(kind[~missed], minlength=int(kind.max(initial=0)) + 1)
    single = np.bincount(kind[missed & (run == 1)], minlength=len(seen))
    share = (single + _DARK * _BEFORE) / (seen + single + _BEFORE)
    return np.asarray(share[kind])


def _missed_here(laser: IntArray, here: FloatArray, missed: BoolArray) -> FloatArray:
    """Share of strands that are missed on a piece of a laser's line, for every crossing (N,).

    Where light is scarce, seen and missed take turns as the net passes by; where a hole passes by
    they do so once or twice.
    """
    _, kind = np.unique(np.stack([laser, here.astype(np.int64)]), axis=1, return_inverse=True)
    order = np.argsort(kind, kind="stable")
    again = kind[order][1:] == kind[order][:-1]
    turned = again & (missed[order][1:] != missed[order][:-1])
    n = int(kind.max(initial=0)) + 1
    pairs = np.bincount(kind[order][1:], again, minlength=n) + _BEFORE_HERE
    turns = np.bincount(kind[order][1:], turned, minlength=n) + 2.0 * _DARK * _BEFORE_HERE
    # Of two in random order, 2 p (1 - p) differ.
    share = 0.5 - np.sqrt(np.maximum(0.25 - 0.5 * turns / pairs, 0.0))
    every = np.bincount(kind, missed, minlength=n) / np.bincount(kind, minlength=n)
    return np.asarray(np.where(share > _SCARCE, np.maximum(share, every), share)[kind])
