"""Holes: places on the net where strands that the lattice predicts are missing.

Every crossing of a laser's line with a strand that should be there is looked at: seen, or missed.
Looks from many places are put together on a map that is fixed to the net. However often the same
piece of strand was looked at from much the same place, it counts once; how often strands that are
there are missed is told by the dive itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.scanning.net_dashes import NetView
from aqualvs.scanning.net_discs import RIM, Disc, find_discs, local_sums
from aqualvs.scanning.net_hypotheses import Mesh
from aqualvs.scanning.net_lattice import NetLattice
from aqualvs.scanning.net_strands import Strands, predicted_strands

# Side of the map's cells, in bars: looks of one laser at one cell are alike.
_CELL = 0.4
# Pieces of strand that are always dark without a hole, as a share; light where the net has a hole
# (a fish, a loose end); and how much the looks at one cell say at most against a hole.
_DARK, _FALSE_LIGHT, _MOST_SOUND = 0.03, 0.03, 4.0
# Of one laser's crossings with one family, so many count as seen beforehand: with few, the share
# that is missed is not known. The same for a piece of its line, so many ranges long.
# Where this share takes turns, all that is missed there counts; where more is missed than the last
# share, missing strands tell nothing.
_BEFORE, _BEFORE_HERE, _HERE, _SCARCE, _TOO_MANY = 20.0, 5.0, 0.1, 0.12, 0.3
# Where more than this share is missed between strands that are seen, the lattice is not the net's.
_MOST_MISSED = 0.3
# Missing strands so near to each other, in bars, and with so much evidence, may be a hole; so far
# around, strands tell where it ends.
_NEAR, _LEAST_NEAR, _AROUND = 1.5, 9.0, 6.5
# Discs no farther apart than this are one hole, in bars.
_TOUCH = 1.2
# A frame's foot is kept for every so many bars that the vehicle moves.
_LOOK = 0.2
# Cells farther from the vehicle than this are settled, in metres.
_SETTLED = 2.0
_ROW, _LASERS = 1 << 24, 1 << 5
# Squares of a side's 24th part measure the area of discs that overlap.
_SQUARES = 24


@dataclass(frozen=True, slots=True)
class Hole:
    """A hole in the net.

    Attributes
    ----------
    piece : int
        Piece of track that `place` belongs to (`NetTrack.piece`).
    place : array, shape (2,)
        Its middle: right and up of the track's start on the net, in metres.
    extent : (float, float)
        Width and height, in metres.
    diameter : float
        Of a round hole of the same area, in metres.
    sigma_diameter : float
        Its standard deviation.
    missing_meshes : float
        Its area in openings of the net.
    frame, time_s : int, float
        Of the look nearest to its middle.
    from_foot : array, shape (2,)
        Where its middle was then, right and up of the vehicle's foot on the net (of the
        perpendicular from the dome's centre), in metres.
    n_looks : int
        Looks through it.
    """

    piece: int
    place: FloatArray
    extent: tuple[float, float]
    diameter: float
    sigma_diameter: float
    missing_meshes: float
    frame: int
    time_s: float
    from_foot: FloatArray
    n_looks: int


@dataclass(slots=True)
class _Looks:
    """Looks at cells, each of one laser and one outcome; n of them.

    Attributes
    ----------
    keys : int array, shape (n,)
        Cell, laser, and whether the strands were missed.
    sums : array, shape (n, 4)
        Number of looks, sums of their places and of what they say for a hole.
    """

    keys: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    sums: FloatArray = field(default_factory=lambda: np.empty((0, 4)))

    def added(self, keys: IntArray, rows: FloatArray) -> "_Looks":
        """Return these and more of them."""
        every, index = np.unique(np.concatenate([self.keys, keys]), return_inverse=True)
        both = np.concatenate([self.sums, rows])
        sums = [np.bincount(index, column, minlength=len(every)) for column in both.T]
        return _Looks(every, np.stack(sums, axis=1))

    def kept(self, mask: BoolArray) -> "_Looks":
        """Return some of them."""
        return _Looks(self.keys[mask], self.sums[mask])

    @property
    def places(self) -> FloatArray:
        """Mean places, shape (n, 2)."""
        return self.sums[:, 1:3] / self.sums[:, :1]

    def weights(self) -> FloatArray:
        """Say how much each speaks for a hole (n,): as one look, less where both were seen."""
        number = self.sums[:, 0]
        cell, missed = self.keys >> 1, self.keys & 1
        _, index = np.unique(cell, return_inverse=True)
        told = np.bincount(index, number)[index]
        margin = np.maximum(2.0 * number - told, 0.0) / told
        mean = self.sums[:, 3] / number
        return np.where(missed == 1, mean, np.maximum(mean * number, -_MOST_SOUND)) * margin


@dataclass(slots=True)
class HoleMap:
    """The map of looks, fixed to the net, and the holes in it.

    Attributes
    ----------
    holes : list of Hole
        In the order in which they were found.
    """

    holes: list[Hole] = field(default_factory=list)
    _bar: float = 0.0
    _piece: int = -1
    _looks: _Looks = field(default_factory=_Looks)
    _meshes: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    _waiting: list[tuple[Strands, FloatArray, float]] = field(default_factory=list)
    _feet: dict[tuple[int, int], tuple[int, float, FloatArray]] = field(default_factory=dict)
    _last: FloatArray | None = None
    _settled_meshes: int = 0
    _mesh: float = 0.0

    @property
    def area(self) -> float:
        """Area of the meshes that were looked at, in square metres."""
        return (self._settled_meshes + len(self._meshes)) * self._mesh**2

    def add(
        self, lattice: NetLattice, view: NetView, knot: FloatArray, place: FloatArray, piece: int
    ) -> None:
        """Add a frame's looks.

        Parameters
        ----------
        lattice : NetLattice
            Of the stretch.
        view : NetView
            What the frame shows.
        knot : array, shape (2,)
            Where the lattice lies in `net` (`Shift.place`), in metres.
        place : array, shape (2,)
            Where the origin of `net` lies on the map, in metres.
        piece : int
            As `NetTrack.piece`: a new piece starts a new map.
        """
        if self._bar == 0.0:
            self._bar, self._mesh = lattice.bar, float(np.sqrt(opening_area(lattice)))
        if piece != self._piece:
            # What the vehicle lost its way in may be a hole.
            self.update(lattice)
            self._start_over(piece)
        self._last = place.copy()
        strands = predicted_strands(lattice, view, knot)
        self._waiting.append((strands, place.copy(), _HERE * view.range))
        column, row = np.floor(place / (_LOOK * self._bar)).astype(int)
        self._feet.setdefault((int(column), int(row)), (view.index, view.time_s, place.copy()))

    def update(self, lattice: NetLattice) -> None:
        """Find the holes in what was added so far; earlier finds are corrected."""
        if not self._waiting:
            return
        self._merge()
        fresh = self._find(lattice)
        live = [hole for hole in self.holes if hole.piece == self._piece and self._near(hole)]
        settled = [hole for hole in self.holes if not any(hole is one for one in live)]
        # A hole that the vehicle comes back to is the same one.
        self.holes = [one for one in settled if not any(_same(one, hole) for hole in fresh)] + fresh
        self._settle()

    def _start_over(self, piece: int) -> None:
        self._settled_meshes += len(self._meshes)
        self._meshes = np.empty(0, np.int64)
        self._looks, self._feet = _Looks(), {}
        self._piece, self._last = piece, None

    def _merge(self) -> None:
        if not self._waiting:
            return
        strands = [one for one, _, _ in self._waiting]
        place = np.concatenate([one.place + foot for one, foot, _ in self._waiting])
        here = np.concatenate([np.floor(one.along / part) for one, _, part in self._waiting])
        laser, family, missed, run, closed = (
            np.concatenate([getattr(one, name) for one in strands])
            for name in ("laser", "family", "missed", "run", "closed")
        )
        self._waiting = []
        between = float(np.sum(1.0 / run[closed]))
        if between > _MOST_MISSED * (between + np.count_nonzero(~missed)):
            return
        share = np.maximum(
            _missed_share(laser, family, missed, run), _missed_here(laser, here, missed)
        )
        dark = np.where(share < _TOO_MANY, -np.log(_DARK + share), 0.0)
        says = np.where(missed, dark, np.log(_FALSE_LIGHT / (1.0 - share)))
        column, row = np.floor(place / (_CELL * self._bar)).astype(np.int64).T
        keys = ((column + _ROW * row) * _LASERS + laser) * 2 + missed
        self._looks = self._looks.added(keys, np.c_[np.ones(len(keys)), place, says])
        column, row = np.floor(place / self._mesh).astype(np.int64).T
        self._meshes = np.unique(np.concatenate([self._meshes, column + _ROW * row]))

    def _near(self, hole: Hole) -> bool:
        """Whether a hole lies where the map is still open."""
        if self._last is None:
            return False
        return bool(np.abs(hole.place - self._last).max() < _SETTLED)

    def _find(self, lattice: NetLattice) -> list[Hole]:
        places, weights = self._looks.places, self._looks.weights()
        bar = lattice.bar
        likely = np.flatnonzero(weights > 0.0)
        near = local_sums(places[likely], weights[likely], _NEAR * bar)
        likely = likely[near > _LEAST_NEAR]
        found, left = [], weights.copy()
        for group in _groups(places[likely], 2.0 * _NEAR * bar):
            seeds = places[likely[group]]
            low, high = seeds.min(axis=0) - _AROUND * bar, seeds.max(axis=0) + _AROUND * bar
            around = np.all((places > low) & (places < high), axis=1)
            discs = find_discs(places[around], left[around], bar)
            for disc in discs:
                # Another group has this hole in its surroundings as well.
                left[np.hypot(*(places - disc.middle).T) < disc.radius + RIM * bar] = 0.0
            found += [
                self._hole(lattice, some, places[around], weights[around])
                for some in _touching(discs, _TOUCH * bar)
            ]
        return found

    def _hole(
        self, lattice: NetLattice, discs: list[Disc], places: FloatArray, weights: FloatArray
    ) -> Hole:
        """Put the discs of a hole together."""
        middle, extent, area = _outline(discs)
        nearest = min(self._feet.values(), key=lambda foot: float(np.hypot(*(foot[2] - middle))))
        diameter = float(np.sqrt(4.0 * area / np.pi))
        radius = np.array([disc.radius for disc in discs])
        sigma = float(np.hypot.reduce([2.0 * disc.sigma * disc.radius for disc in discs]))
        inside = np.zeros(len(places), np.bool_)
        for disc in discs:
            inside |= np.hypot(*(places - disc.middle).T) < disc.radius
        return Hole(
            piece=self._piece,
            place=middle,
            extent=extent,
            diameter=diameter,
            sigma_diameter=sigma / float(np.hypot.reduce(radius)),
            missing_meshes=area / opening_area(lattice),
            frame=nearest[0],
            time_s=nearest[1],
            from_foot=middle - nearest[2],
            n_looks=int(np.count_nonzero(inside & (weights > 0.0))),
        )

    def _settle(self) -> None:
        """Forget cells that the vehicle has left behind."""
        if self._last is None or not len(self._looks.keys):
            return
        close = np.abs(self._looks.places - self._last).max(axis=1) < _SETTLED
        self._looks = self._looks.kept(close)
        row = np.floor_divide(self._meshes + _ROW // 2, _ROW)
        at = np.stack([self._meshes - row * _ROW, row], axis=1) * self._mesh
        close = np.abs(at - self._last).max(axis=1) < _SETTLED
        self._settled_meshes += int(np.count_nonzero(~close))
        self._meshes = self._meshes[close]
        self._feet = {
            key: one
            for key, one in self._feet.items()
            if np.abs(one[2] - self._last).max() < _SETTLED
        }


def opening_area(lattice: NetLattice) -> float:
    """Area of one opening, from strand to strand, in square metres."""
    if lattice.mesh is Mesh.SIX_SIDED:
        return float(1.5 * np.sqrt(3.0) * lattice.bar**2)
    a, b = lattice.waves
    return float(1.0 / abs(a[0] * b[1] - a[1] * b[0]))


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


def _groups(places: FloatArray, reach: float) -> list[IntArray]:
    """Return the indices of groups of places that steps of up to `reach` connect."""
    left = np.ones(len(places), np.bool_)
    groups = []
    while left.any():
        group = np.flatnonzero(left)[:1]
        fresh = group
        left[group] = False
        while len(fresh):
            apart = np.hypot(*(places[left][:, None] - places[fresh]).transpose(2, 0, 1))
            fresh = np.flatnonzero(left)[np.any(apart < reach, axis=1)]
            left[fresh] = False
            group = np.r_[group, fresh]
        groups.append(group)
    return groups


def _touching(discs: Sequence[Disc], apart: float) -> list[list[Disc]]:
    """Put discs that touch together."""
    groups: list[list[Disc]] = []
    for disc in discs:
        mine = [
            group
            for group in groups
            if any(
                np.hypot(*(disc.middle - one.middle)) < disc.radius + one.radius + apart
                for one in group
            )
        ]
        groups = [group for group in groups if not any(group is one for one in mine)]
        groups.append([disc, *(one for group in mine for one in group)])
    return groups


def _outline(discs: Sequence[Disc]) -> tuple[FloatArray, tuple[float, float], float]:
    """Middle (2,), width and height, and area that discs cover together."""
    middles, radii = np.array([d.middle for d in discs]), np.array([d.radius for d in discs])
    low = (middles - radii[:, None]).min(axis=0)
    high = (middles + radii[:, None]).max(axis=0)
    size = high - low
    if len(discs) == 1:
        return middles[0], (float(size[0]), float(size[1])), float(np.pi * radii[0] ** 2)
    share = (np.arange(_SQUARES) + 0.5) / _SQUARES
    at = low + np.stack(np.meshgrid(share, share), axis=-1).reshape(-1, 2) * size
    inside = np.any(np.hypot(*(at[:, None] - middles).transpose(2, 0, 1)) < radii, axis=1)
    area = float(np.mean(inside) * size[0] * size[1])
    return at[inside].mean(axis=0), (float(size[0]), float(size[1])), area


def _same(one: Hole, other: Hole) -> bool:
    """Whether two holes on one map overlap by half."""
    apart = float(np.hypot(*(one.place - other.place)))
    return one.piece == other.piece and apart < 0.25 * (one.diameter + other.diameter)


def merge_holes(holes: Sequence[Hole]) -> list[Hole]:
    """Return holes in the order in which the vehicle passed them."""
    return sorted(holes, key=lambda hole: (hole.time_s, hole.frame))
