"""Holes: places on the net where strands that the lattice predicts are missing.

Every crossing of a laser's line with a strand that should be there is checked: seen, or missed.
Looks from many places are combined on a map that is fixed to the net. Repeated looks at one piece
of strand from much the same place count once; the rate at which existing strands are missed is
estimated from the dive itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.nets.dashes import NetView
from aqualvs.nets.hole_candidates import (
    HERE,
    LASERS,
    RIM,
    Disc,
    Looks,
    Strands,
    find_discs,
    local_sums,
    looks_say,
    predicted_strands,
)
from aqualvs.nets.lattice import NetLattice
from aqualvs.nets.spectrum import Mesh

_ROW = 1 << 24

# Frame, time, and place on the map.
Foot: TypeAlias = tuple[int, float, FloatArray]


@dataclass(frozen=True, slots=True)
class Hole:
    """A hole in the net."""

    piece: int  # Piece of track that `place` belongs to (`NetTrack.piece`).
    # Shape (2,): its middle: right and up of the track's start on the net, in metres.
    place: FloatArray
    # Width and height, in metres.
    extent: tuple[float, float]
    # Of a round hole of the same area, in metres.
    diameter: float
    # Its standard deviation.
    sigma_diameter: float
    # Its area in openings of the net.
    missing_meshes: float
    # Of the look nearest to its middle.
    frame: int
    time_s: float
    # Shape (2,): its middle at that time, right and up of the vehicle's foot on the net (of the
    # perpendicular from the dome's centre), in metres.
    from_foot: FloatArray
    # Looks through it.
    n_looks: int
    # Frame, time, and place (2,) of the vehicle's foot in frames from different places around it.
    feet: Sequence[Foot] = ()


@dataclass(slots=True)
class HoleMap:
    """The map of looks, fixed to the net, and the holes in it."""

    holes: list[Hole] = field(default_factory=list)  # In the order in which they were found.
    _bar: float = 0.0
    _piece: int = -1
    _looks: Looks = field(default_factory=Looks)
    _meshes: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    _waiting: list[tuple[Strands, FloatArray, float, int]] = field(default_factory=list)
    _feet: dict[tuple[int, int], Foot] = field(default_factory=dict)
    _last: FloatArray = field(default_factory=lambda: np.zeros(2))
    _settled_meshes: int = 0
    _mesh: float = 0.0

    @property
    def area(self) -> float:
        """Area of the meshes that were searched, in square metres."""
        return (self._settled_meshes + len(self._meshes)) * self._mesh**2

    def add(
        self, lattice: NetLattice, view: NetView, knot: FloatArray, place: FloatArray, piece: int
    ) -> None:
        """Add a frame's looks.

        Parameters
        ----------
        knot : array, shape (2,)
            Place of the lattice in `net` (`LatticeShift.place`), in metres.
        place : array, shape (2,)
            Place of the origin of `net` on the map, in metres.
        piece : int
            As `NetTrack.piece`: a new piece starts a new map.
        """
        if self._bar == 0.0:
            self._bar, self._mesh = lattice.bar, float(np.sqrt(opening_area(lattice)))
        if piece != self._piece:
            # The area in which the track was lost may be a hole.
            self.update(lattice)
            self._start_piece(piece)
        self._last = place.copy()
        strands = predicted_strands(lattice, view, knot)
        self._waiting.append((strands, place.copy(), HERE * view.range, view.index))
        # Motion of the vehicle, in bars, between the frames whose foot is kept.
        look = 0.2
        column, row = np.floor(place / (look * self._bar)).astype(int)
        self._feet.setdefault((int(column), int(row)), (view.index, view.time_s, place.copy()))

    def update(self, lattice: NetLattice) -> None:
        """Find the holes in the looks so far; earlier holes are corrected."""
        if not self._waiting:
            return
        self._merge_waiting()
        fresh = self._find(lattice)
        settled = [
            hole for hole in self.holes if hole.piece != self._piece or not self._near(hole.place)
        ]
        # A hole to which the vehicle comes back is the same one.
        self.holes = [
            one for one in settled if not any(_overlap(one, hole) for hole in fresh)
        ] + fresh
        self._drop_settled()

    def _start_piece(self, piece: int) -> None:
        self._settled_meshes += len(self._meshes)
        self._meshes = np.empty(0, np.int64)
        self._looks, self._feet = Looks(), {}
        self._piece = piece

    def _merge_waiting(self) -> None:
        strands = [one for one, _, _, _ in self._waiting]
        place = np.concatenate([one.place + foot for one, foot, _, _ in self._waiting])
        here = np.concatenate([np.floor(one.along / part) for one, _, part, _ in self._waiting])
        frame = np.concatenate([np.full(len(one.laser), k) for one, _, _, k in self._waiting])
        laser, family, missed, run, closed = (
            np.concatenate([getattr(one, name) for one in strands])
            for name in ("laser", "family", "missed", "run", "closed")
        )
        self._waiting = []
        between = float(np.sum(1.0 / run[closed]))
        # Limit of the share missed between strands that are seen; above it the lattice is wrong.
        max_missed = 0.3
        if between > max_missed * (between + np.count_nonzero(~missed)):
            return
        says = looks_say(laser, family, here, missed, run)
        # Side of the map's cells, in bars: looks of one laser at one cell are alike.
        cell = 0.4
        column, row = np.floor(place / (cell * self._bar)).astype(np.int64).T
        keys = ((column + _ROW * row) * LASERS + laser) * 2 + missed
        self._looks = self._looks.added(keys, np.c_[np.ones(len(keys)), place, says], frame)
        column, row = np.floor(place / self._mesh).astype(np.int64).T
        self._meshes = np.unique(np.concatenate([self._meshes, column + _ROW * row]))

    def _near(self, places: FloatArray) -> BoolArray:
        """Mark the places (..., 2) in the part of the map that is not settled."""
        settled = 2.0  # What is farther from the vehicle is settled, in metres.
        return np.asarray(np.abs(places - self._last).max(axis=-1) < settled)

    def _find(self, lattice: NetLattice) -> list[Hole]:
        places, weights = self._looks.places, self._looks.weights()
        bar = lattice.bar
        # Missing strands may be a hole if this near to each other, in bars, and with this much
        # evidence; strands within the last distance determine its edge.
        near, min_near, reach = 1.5, 9.0, 6.5
        likely = np.flatnonzero(weights > 0.0)
        likely = likely[local_sums(places[likely], weights[likely], near * bar) > min_near]
        found, left = [], weights.copy()
        # Discs no farther apart than this are one hole, in bars.
        touch = 1.2
        for group in _groups(places[likely], 2.0 * near * bar):
            seeds = places[likely[group]]
            low, high = seeds.min(axis=0) - reach * bar, seeds.max(axis=0) + reach * bar
            around = np.all((places > low) & (places < high), axis=1)
            discs = find_discs(places[around], left[around], bar)
            # Only a part of a hole of another group may lie in these surroundings.
            discs = [one for one in discs if one.contains(seeds).any()]
            for disc in discs:
                # Another group also has this hole in its surroundings.
                left[disc.contains(places, RIM * bar)] = 0.0
            discs = [disc for disc in discs if self._looks.stays_dark(disc.middle, disc.radius)]
            found += [
                self._hole(lattice, some, places[around], weights[around])
                for some in _group_touching(discs, touch * bar)
            ]
        return found

    def _hole(
        self, lattice: NetLattice, discs: list[Disc], places: FloatArray, weights: FloatArray
    ) -> Hole:
        """Make a hole from its discs."""
        middle, extent, area = _outline(discs)
        nearest = min(self._feet.values(), key=lambda foot: float(np.hypot(*(foot[2] - middle))))
        diameter = float(np.sqrt(4.0 * area / np.pi))
        radius = np.array([disc.radius for disc in discs])
        sigma = float(np.hypot.reduce([2.0 * disc.sigma * disc.radius for disc in discs]))
        inside = np.any([disc.contains(places) for disc in discs], axis=0)
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
            feet=tuple(self._feet.values()),
        )

    def _drop_settled(self) -> None:
        """Drop cells far behind the vehicle."""
        if not len(self._looks.keys):
            return
        self._looks = self._looks.kept(self._near(self._looks.places))
        row = np.floor_divide(self._meshes + _ROW // 2, _ROW)
        at = np.stack([self._meshes - row * _ROW, row], axis=1) * self._mesh
        close = self._near(at)
        self._settled_meshes += int(np.count_nonzero(~close))
        self._meshes = self._meshes[close]
        self._feet = {key: one for key, one in self._feet.items() if self._near(one[2])}


def opening_area(lattice: NetLattice) -> float:
    """Return the area of one opening, from strand to strand, in square metres."""
    if lattice.mesh is Mesh.SIX_SIDED:
        return float(1.5 * np.sqrt(3.0) * lattice.bar**2)
    a, b = lattice.waves
    return float(1.0 / abs(a[0] * b[1] - a[1] * b[0]))


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


def _group_touching(discs: Sequence[Disc], apart: float) -> list[list[Disc]]:
    """Group discs that touch."""
    groups: list[list[Disc]] = []
    for disc in discs:
        mine, others = [disc], []
        for group in groups:
            reach = [disc.radius + one.radius + apart for one in group]
            away = [np.hypot(*(disc.middle - one.middle)) for one in group]
            if np.any(np.less(away, reach)):
                mine += group
            else:
                others.append(group)
        groups = [*others, mine]
    return groups


def _outline(discs: Sequence[Disc]) -> tuple[FloatArray, tuple[float, float], float]:
    """Return the middle (2,), width and height, and area of the union of discs."""
    middles, radii = np.array([d.middle for d in discs]), np.array([d.radius for d in discs])
    low = (middles - radii[:, None]).min(axis=0)
    high = (middles + radii[:, None]).max(axis=0)
    size = high - low
    if len(discs) == 1:
        return middles[0], (float(size[0]), float(size[1])), float(np.pi * radii[0] ** 2)
    # Squares of a side's 24th part measure the area of discs that overlap.
    squares = 24
    share = (np.arange(squares) + 0.5) / squares
    at = low + np.stack(np.meshgrid(share, share), axis=-1).reshape(-1, 2) * size
    inside = np.any(np.hypot(*(at[:, None] - middles).transpose(2, 0, 1)) < radii, axis=1)
    area = float(np.mean(inside) * size[0] * size[1])
    return at[inside].mean(axis=0), (float(size[0]), float(size[1])), area


def _overlap(one: Hole, other: Hole) -> bool:
    """Return whether two holes on one map overlap by half."""
    apart = float(np.hypot(*(one.place - other.place)))
    return one.piece == other.piece and apart < 0.25 * (one.diameter + other.diameter)
