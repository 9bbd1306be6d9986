"""The lattice of a net: how far apart its strands are and which way they run."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.scanning.net_hypotheses import (
    Hypothesis,
    Mesh,
    bar_of,
    hypotheses,
    refine,
    score,
    turned,
)
from aqualvs.scanning.net_spectrum import Crossings, Spectrum

# Frames that a lattice is fitted to, and among them those in which it is searched for.
_MOST_FRAMES, _SEARCHED_FRAMES = 30, 12
# Likely lattices that are refined roughly, and the best of them well, before they are compared.
_FOLLOWED, _COMPARED = 12, 4
_FIRST_ROUNDS, _ROUNDS, _LAST_ROUNDS = 2, 5, 7
# Fewer crossings in a frame say nothing.
_LEAST_CROSSINGS = 5
# Lattices with less log-likelihood per frame may as well be chance.
_LEAST_SCORE = 0.3
# The best lattice leads by as much before those with another length of bar.
_LEAST_LEAD, _SAME_BAR = 0.2, 0.06
# The lattice of the frames before holds on with this share of its score, turned by so many degrees.
_AS_BEFORE, _TURNS = 0.6, (0.0, -4.0, 4.0)
# Parts of the frames whose bars are compared, and what the search itself adds, as a share.
_BLOCKS, _SEARCH_ERROR = 4, 0.005


@dataclass(frozen=True, slots=True)
class NetLattice:
    """A net's lattice in `net` directions.

    Attributes
    ----------
    mesh : Mesh
        Shape of the openings.
    bar : float
        Length of a side of an opening (half mesh), in metres.
    sigma_bar : float
        Its standard deviation.
    waves : array, shape (F, 2)
        Wave vector of every family of strands: normal to the strands, one over their distance.
    score : float
        Log-likelihood per frame over crossings at random.
    density : array, shape (F,)
        Share of each family's lines that is really there: 1, or 1/3 for the bars of hexagons.
    """

    mesh: Mesh
    bar: float
    sigma_bar: float
    waves: FloatArray
    score: float
    density: FloatArray

    @property
    def basis(self) -> FloatArray:
        """Two waves that span the lattice: its longest, shape (2, 2)."""
        if self.mesh is Mesh.FOUR_SIDED:
            return self.waves
        first, second, third = self.waves
        return np.array([first + third, first + second]) / 3.0

    @property
    def pitch(self) -> FloatArray:
        """Distance between neighbouring strands of each family, in metres."""
        return np.asarray(1.0 / np.linalg.norm(self.waves, axis=1), np.float64)

    @property
    def normals(self) -> FloatArray:
        """Unit vectors across each family's strands, shape (F, 2)."""
        return self.waves * self.pitch[:, None]

    @property
    def strand_angles(self) -> FloatArray:
        """Direction of each family's strands, counter-clockwise from right, 0 to pi."""
        return np.mod(np.arctan2(self.waves[:, 1], self.waves[:, 0]) + 0.5 * np.pi, np.pi)

    def crossings_per_metre(self, direction: FloatArray) -> float:
        """Crossings that a line of unit direction (2,) has with strands."""
        return float(np.abs(self.waves @ direction) @ self.density)


def find_lattice(
    frames: Sequence[Crossings], before: NetLattice | None = None
) -> NetLattice | None:
    """Find the lattice of the net that some frames show, or None where there is none to be seen.

    Parameters
    ----------
    frames : sequence of Crossings
        The net may have moved between them in its plane, but not turned.
    before : NetLattice, optional
        What neighbouring frames showed; looked for first.
    """
    chosen = _choose(frames)
    if not chosen:
        return None
    spectrum = Spectrum.of(chosen)
    best = _known(before, spectrum) if before is not None else None
    if best is None:
        best = _searched(Spectrum.of(_spread(chosen, _SEARCHED_FRAMES)))
        best = best and refine(best, spectrum, _LAST_ROUNDS)
    # What few frames show by chance all of them do not.
    if best is None or best.score < _LEAST_SCORE:
        return None
    return _lattice(best, _sigma(best, chosen))


def _searched(spectrum: Spectrum) -> Hypothesis | None:
    rough = [one.scored(score(spectrum, one)) for one in hypotheses(spectrum)]
    rough.sort(key=lambda one: -one.score)
    tried = [refine(one, spectrum, _FIRST_ROUNDS) for one in rough[:_FOLLOWED]]
    tried.sort(key=lambda one: -one.score)
    tried[:_COMPARED] = [refine(one, spectrum, _ROUNDS) for one in tried[:_COMPARED]]
    best = max(tried, key=lambda one: one.score)
    others = [one.score for one in tried if abs(np.log(bar_of(one) / bar_of(best))) > _SAME_BAR]
    if best.score < max([_LEAST_SCORE, *(score + _LEAST_LEAD for score in others)]):
        return None
    return best


def _known(before: NetLattice, spectrum: Spectrum) -> Hypothesis | None:
    """Return the lattice seen before, where it explains these frames nearly as well."""
    enough = max(_LEAST_SCORE, _AS_BEFORE * before.score)
    for angle in np.deg2rad(_TURNS):
        found = refine(Hypothesis(before.mesh, before.basis @ turned(angle).T), spectrum, 3)
        if found.score >= enough:
            return refine(found, spectrum, 5)
    return None


def _choose(frames: Sequence[Crossings]) -> list[Crossings]:
    """Return some frames, evenly spread, of those with enough crossings to tell anything."""
    useful = [one for one in frames if len(one.place) >= _LEAST_CROSSINGS]
    return _spread(useful, _MOST_FRAMES)


def _spread(frames: Sequence[Crossings], most: int) -> list[Crossings]:
    """Return so many frames at most, evenly spread."""
    if len(frames) <= most:
        return list(frames)
    index = np.linspace(0, len(frames) - 1, most).round().astype(int)
    return [frames[i] for i in index]


def _sigma(best: Hypothesis, frames: Sequence[Crossings]) -> float:
    """Return the standard deviation of the bar: how far the quarters of the frames differ."""
    size = bar_of(best)
    blocks = [b for b in np.array_split(np.arange(len(frames)), _BLOCKS) if len(b)]
    if len(blocks) < 2:
        return 0.02 * size
    bars = []
    for block in blocks:
        spectrum = Spectrum.of([frames[i] for i in block])
        bars.append(bar_of(refine(best, spectrum, 3)))
    return float(np.hypot(np.std(bars, ddof=1) / np.sqrt(len(bars)), _SEARCH_ERROR * size))


def _lattice(best: Hypothesis, sigma_bar: float) -> NetLattice:
    return NetLattice(
        mesh=best.mesh,
        bar=bar_of(best),
        sigma_bar=sigma_bar,
        waves=best.families(),
        score=best.score,
        density=best.density(),
    )
