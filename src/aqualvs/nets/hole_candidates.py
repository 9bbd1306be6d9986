"""Candidate holes: evidence from single strands that the lattice predicts, summed over discs.

**Strands.** The place of the lattice in a frame is known, and so is the point where each laser's
line crosses each strand. A lit crossing is a strand seen; a dark one, with enough light on either
side, a strand missed (`predicted_strands`).

**Looks.** Each crossing is a look: evidence for a hole there or against it. The rate at which
existing strands are missed is estimated from the dive itself. Looks of one laser at one small cell
of the net are alike and count as one, however many (`Looks`).

**Discs.** The log-likelihood adds up over discs of many sizes around many middles; the discs that
explain it, each with its likelihood, give the place and size of a hole, and their uncertainty where
its edge was not seen (`find_discs`).
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import inner_kernel, kernel
from aqualvs.nets.dashes import NetView
from aqualvs.nets.lattice import NetLattice
from aqualvs.nets.spectrum import Mesh


class _EvidenceOptions(NamedTuple):
    """Evidence of the looks at a place of the net, for and against a hole."""

    # Share of strand that is always dark without a hole; share of light where the net has a hole (a
    # fish, a loose end); and limit of the evidence of the looks at one cell against a hole.
    dark: float = 0.03
    false_light: float = 0.03
    max_sound: float = 4.0
    # Prior number of crossings seen, for one laser and family: with few crossings, the share that
    # is missed is not known. The same for a piece of its line. Where seen and missed alternate at
    # this share, all missed ones count; where a larger share than the last one is missed, missing
    # strands give no evidence.
    before: float = 20.0
    before_here: float = 5.0
    scarce: float = 0.12
    too_many: float = 0.3


_EVIDENCE = _EvidenceOptions()


HERE = 0.1
"""Length of a piece of a laser's line, in ranges."""

LASERS = 1 << 5
"""Keys of cells are multiples of this, and of two more for the outcome."""


@dataclass(slots=True)
class Looks:
    """Looks at cells of the net, n of them, each of one laser and one outcome."""

    # Shape (n,): cell, laser, and whether the strands were missed.
    keys: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    # Shape (n, 4): number of looks, sums of their places and of their log-likelihoods for a hole.
    sums: FloatArray = field(default_factory=lambda: np.empty((0, 4)))
    # Shape (n, 2): their first and last frame.
    frames: IntArray = field(default_factory=lambda: np.empty((0, 2), np.int64))

    def added(self, keys: IntArray, rows: FloatArray, frame: IntArray) -> "Looks":
        """Return these looks and further ones."""
        every, index = np.unique(np.concatenate([self.keys, keys]), return_inverse=True)
        both = np.concatenate([self.sums, rows])
        sums = [np.bincount(index, column, minlength=len(every)) for column in both.T]
        frames = np.tile([np.iinfo(np.int64).max, -1], (len(every), 1))
        np.minimum.at(frames[:, 0], index, np.concatenate([self.frames[:, 0], frame]))
        np.maximum.at(frames[:, 1], index, np.concatenate([self.frames[:, 1], frame]))
        return Looks(every, np.stack(sums, axis=1), frames)

    def kept(self, mask: BoolArray) -> "Looks":
        """Return the looks selected by a mask."""
        return Looks(self.keys[mask], self.sums[mask], self.frames[mask])

    @property
    def places(self) -> FloatArray:
        """Mean places, shape (n, 2)."""
        return self.sums[:, 1:3] / self.sums[:, :1]

    @property
    def missed(self) -> BoolArray:
        """Mask of the looks at missed strands (n,)."""
        return np.asarray((self.keys & 1) == 1)

    @property
    def shares(self) -> FloatArray:
        """Share of each among the looks of its laser at its cell (n,)."""
        number = self.sums[:, 0]
        _, index = np.unique(self.keys >> 1, return_inverse=True)
        return np.asarray(number / np.bincount(index, number)[index])

    def weights(self) -> FloatArray:
        """Evidence of each for a hole (n,): as one look, less where both outcomes were seen."""
        number = self.sums[:, 0]
        margin = np.maximum(2.0 * self.shares - 1.0, 0.0)
        mean = self.sums[:, 3] / number
        says = np.where(self.missed, mean, np.maximum(mean * number, -_EVIDENCE.max_sound))
        return np.asarray(says * margin)

    def stays_dark(self, middle: FloatArray, radius: float) -> bool:
        """Return whether a round patch is a hole, not hidden for a while by a dark object.

        A hole is there for every laser and at all times. An object that drifts or swims by hides
        strands that are seen before and after, or by another laser from another side.
        """
        inside = np.hypot(*(self.places - middle).T) < radius
        share, missed = self.shares[inside], self.missed[inside]
        dark, lit = float(share[missed].sum()), float(share[~missed].sum())
        if dark == 0.0:
            return False
        # A dark object that hides the net for a while leaves some strands visible. Share of strands
        # seen in a hole; and largest log-likelihood by which a hidden net may be likelier than a
        # hole.
        lit_in_hole, min_over_hidden = 0.05, -3.0
        hidden = max(lit / (dark + lit), lit_in_hole)
        over_lit = lit * np.log(lit_in_hole / hidden)
        over = over_lit + dark * np.log((1.0 - lit_in_hole) / (1.0 - hidden))
        if over < min_over_hidden:
            return False
        laser = (self.keys[inside] >> 1) % LASERS
        balance = np.bincount(laser, np.where(missed, share, -share))
        telling = np.flatnonzero(balance > 0.0)
        frames = self.frames[inside][missed & np.isin(laser, telling)]
        span = int(np.ptp(frames)) + 1 if len(frames) else 0
        # Least number of frames of a hole seen by one laser alone: those in which a line sweeps
        # over three bars at the fastest speed at which the net can be tracked.
        alone_frames = 8
        return len(telling) > 1 or span >= alone_frames


def looks_say(
    laser: IntArray, family: IntArray, here: FloatArray, missed: BoolArray, run: IntArray
) -> FloatArray:
    """Return the log-likelihood of a hole over sound net for every crossing (N,).

    `here`, shape (N,): number of the piece of the laser's line; the others are as in `Strands`.
    """
    share = np.maximum(_missed_share(laser, family, missed, run), _missed_here(laser, here, missed))
    dark = np.where(share < _EVIDENCE.too_many, -np.log(_EVIDENCE.dark + share), 0.0)
    return np.asarray(np.where(missed, dark, np.log(_EVIDENCE.false_light / (1.0 - share))))


def _missed_share(
    laser: IntArray, family: IntArray, missed: BoolArray, run: IntArray
) -> FloatArray:
    """Return the share of strands that are missed though they are there, for every crossing (N,).

    Estimated from single missed ones between seen ones, of the same laser and family.
    """
    kind = laser * (int(family.max(initial=0)) + 1) + family
    seen = np.bincount(kind[~missed], minlength=int(kind.max(initial=0)) + 1)
    single = np.bincount(kind[missed & (run == 1)], minlength=len(seen))
    share = (single + _EVIDENCE.dark * _EVIDENCE.before) / (seen + single + _EVIDENCE.before)
    return np.asarray(share[kind])


def _missed_here(laser: IntArray, here: FloatArray, missed: BoolArray) -> FloatArray:
    """Return the share of strands missed on a piece of a laser's line, for every crossing (N,).

    Where light is weak, seen and missed alternate as the net passes by; where a hole passes by they
    change once or twice.
    """
    _, kind = np.unique(np.stack([laser, here.astype(np.int64)]), axis=1, return_inverse=True)
    order = np.argsort(kind, kind="stable")
    again = kind[order][1:] == kind[order][:-1]
    turned = again & (missed[order][1:] != missed[order][:-1])
    n = int(kind.max(initial=0)) + 1
    before = _EVIDENCE.before_here
    pairs = np.bincount(kind[order][1:], again, minlength=n) + before
    turns = np.bincount(kind[order][1:], turned, minlength=n) + 2.0 * _EVIDENCE.dark * before
    # Of two in random order, 2 p (1 - p) differ.
    share = 0.5 - np.sqrt(np.maximum(0.25 - 0.5 * turns / pairs, 0.0))
    every = np.bincount(kind, missed, minlength=n) / np.bincount(kind, minlength=n)
    return np.asarray(np.where(share > _EVIDENCE.scarce, np.maximum(share, every), share)[kind])


RIM = 0.8
"""Margin around a disc within which evidence belongs to it, in bars."""


class _DiscOptions(NamedTuple):
    """Search for discs that hold no strand."""

    # Grid of the discs, in bars: step of the middles, their margin beyond missing strands, and the
    # radii. Least score of a hole on the grid with double the step.
    step: float = 0.4
    beside: float = 2.4
    coarse_score: float = 6.0
    # Discs up to this radius are single strands that are cut, larger ones holes.
    single: float = 0.8
    # A hole's log-likelihood over sound net, and over a single strand that is cut.
    min_score: float = 12.0
    min_lead: float = 5.0
    # Uncertainty of a radius from the grid and from the places of strands, in bars.
    rough: float = 0.25


_DISCS = _DiscOptions()

_RADII: FloatArray = np.arange(0.5, 6.01, 0.25)


@dataclass(frozen=True, slots=True)
class Disc:
    """A round patch where strands are missing."""

    middle: FloatArray  # Shape (2,): in metres.
    # Mean over all discs that explain what was seen, and standard deviation, in metres.
    radius: float
    sigma: float
    # Log-likelihood over sound net.
    score: float

    def contains(self, places: FloatArray, margin: float = 0.0) -> BoolArray:
        """Mark the places (..., 2) in the disc or less than a margin, in metres, beside it."""
        off = np.moveaxis(places - self.middle, -1, 0)
        return np.asarray(np.hypot(*off) < self.radius + margin)


def find_discs(place: FloatArray, weight: FloatArray, bar: float) -> list[Disc]:
    """Find discs in which strands are missing, the most certain first.

    Parameters
    ----------
    place : array, shape (N, 2)
        Places of the looks, in metres.
    weight : array, shape (N,)
        Log-likelihood of a hole there over sound net.
    bar : float
        Length of the net's bars, in metres.
    """
    weight = weight.copy()
    found: list[Disc] = []
    while weight[weight > 0.0].sum() >= _DISCS.min_score:
        disc = _best(place, weight, bar)
        if disc is None:
            break
        found.append(disc)
        weight[disc.contains(place, RIM * bar)] = 0.0
    return found


@kernel
def local_sums(place: FloatArray, weight: FloatArray, radius: float) -> FloatArray:
    """Return the sums (N,) of the weights of places (N, 2) within a radius of each of them."""
    total = np.zeros(len(place))
    for m in range(len(place)):
        for k in range(len(place)):
            x, y = place[k, 0] - place[m, 0], place[k, 1] - place[m, 1]
            if x * x + y * y < radius * radius:
                total[m] += weight[k]
    return total


def _best(place: FloatArray, weight: FloatArray, bar: float) -> Disc | None:
    radii = _RADII * bar
    rough = _scores(place, weight, _middles(place, weight, 2.0 * _DISCS.step * bar, bar), radii)
    if rough.max() < _DISCS.coarse_score:
        return None
    middles = _middles(place, weight, _DISCS.step * bar, bar)
    score = _scores(place, weight, middles, radii)
    # Large holes are rarer than small ones, by this power of the radius.
    rarer = 2.0
    total = score - rarer * np.log(_RADII)
    single = _DISCS.single >= _RADII
    total[:, single] = -np.inf
    at, size = np.unravel_index(np.argmax(total), total.shape)
    best = float(score[at, size])
    if best < _DISCS.min_score or best - max(float(score[:, single].max()), 0.0) < _DISCS.min_lead:
        return None
    # Discs that contain the middle of the likeliest one belong to the same hole.
    away = np.hypot(*(middles - middles[at]).T)
    share = np.exp(total - total[at, size]) * (away[:, None] < np.maximum(radii, radii[size]))
    share /= share.sum()
    radius = float(share.sum(axis=0) @ radii)
    spread = float(share.sum(axis=0) @ (radii - radius) ** 2)
    return Disc(
        middle=share.sum(axis=1) @ middles,
        radius=radius,
        sigma=float(np.sqrt(spread + (_DISCS.rough * bar) ** 2)),
        score=best,
    )


def _middles(place: FloatArray, weight: FloatArray, step: float, bar: float) -> FloatArray:
    """Return a grid around the places where strands are missing, shape (C, 2)."""
    missing, beside = place[weight > 0.0], _DISCS.beside * bar
    low, high = missing.min(axis=0) - beside, missing.max(axis=0) + beside
    sides = [np.arange(a, b, step) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2)


@kernel
def _scores(
    place: FloatArray, weight: FloatArray, middles: FloatArray, radii: FloatArray
) -> FloatArray:
    """Return the sum of the weights within each radius (R,) of each middle (C, 2), shape (C, R)."""
    score = np.zeros((len(middles), len(radii)))
    first, step = radii[0], radii[1] - radii[0]
    for c in range(len(middles)):
        for k in range(len(place)):
            x, y = place[k, 0] - middles[c, 0], place[k, 1] - middles[c, 1]
            away = np.sqrt(x * x + y * y)
            r = max(int(np.ceil((away - first) / step)), 0)
            if r < len(radii):
                score[c, r] += weight[k]
        for r in range(1, len(radii)):
            score[c, r] += score[c, r - 1]
    return score


# Tolerance of a strand's predicted place, as a share of its pitch; at least this many steps of the
# search lines.
_OFF, _OFF_STEPS = 0.2, 1.5


@dataclass(frozen=True, slots=True)
class Strands:
    """Crossings of one frame that the lattice predicts and that could be seen, N of them."""

    place: FloatArray  # Shape (N, 2): in `net`, in metres.
    along: FloatArray  # Shape (N,): the same on the laser's line, in metres.
    # Shape (N,): laser, and family of the strand.
    laser: IntArray
    family: IntArray
    # Shape (N,): whether it is dark there.
    missed: BoolArray
    # Shape (N,): number of crossings missed in the same dark piece; 0 for those seen.
    run: IntArray
    # Shape (N,): whether strands are seen at both ends of that piece; False for those seen.
    closed: BoolArray


def predicted_strands(lattice: NetLattice, view: NetView, place: FloatArray) -> Strands:
    """Return the predicted crossings of a frame's lines with strands, each seen or missed.

    `place`, shape (2,): of the lattice in `net` (`LatticeShift.place`), in metres.
    """
    gaps = view.gaps
    # Least share of light behind the net seen through a hole, relative to elsewhere.
    let_through = 0.5
    # A hole lets light through; a dark piece without light behind it is hidden by something.
    open_ = gaps.beyond >= let_through * view.beyond[gaps.laser]
    turns = np.abs(lattice.waves).sum(axis=0) @ np.ones(2)
    most = int(np.sum(turns * (view.span[:, 1] - view.span[:, 0]) + len(lattice.waves) + 1.0))

    here, six_sided = np.asarray(place, np.float64), lattice.mesh is Mesh.SIX_SIDED
    row, gap = _predict(
        _PlacedLattice(lattice.waves, lattice.basis, lattice.bar, six_sided, here),
        _Lines(view.origin, view.direction, _OFF_STEPS * view.step, view.span_laser, view.span),
        _Gaps(gaps.laser, gaps.ends, open_),
        most,
    )
    missed = gap[:, 2] >= 0
    dark = gap[missed, 2]
    run, closed = np.zeros(len(gap), np.int64), np.zeros(len(gap), np.bool_)
    run[missed] = np.bincount(dark, minlength=len(gaps.laser))[dark]
    closed[missed] = gaps.closed[dark].all(axis=1)
    return Strands(row[:, :2].copy(), row[:, 2].copy(), gap[:, 0], gap[:, 1], missed, run, closed)


class _PlacedLattice(NamedTuple):
    """A lattice at its place in `net`, in metres."""

    waves: FloatArray
    basis: FloatArray
    bar: float
    six_sided: bool
    place: FloatArray


class _Lines(NamedTuple):
    """Lines of the lasers, and their spans in view."""

    origin: FloatArray
    direction: FloatArray
    least_off: FloatArray  # Shape (L,): least tolerance of a strand's place, in metres.
    span_laser: IntArray
    span: FloatArray


class _Gaps(NamedTuple):
    """Gaps in the lines, and whether light is seen behind them."""

    laser: IntArray
    ends: FloatArray
    is_open: BoolArray


@kernel
def _predict(
    strands: _PlacedLattice, lines: _Lines, gaps: _Gaps, most: int
) -> tuple[FloatArray, IntArray]:
    """Return (place, along) and (laser, family, gap or -1) of every crossing."""
    where, row = np.empty((most, 3)), np.empty((most, 3), np.int64)
    origin, direction, span, place = lines.origin, lines.direction, lines.span, strands.place
    n = 0
    # Least sine of a crossing angle; at smaller ones the place of the crossing is uncertain.
    min_across = 0.3
    for m in range(len(span)):
        i = lines.span_laser[m]
        for f in range(len(strands.waves)):
            qx, qy = strands.waves[f]
            rate = qx * direction[i, 0] + qy * direction[i, 1]
            size = np.sqrt(qx * qx + qy * qy)
            if not abs(rate) > min_across * size:
                continue
            start = qx * (origin[i, 0] - place[0]) + qy * (origin[i, 1] - place[1])
            off = max(_OFF / abs(rate), lines.least_off[i])
            a, b = start + rate * span[m, 0], start + rate * span[m, 1]
            for number in range(int(np.ceil(min(a, b))), int(np.floor(max(a, b))) + 1):
                s = (number - start) / rate
                x = origin[i, 0] + s * direction[i, 0]
                y = origin[i, 1] + s * direction[i, 1]
                if s - off < span[m, 0] or s + off > span[m, 1]:
                    continue
                if strands.six_sided and not _on_bar(
                    x - place[0], y - place[1], strands.basis, strands.bar
                ):
                    continue
                k = _gap_around(s, off, i, gaps)
                if k >= 0 and not gaps.is_open[k]:
                    continue
                where[n, 0], where[n, 1], where[n, 2] = x, y, s
                row[n, 0], row[n, 1], row[n, 2] = i, f, k
                n += 1
    return where[:n], row[:n]


@inner_kernel
def _gap_around(s: float, off: float, i: int, gaps: _Gaps) -> int:
    """Return the row of the gap that reaches farther than `off` to both sides of s, or -1."""
    for k in range(len(gaps.laser)):
        if gaps.laser[k] == i and gaps.ends[k, 0] < s - off and gaps.ends[k, 1] > s + off:
            return k
    return -1


@inner_kernel
def _on_bar(x: float, y: float, basis: FloatArray, bar: float) -> bool:
    """Return whether a place on a line of hexagon bars is on a bar, well inside its ends.

    A bar is as far from the middles of the two openings beside it, and farther from all others.
    """
    det = basis[0, 0] * basis[1, 1] - basis[0, 1] * basis[1, 0]
    u = np.floor(basis[0, 0] * x + basis[0, 1] * y)
    v = np.floor(basis[1, 0] * x + basis[1, 1] * y)
    first, second, third = np.inf, np.inf, np.inf
    for p in range(-1, 3):
        for q in range(-1, 3):
            a, b = u + p, v + q
            cx = (basis[1, 1] * a - basis[0, 1] * b) / det
            cy = (basis[0, 0] * b - basis[1, 0] * a) / det
            d = np.sqrt((x - cx) ** 2 + (y - cy) ** 2)
            if d < first:
                first, second, third = d, first, second
            elif d < second:
                second, third = d, second
            elif d < third:
                third = d
    # Margin at the ends of hexagon bars, as a share of a bar, within which their presence is
    # uncertain.
    knot = 0.2
    return bool(second - first < 0.05 * bar and third - second > knot * bar)
