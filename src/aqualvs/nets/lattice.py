"""The lattice of a net: spacing and directions of its strands, and the track along the net.

`find_lattice` fits the lattice to the crossings of some frames. `LatticeFitter` finds its place in
each frame, and `NetTrack` follows the vehicle's motion along the net from these places. A lattice
fixes the place of the net only up to whole meshes; the right one is chosen from the motion so far
(a Kalman filter with constant velocity). So the motion from frame to frame must be predicted to
better than half a mesh: pass the vehicle's velocity where another sensor measures it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.nets.dashes import Dashes
from aqualvs.nets.spectrum import (
    Crossings,
    Hypothesis,
    Mesh,
    Spectrum,
    bar_of,
    hypotheses,
    refine,
    score,
    turned,
)
from aqualvs.nets.spectrum_kernels import wave_sums


class _FitOptions(NamedTuple):
    """Search for a lattice in some frames, and its fit."""

    # Number of frames for the fit of a lattice, and of those among them for the search.
    max_frames: int = 30
    searched_frames: int = 12
    # Number of likely lattices that are refined roughly, and of the best that are refined well.
    followed: int = 12
    compared: int = 4
    first_rounds: int = 2
    rounds: int = 5
    last_rounds: int = 7
    # Least log-likelihood per frame of a lattice; less may be chance.
    min_score: float = 0.3
    # Number of parts of the frames whose bars are compared, and the relative error of the search.
    blocks: int = 4
    search_error: float = 0.005


_FIT = _FitOptions()


@dataclass(frozen=True, slots=True)
class NetLattice:
    """A net's lattice in `net` directions."""

    mesh: Mesh  # Shape of the openings.
    bar: float  # Length of a side of an opening (half mesh), in metres.
    sigma_bar: float  # Its standard deviation.
    # Shape (F, 2): wave vector of every family of strands: normal to the strands, one over their
    # distance.
    waves: FloatArray
    # Log-likelihood per frame over crossings at random.
    score: float

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


def find_lattice(
    frames: Sequence[Crossings], before: NetLattice | None = None
) -> NetLattice | None:
    """Find the lattice of the net in some frames, or None where none is visible.

    Between the frames the net may have moved in its plane, but not turned. `before`: lattice of
    neighbouring frames; tried first.
    """
    # Least crossings of a usable frame.
    min_crossings = 5
    useful = [one for one in frames if len(one.place) >= min_crossings]
    chosen = _spread(useful, _FIT.max_frames)
    if not chosen:
        return None
    spectrum = Spectrum.of(chosen)
    best = _refine_known(before, spectrum) if before is not None else None
    if best is None:
        best = _search(Spectrum.of(_spread(chosen, _FIT.searched_frames)))
        best = best and refine(best, spectrum, _FIT.last_rounds)
    # A chance result of a few frames is not confirmed by all of them.
    if best is None or best.score < _FIT.min_score:
        return None
    return NetLattice(best.mesh, bar_of(best), _sigma(best, chosen), best.families(), best.score)


def _search(spectrum: Spectrum) -> Hypothesis | None:
    rough = [replace(one, score=score(spectrum, one)) for one in hypotheses(spectrum)]
    rough.sort(key=lambda one: -one.score)
    tried = [refine(one, spectrum, _FIT.first_rounds) for one in rough[: _FIT.followed]]
    tried.sort(key=lambda one: -one.score)
    tried[: _FIT.compared] = [refine(one, spectrum, _FIT.rounds) for one in tried[: _FIT.compared]]
    best = max(tried, key=lambda one: one.score)
    # Least lead of the best lattice over those with another bar length.
    min_lead, same_bar = 0.2, 0.06
    others = [one.score for one in tried if abs(np.log(bar_of(one) / bar_of(best))) > same_bar]
    if best.score < max([_FIT.min_score, *(score + min_lead for score in others)]):
        return None
    return best


def _refine_known(before: NetLattice, spectrum: Spectrum) -> Hypothesis | None:
    """Return the previous lattice, if it explains these frames nearly as well."""
    # The previous lattice is kept with this share of its score, turned by up to this many degrees.
    as_before, turns = 0.6, (0.0, -4.0, 4.0)
    enough = max(_FIT.min_score, as_before * before.score)
    for angle in np.deg2rad(turns):
        found = refine(Hypothesis(before.mesh, before.basis @ turned(angle).T), spectrum, 3)
        if found.score >= enough:
            return refine(found, spectrum, 5)
    return None


def _spread(frames: Sequence[Crossings], most: int) -> list[Crossings]:
    """Return at most `most` frames, evenly spread."""
    index = np.linspace(0, len(frames) - 1, min(len(frames), most)).round().astype(int)
    return [frames[i] for i in index]


def _sigma(best: Hypothesis, frames: Sequence[Crossings]) -> float:
    """Return the standard deviation of the bar, from the differences of parts of the frames."""
    size = bar_of(best)
    blocks = [b for b in np.array_split(np.arange(len(frames)), _FIT.blocks) if len(b)]
    if len(blocks) < 2:
        return 0.02 * size
    spectra = [Spectrum.of([frames[i] for i in block]) for block in blocks]
    bars = [bar_of(refine(best, spectrum, 3)) for spectrum in spectra]
    return float(np.hypot(np.std(bars, ddof=1) / np.sqrt(len(bars)), _FIT.search_error * size))


class _TrackOptions(NamedTuple):
    """Place of the lattice from frame to frame."""

    # Least match: as a share of that of perfect crossings, and in deviations of random ones.
    min_share: float = 0.4
    min_deviations: float = 3.0
    min_crossings: int = 4
    # Standard deviations: velocity at first and with another sensor (m/s), acceleration (m/s²), and
    # the foot of the perpendicular on the net in one frame (m), by noise of the posture.
    velocity: float = 0.15
    told_velocity: float = 0.03
    acceleration: float = 0.25
    foot: float = 1.5e-3
    # Velocities at which a piece of track may begin (m/s): greatest, step, standard deviation
    # before and after it is found; and the least number of frames.
    fastest: float = 0.45
    step: float = 0.0125
    usual: float = 0.2
    found: float = 0.04
    min_frames: int = 4
    # A new piece of track begins where the standard deviation of the place exceeds this, in metres;
    # after this many seconds the velocity is discarded as well.
    lost: float = 0.05
    forgotten: float = 3.0


_TRACK = _TrackOptions()


START_FRAMES, START_S = 8, 0.5
"""Number of frames for the start of a track, and the seconds within which they lie."""


@dataclass(frozen=True, slots=True)
class Fit:
    """Assignment of a frame's dashes to strands of the lattice."""

    family: IntArray  # Shape (N,): family whose strand is nearest to each dash.
    strand: IntArray  # Shape (N,): index of that strand.
    off: FloatArray  # Shape (N,): distance of the dash from it, in metres.
    # Shape (N,): distance from the nearest strand of any other family, in metres.
    clear: FloatArray

    @property
    def n_strands(self) -> int:
        """Number of strands in the frame."""
        return len(np.unique(np.stack([self.family, self.strand]), axis=1).T)


@dataclass(frozen=True, slots=True)
class LatticeShift:
    """Place of the lattice in one frame, with its information."""

    # Shape (2,): of a knot (four-sided) or the middle of an opening (six-sided) in `net`, in
    # metres; all knots or openings are equivalent.
    place: FloatArray
    # Shape (2, 2): inverse of its covariance; may be singular.
    information: FloatArray


@dataclass(frozen=True, slots=True)
class TrackStart:
    """Start of a track: place and velocity common to some consecutive frames."""

    # Shape (2,): place of the lattice in the first frame, as `LatticeShift.place`.
    place: FloatArray
    # Shape (2,): of the vehicle along the net, in m/s.
    velocity: FloatArray


class LatticeFitter:
    """Fitter of the place of a lattice in frames."""

    def __init__(self, lattice: NetLattice) -> None:
        self.lattice = lattice
        self._waves, self._amplitude, step = _pattern(lattice)
        # Shifts by up to this many cells to each side are tried, in this many steps: they cover the
        # cell around the expected place, whatever its shape.
        reach, tried = 0.75, 18
        share = np.arange(-tried, tried + 1) * (reach / tried)
        self._away = np.stack(np.meshgrid(share, share), axis=-1).reshape(-1, 2) @ step
        self._swings = np.exp(-2j * np.pi * (self._away @ self._waves.T))

    def shift(
        self,
        crossings: Crossings,
        expected: FloatArray | None = None,
        precision: FloatArray | None = None,
    ) -> LatticeShift | None:
        """Find the place of the lattice in a frame; None if its crossings do not determine it.

        The expected place (2,) selects one of many equivalent shifts; `precision`, shape (2, 2), is
        the inverse of its covariance.
        """
        if len(crossings.place) < _TRACK.min_crossings:
            return None
        expected = np.zeros(2) if expected is None else expected
        precision = np.zeros((2, 2)) if precision is None else precision
        sums = self._amplitude * _sums(crossings, self._waves)
        here = sums * np.exp(-2j * np.pi * (self._waves @ expected))
        prior = np.sum((self._away @ precision) * self._away, axis=1)
        score = 2.0 * (self._swings @ here).real - 0.5 * prior
        place = expected + self._away[np.argmax(score)]
        # Newton's steps to the best shift, and its regularisation in undetermined directions
        # (1/m²).
        track_rounds, stiff = 4, 100.0
        for _ in range(track_rounds):
            _, slope, information = self._about(sums, place)
            place = place + np.linalg.solve(information + stiff * np.eye(2), slope)
        match, _, information = self._about(sums, place)
        full = len(crossings.place) * float(np.sum(self._amplitude**2))
        if match < max(_TRACK.min_share * full, _TRACK.min_deviations * np.sqrt(0.5 * full)):
            return None
        return LatticeShift(place, information)

    def start(self, crossings: Sequence[Crossings], times_s: FloatArray) -> TrackStart | None:
        """Find the place and velocity common to some frames; None where they are too few.

        A single frame may be off, and from frame to frame the net may move by nearly half a mesh:
        several frames together separate the two. The velocity changes little meanwhile. `times_s`:
        of the frames, one for each.
        """
        usable = [i for i, one in enumerate(crossings) if len(one.place) >= _TRACK.min_crossings]
        if len(usable) < _TRACK.min_frames:
            return None
        size = np.hypot(*self._waves.T)
        longest = size < 1.2 * size.min()
        waves = self._waves[longest]
        share = np.arange(-_TRACK.fastest, _TRACK.fastest + _TRACK.step, _TRACK.step)
        velocity = np.stack(np.meshgrid(share, share), axis=-1).reshape(-1, 2)
        rate = velocity @ waves.T
        total = np.zeros(rate.shape, np.complex128)
        for i in usable:
            sums = self._amplitude[longest] * _sums(crossings[i], waves)
            total += sums * np.exp(2j * np.pi * rate * (times_s[i] - times_s[0]))
        speed = np.hypot(*velocity.T)
        score = 2.0 * np.abs(total).sum(axis=1) - speed**2 / (2.0 * _TRACK.usual**2)
        # Velocities that differ by a whole mesh per frame look the same: the slowest one with this
        # share of the best match is taken, and then the best one within this distance of it (m/s).
        as_good, same_velocity = 0.9, 0.05
        slowest = np.argmin(np.where(score >= as_good * score.max(), speed, np.inf))
        near = np.hypot(*(velocity - velocity[slowest]).T) < same_velocity
        best = int(np.argmax(np.where(near, score, -np.inf)))
        match = (self._swings[:, longest] @ total[best]).real
        return TrackStart(self._away[np.argmax(match)], velocity[best])

    def _about(
        self, sums: NDArray[np.complex128], place: FloatArray
    ) -> tuple[float, FloatArray, FloatArray]:
        """Return the match at a shift, and slope (2,) and information (2, 2) of its likelihood."""
        swung = sums * np.exp(-2j * np.pi * (self._waves @ place))
        slope = 4.0 * np.pi * (swung.imag @ self._waves)
        bend = np.maximum(swung.real, 0.0)
        information = 8.0 * np.pi**2 * (self._waves.T * bend) @ self._waves
        return float(swung.real.sum()), slope, information

    def assign(self, dashes: Dashes, place: FloatArray) -> Fit:
        """Assign each dash to the nearest strand of the lattice at a place (2,)."""
        lattice = self.lattice
        turns = (dashes.place - place) @ lattice.waves.T
        distance = np.abs(turns - np.rint(turns)) * lattice.pitch
        rows = np.arange(len(dashes))
        family = np.argmin(distance, axis=1)
        off = distance[rows, family]
        distance[rows, family] = np.inf
        return Fit(
            family=family,
            strand=np.rint(turns[rows, family]).astype(np.int64),
            off=off,
            clear=distance.min(axis=1),
        )


def _sums(crossings: Crossings, waves: FloatArray) -> NDArray[np.complex128]:
    """Return the sums of waves over crossings, less what evenly spread ones would give."""
    seen = np.bincount(crossings.laser, minlength=len(crossings.length))
    per_metre = seen / np.maximum(crossings.length, 1e-9)
    length = np.hypot(*(crossings.end - crossings.begin).T)
    expected = length * per_metre[crossings.span_laser]
    return wave_sums(crossings.place, crossings.begin, crossings.end, expected, waves)


def _pattern(lattice: NetLattice) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the plane waves of a lattice, about a knot or the middle of a six-sided opening.

    Return wave vectors (Q, 2), their amplitudes (Q,) for one crossing, and two steps, rows of a
    matrix (2, 2), that take the lattice to itself.
    """
    basis = lattice.basis
    step = _inverse(basis).T
    # Harmonics of each family's wave; irregular spacing reduces each amplitude to this share.
    harmonics, regular = 3, 0.92
    if lattice.mesh is Mesh.FOUR_SIDED:
        number = np.arange(1.0, harmonics + 1.0)
        waves = np.concatenate([number[:, None] * basis[0], number[:, None] * basis[1]])
        return waves, 0.5 * np.tile(regular**number, 2), step
    # The shells of the reciprocal lattice; one of each wave and its mirror.
    first = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, -1.0]])
    second = np.array([[1.0, 1.0], [2.0, -1.0], [1.0, -2.0]])
    waves = np.concatenate([first, second, 2.0 * first, 2.0 * second]) @ basis
    # Bars lie half way between middles, perpendicular to the line that connects them.
    ways = np.array([step[0], step[1], step[0] + step[1]])
    bars = np.stack([-ways[:, 1], ways[:, 0]], axis=1) / np.sqrt(3.0)
    each = np.cos(np.pi * waves @ ways.T) * np.sinc(waves @ bars.T)
    return waves, regular * each.mean(axis=1), step


def _inverse(matrix: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(matrix), np.float64)


def _initial_covariance() -> FloatArray:
    """Return the covariance of place and velocity where a piece of track begins."""
    return np.diag([_TRACK.foot**2, _TRACK.foot**2, _TRACK.velocity**2, _TRACK.velocity**2])


@dataclass(slots=True)
class NetTrack:
    """Tracker of the vehicle's motion along the net."""

    # Incremented whenever the track is lost: places of different pieces are not related.
    piece: int = 0

    _state: FloatArray = field(default_factory=lambda: np.zeros(4))
    _covariance: FloatArray = field(default_factory=_initial_covariance)
    _time_s: float = 0.0
    _origin: FloatArray | None = None
    _lattice: NetLattice | None = None

    @property
    def place(self) -> FloatArray:
        """Place (2,) of the vehicle's foot on the net: right and up of the first one, in metres."""
        return self._state[:2].copy()

    @property
    def velocity(self) -> FloatArray:
        """Velocity (2,) of that place, in metres a second."""
        return self._state[2:].copy()

    def begins(self, time_s: float) -> bool:
        """Return whether place and velocity are unknown at a time."""
        return self._origin is None or time_s - self._time_s > _TRACK.forgotten

    def step(
        self,
        fitter: LatticeFitter,
        crossings: Crossings,
        time_s: float,
        velocity: FloatArray | None = None,
        start: TrackStart | None = None,
    ) -> LatticeShift | None:
        """Add the next frame; return None where it does not determine the place of the net.

        Parameters
        ----------
        velocity : array, shape (2,), optional
            Of the vehicle along the net, right and up, if another sensor measures it.
        start : TrackStart, optional
            Place and velocity common to this frame and the next, where the track begins.
        """
        state, covariance = self._predict(time_s, velocity)
        if self._origin is None or covariance[:2, :2].trace() > _TRACK.lost**2:
            return self._begin_piece(fitter, crossings, time_s, state, start)
        if self._lattice is not fitter.lattice:
            shift = fitter.shift(crossings)
            if shift is not None:
                # The same net with a new estimate of its lattice: it lies at the expected place.
                self._lattice, self._origin = fitter.lattice, state[:2] + shift.place
                self._update(state, covariance, time_s)
            return shift
        precision = _inverse(covariance[:2, :2] + _TRACK.foot**2 * np.eye(2))
        shift = fitter.shift(crossings, self._origin - state[:2], precision)
        if shift is not None:
            information = np.zeros((4, 4))
            information[:2, :2] = shift.information @ _inverse(
                np.eye(2) + _TRACK.foot**2 * shift.information
            )
            covariance = _inverse(_inverse(covariance) + information)
            miss = np.r_[self._origin - shift.place - state[:2], 0.0, 0.0]
            self._update(state + covariance @ information @ miss, covariance, time_s)
        return shift

    def _predict(self, time_s: float, velocity: FloatArray | None) -> tuple[FloatArray, FloatArray]:
        """Return the state and covariance at a later time."""
        dt = time_s - self._time_s
        state, covariance = self._state.copy(), self._covariance.copy()
        if velocity is not None:
            state[2:] = velocity
            covariance[2:, :2] = covariance[:2, 2:] = 0.0
            covariance[2:, 2:] = _TRACK.told_velocity**2 * np.eye(2)
        move = np.eye(4)
        move[:2, 2:] = dt * np.eye(2)
        noise = np.outer([0.5 * dt**2, dt], [0.5 * dt**2, dt]) * _TRACK.acceleration**2
        return move @ state, move @ covariance @ move.T + np.kron(noise, np.eye(2))

    def _begin_piece(
        self,
        fitter: LatticeFitter,
        crossings: Crossings,
        time_s: float,
        state: FloatArray,
        start: TrackStart | None,
    ) -> LatticeShift | None:
        """Begin a piece of track, from the predicted state if the last piece ended recently."""
        # Standard deviation of the place at such a start, in metres.
        place = 2e-3
        expected = (start.place, np.eye(2) / place**2) if start else ()
        shift = fitter.shift(crossings, *expected)
        if shift is None:
            return None
        covariance = _initial_covariance()
        if self.begins(time_s):
            state = np.r_[self.place, 0.0, 0.0]
            if start is not None:
                state[2:] = start.velocity
                covariance[2:, 2:] = _TRACK.found**2 * np.eye(2)
        self.piece += self._origin is not None
        self._lattice, self._origin = fitter.lattice, state[:2] + shift.place
        self._update(state, covariance, time_s)
        return shift

    def _update(self, state: FloatArray, covariance: FloatArray, time_s: float) -> None:
        self._state, self._covariance, self._time_s = state, covariance, time_s
