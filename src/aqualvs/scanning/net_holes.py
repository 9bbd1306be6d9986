"""Holes: places on the net where strands that the lattice predicts are missing.

Along a laser's line neighbouring strands are no farther apart than the lattice allows. A longer
dark piece is a look through a hole, anything shorter a look at sound net. Looks from many places
are put together on a map that is fixed to the net; what most looks go through is a hole.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.scanning.net_cover import crossing_rates, long_gaps
from aqualvs.scanning.net_dashes import NetView
from aqualvs.scanning.net_hypotheses import Mesh
from aqualvs.scanning.net_lattice import NetLattice

# Through a hole as much light is seen on what is behind the net as elsewhere, but for this share.
_LET_THROUGH = 0.5
# Side of the map's cells, in bars; cells of a hole are no farther apart than so many bars.
_CELL, _REACH = 0.4, 0.8
# Frames count as looks of their own when the vehicle has moved this far, in bars; when it moved
# farther a look weighs as many such moves, up to a limit.
_LOOK, _MOST_WEIGHT = 0.2, 2.0
# Looks at a cell that count at most.
_MOST_LOOKS = 25.0
# Of the looks at a cell of a hole this share goes through.
_THROUGH = 0.6
# A hole: greater and smaller extent in bars, area in squares of a bar. And looks through it that
# are so many bars long together, where nothing speaks against it; sound looks in and around it
# count against it.
_LEAST_EXTENT, _LEAST_WIDTH, _LEAST_AREA = 2.0, 1.5, 2.0
_LEAST_SEEN, _AGAINST = 20.0, 0.9
# Cells farther from the vehicle than this are settled, in metres.
_SETTLED = 2.0
_ROW = 1 << 24
_BLOCK = np.ones((3, 3), np.bool_)


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


@dataclass(frozen=True, slots=True)
class Looks:
    """Looks of one frame, as pieces of line in `net`.

    Attributes
    ----------
    begin, end : array, shape (K, 2)
        Ends of the pieces, in metres.
    through : bool array, shape (K,)
        Whether they go through a hole, or end on strands.
    """

    begin: FloatArray
    end: FloatArray
    through: BoolArray


def find_looks(lattice: NetLattice, view: NetView) -> Looks:
    """Tell where a frame's lines cross sound net and where holes."""
    gaps = view.gaps
    long = long_gaps(lattice, view)
    # A hole lets light through; what is dark without is hidden by something.
    hole = long & (gaps.beyond >= _LET_THROUGH * view.beyond[gaps.laser])
    sound = ~long & gaps.closed.all(axis=1)
    # A hole begins, on average, half a usual gap after the last strand beside it.
    inset = 0.5 / (crossing_rates(lattice, view) @ lattice.density)
    ends = np.where(
        hole[:, None],
        gaps.ends + inset[gaps.laser, None] * gaps.closed * [1.0, -1.0],
        gaps.middles,
    )
    told = (hole | sound) & (ends[:, 1] > ends[:, 0])
    laser = gaps.laser[told]
    return Looks(view.at(laser, ends[told, 0]), view.at(laser, ends[told, 1]), hole[told])


@dataclass(slots=True)
class HoleMap:
    """The map of looks, fixed to the net, and the holes in it.

    Attributes
    ----------
    holes : list of Hole
        In the order in which they were found.
    """

    holes: list[Hole] = field(default_factory=list)
    _cell: float = 0.0
    _piece: int = -1
    _keys: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    _sound: FloatArray = field(default_factory=lambda: np.empty(0))
    _through: FloatArray = field(default_factory=lambda: np.empty(0))
    _waiting: list[tuple[IntArray, BoolArray, float]] = field(default_factory=list)
    _looks: dict[tuple[int, int], tuple[int, float, FloatArray]] = field(default_factory=dict)
    _last: FloatArray | None = None
    _settled_cells: int = 0

    @property
    def area(self) -> float:
        """Area of net that was looked at, in square metres: the cells that lines passed."""
        return (self._settled_cells + len(self._keys)) * self._cell**2

    def add(self, lattice: NetLattice, view: NetView, place: FloatArray, piece: int) -> None:
        """Add a frame's looks.

        Parameters
        ----------
        lattice : NetLattice
            Of the stretch.
        view : NetView
            What the frame shows.
        place : array, shape (2,)
            Where the origin of `net` lies on the map, in metres.
        piece : int
            As `NetTrack.piece`: a new piece starts a new map.
        """
        if self._cell == 0.0:
            self._cell = _CELL * lattice.bar
        if piece != self._piece:
            self._start_over(piece)
        weight = 1.0
        if self._last is not None:
            weight = float(np.hypot(*(place - self._last))) / (_LOOK * lattice.bar)
            if weight < 1.0:
                return
        self._last = place.copy()
        keys, through = _cells(find_looks(lattice, view), place, self._cell)
        # A look stands for the net that was passed since the one before.
        self._waiting.append((keys, through, min(weight, _MOST_WEIGHT)))
        column, row = np.floor(place / (_LOOK * lattice.bar)).astype(int)
        self._looks.setdefault((int(column), int(row)), (view.index, view.time_s, place.copy()))

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
        self._merge()
        self._settled_cells += len(self._keys)
        self._keys, self._sound = np.empty(0, np.int64), np.empty(0)
        self._through, self._looks = np.empty(0), {}
        self._piece, self._last = piece, None

    def _merge(self) -> None:
        if not self._waiting:
            return
        fresh = np.concatenate([keys for keys, _, _ in self._waiting])
        through = np.concatenate([through for _, through, _ in self._waiting])
        weight = np.repeat(
            [weight for _, _, weight in self._waiting], [len(one[0]) for one in self._waiting]
        )
        keys, index = np.unique(np.concatenate([self._keys, fresh]), return_inverse=True)
        old, new = index[: len(self._keys)], index[len(self._keys) :]
        sound, passed = np.zeros(len(keys)), np.zeros(len(keys))
        sound[old], passed[old] = self._sound, self._through
        sound += np.bincount(new[~through], weight[~through], minlength=len(keys))
        passed += np.bincount(new[through], weight[through], minlength=len(keys))
        # What was looked at for long counts no more than what was passed slowly.
        kept = np.minimum(1.0, _MOST_LOOKS / np.maximum(sound + passed, 1.0))
        self._keys, self._sound, self._through = keys, kept * sound, kept * passed
        self._waiting = []

    def _centres(self) -> FloatArray:
        """Middles of the cells on the map, shape (n, 2)."""
        row = np.floor_divide(self._keys + _ROW // 2, _ROW)
        column = self._keys - row * _ROW
        return (np.stack([column, row], axis=1) + 0.5) * self._cell

    def _near(self, hole: Hole) -> bool:
        """Whether a hole lies where the map is still open."""
        if not len(self._keys):
            return False
        away = np.abs(self._centres() - hole.place).max(axis=1)
        return bool(away.min() < self._cell)

    def _find(self, lattice: NetLattice) -> list[Hole]:
        total = self._sound + self._through
        open_ = (self._through >= 1.0) & (self._through > _THROUGH * total)
        if np.count_nonzero(open_) < 2:
            return []
        centres = self._centres()
        group = _groups(centres[open_], _REACH * lattice.bar)
        rows = np.flatnonzero(open_)
        found = []
        for number in range(group.max() + 1):
            hole = self._hole(lattice, rows[group == number], centres)
            if hole is not None:
                found.append(hole)
        return found

    def _hole(self, lattice: NetLattice, rows: IntArray, centres: FloatArray) -> Hole | None:
        """Measure a group of cells, or None where it is too small or too little seen."""
        bar = lattice.bar
        seen = float(self._through[rows].sum()) * self._cell / bar
        places = centres[rows]
        size = places.max(axis=0) - places.min(axis=0) + self._cell
        # Cells between the lines of sight belong to the hole where no look says otherwise.
        filled, inside = _filled(places, centres, self._cell, _REACH * bar)
        area = filled * self._cell**2
        if size.max() < _LEAST_EXTENT * bar or size.min() < _LEAST_WIDTH * bar:
            return None
        if area < _LEAST_AREA * bar**2:
            return None
        through, sound = float(self._through[inside].sum()), float(self._sound[inside].sum())
        if seen * (through - _AGAINST * sound) < _LEAST_SEEN * (through + sound):
            return None
        weight = self._through[rows]
        middle = (places * weight[:, None]).sum(axis=0) / weight.sum()
        nearest = min(self._looks.values(), key=lambda look: float(np.hypot(*(look[2] - middle))))
        # Cells on the hole's edge see both sides of it; half of them are left out all around.
        diameter = float(np.sqrt(4.0 * area / np.pi)) + self._cell
        return Hole(
            piece=self._piece,
            place=middle,
            extent=(float(size[0]), float(size[1])),
            diameter=diameter,
            sigma_diameter=0.5 * bar,
            missing_meshes=area / opening_area(lattice),
            frame=nearest[0],
            time_s=nearest[1],
            from_foot=middle - nearest[2],
            n_looks=int(weight.max()),
        )

    def _settle(self) -> None:
        """Forget cells that the vehicle has left behind."""
        if self._last is None or not len(self._keys):
            return
        close = np.abs(self._centres() - self._last).max(axis=1) < _SETTLED
        self._settled_cells += int(np.count_nonzero(~close))
        self._keys = self._keys[close]
        self._sound, self._through = self._sound[close], self._through[close]
        self._looks = {
            key: one
            for key, one in self._looks.items()
            if np.abs(one[2] - self._last).max() < _SETTLED
        }


def opening_area(lattice: NetLattice) -> float:
    """Area of one opening, from strand to strand, in square metres."""
    if lattice.mesh is Mesh.SIX_SIDED:
        return float(1.5 * np.sqrt(3.0) * lattice.bar**2)
    a, b = lattice.waves
    return float(1.0 / abs(a[0] * b[1] - a[1] * b[0]))


def _cells(looks: Looks, place: FloatArray, cell: float) -> tuple[IntArray, BoolArray]:
    """Keys of the cells that looks pass, and whether through a hole; each once a look."""
    length = np.hypot(*(looks.end - looks.begin).T)
    pieces = np.maximum(np.ceil(2.0 * length / cell), 1.0).astype(np.int64)
    number = np.repeat(np.arange(len(pieces)), pieces)
    share = (np.arange(len(number)) - np.repeat(np.cumsum(pieces) - pieces, pieces) + 0.5) / (
        pieces[number]
    )
    at = looks.begin[number] + share[:, None] * (looks.end - looks.begin)[number] + place
    column, row = np.floor(at / cell).astype(np.int64).T
    keys = np.unique(np.stack([column + _ROW * row, looks.through[number]], axis=1), axis=0)
    return keys[:, 0], keys[:, 1] == 1


def _groups(places: FloatArray, reach: float) -> IntArray:
    """Give a number to every group of places that steps of up to `reach` connect."""
    grid, index = _raster(places, reach / 2.0)
    labels, _ = ndimage.label(ndimage.binary_dilation(grid, _BLOCK), _BLOCK)
    numbers = labels[tuple(index.T)]
    _, group = np.unique(numbers, return_inverse=True)
    return np.asarray(group, np.int64)


def _filled(
    places: FloatArray, others: FloatArray, cell: float, reach: float
) -> tuple[int, BoolArray]:
    """Close the gaps between cells; how many cells that makes, and which others lie among them."""
    steps = max(round(reach / cell), 1)
    grid, _ = _raster(places, cell)
    closed = ndimage.binary_closing(np.pad(grid, steps + 1), _BLOCK, iterations=steps)
    index = np.floor((others - places.min(axis=0)) / cell + 1e-9).astype(np.int64) + steps + 2
    inside = np.all((index >= 0) & (index < closed.shape), axis=1)
    inside[inside] = closed[tuple(index[inside].T)]
    return int(np.count_nonzero(closed)), inside


def _raster(places: FloatArray, cell: float) -> tuple[BoolArray, IntArray]:
    index = np.floor((places - places.min(axis=0)) / cell + 1e-9).astype(np.int64) + 1
    grid = np.zeros(index.max(axis=0) + 2, np.bool_)
    grid[tuple(index.T)] = True
    return grid, index


def _same(one: Hole, other: Hole) -> bool:
    """Whether two holes on one map overlap by half."""
    apart = float(np.hypot(*(one.place - other.place)))
    return one.piece == other.piece and apart < 0.25 * (one.diameter + other.diameter)


def merge_holes(holes: Sequence[Hole]) -> list[Hole]:
    """Return holes in the order in which the vehicle passed them."""
    return sorted(holes, key=lambda hole: (hole.time_s, hole.frame))
