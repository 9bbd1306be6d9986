"""The condition of a net, by sections of the dive: mesh size, twine, solidity, holes.

Scans are added one by one. A section of net ("stretch") is evaluated as a whole when the vehicle
has passed it, so that its lattice, light and twine serve all of its frames.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.nets.coverage import RegisteredView, Twine, dash_kinds, measure_solidity, measure_twine
from aqualvs.nets.dashes import NetView, crossings_of, find_dashes
from aqualvs.nets.holes import Hole, HoleMap
from aqualvs.nets.lattice import (
    START_FRAMES,
    START_S,
    LatticeFitter,
    NetLattice,
    NetTrack,
    TrackStart,
    find_lattice,
)
from aqualvs.nets.lit_intervals import LineState, NetReader, NetSignal
from aqualvs.nets.spectrum import Crossings, Mesh
from aqualvs.optics.rig import Rig
from aqualvs.scanning.scan import Scan


@dataclass(frozen=True, slots=True, kw_only=True)
class NetConditionOptions:
    """Options of the evaluation: length of a section of net, and the known twine."""

    stretch_s: float = 5.0  # A stretch of net ends after this time,
    stretch: float = 0.5  # or after the vehicle has moved this far along the net, in metres.
    # Diameter of the bare twine in metres, where it is known: makes solidity more accurate.
    twine: float | None = None


@dataclass(frozen=True, slots=True)
class NetStretch:
    """Condition of a section (stretch) of net; None for values that could not be measured."""

    # Frames in which it was seen.
    first_frame: int
    last_frame: int
    # Their times.
    begin_s: float
    end_s: float
    # Frames with a posture.
    n_frames: int
    # Mean distance from the vehicle, in metres.
    range: float
    # Shape (2,): the vehicle's foot on the net (of the perpendicular from the dome's centre) at its
    # beginning and its end: right and up of the track's start, in metres.
    begin_place: FloatArray
    place: FloatArray
    # Piece of track that `place` belongs to; a change from the stretch before means that the track
    # was lost in between.
    piece: int
    # Shape and size of the mesh, directions of the strands.
    lattice: NetLattice | None
    # Thickness of the twine.
    twine: Twine | None
    # Share of the area that strands and growth cover, 0 to 1.
    solidity: float | None
    sigma_solidity: float | None
    # Mean number of strands in a frame.
    n_strands: float
    # Observed length of laser line, in metres.
    seen_length: float

    @property
    def clean_solidity(self) -> float | None:
        """Solidity of the bare twine alone; any excess is growth."""
        if self.lattice is None or self.twine is None:
            return None
        d, bar = self.twine.thickness, self.lattice.bar
        if self.lattice.mesh is Mesh.SIX_SIDED:
            return float(min(2.0 * d / (np.sqrt(3.0) * bar), 1.0))
        a, b = d / self.lattice.pitch
        return float(min(a + b - a * b, 1.0))


@dataclass(frozen=True, slots=True)
class _Observations:
    """Observations of the n frames of a stretch."""

    views: list[NetView]
    crossings: list[Crossings]
    velocities: list[FloatArray | None]


class NetCondition:
    """Accumulator of the condition of a net over a dive, from scans with a rig."""

    def __init__(self, rig: Rig, options: NetConditionOptions | None = None) -> None:
        self.options = options or NetConditionOptions()
        # Completed stretches. Where the net's lattice is found only later, the places of earlier
        # stretches and the holes in them are filled in then.
        self.stretches: list[NetStretch] = []
        self._reader = NetReader(rig)
        self._signals: list[NetSignal] = []
        self._velocities: list[FloatArray | None] = []
        # Stretches before the first lattice, by their number.
        self._waiting: dict[int, _Observations] = {}
        self._track = NetTrack()
        self._map = HoleMap()
        self._lattice: NetLattice | None = None
        shape = (len(rig.lasers), self._reader.n_lines)
        self._lit, self._observed = np.zeros(shape), np.zeros(shape)

    @property
    def holes(self) -> list[Hole]:
        """Holes found so far, in the order in which they were passed."""
        return sorted(self._map.holes, key=lambda hole: (hole.time_s, hole.frame))

    @property
    def area(self) -> float:
        """Area of net that was searched for holes, in square metres."""
        return self._map.area

    def add(self, scan: Scan, velocity: FloatArray | None = None) -> NetStretch | None:
        """Add a scan, in the order of time; return the stretch that it completes, if any.

        Frames without a posture, or without a net, are skipped. `velocity`, shape (2,): of the
        vehicle along the net, right and up in m/s, if another sensor measures it.
        """
        finished = None
        if self._signals and scan.time_s - self._signals[0].time_s >= self._duration_s():
            finished = self.finish()
        signal = self._reader.read(scan)
        if signal is not None and np.any(signal.state == LineState.LIT):
            self._signals.append(signal)
            self._velocities.append(velocity)
        return finished

    def add_all(self, scans: Iterable[Scan]) -> list[NetStretch]:
        """Add a dive's scans and finish; return all stretches."""
        for scan in scans:
            self.add(scan)
        self.finish()
        return self.stretches

    def finish(self) -> NetStretch | None:
        """Complete the current stretch, even if it is short; None where nothing was seen."""
        if not self._signals:
            return None
        seen = self._end_observations()
        lattice = find_lattice(seen.crossings, self._lattice)
        if lattice is not None:
            self._track_waiting(lattice)
            self._lattice = lattice
        stretch = self._evaluate(seen, lattice)
        self.stretches.append(stretch)
        # Limit of the frames kept before the first lattice, to search them for holes once it is
        # known.
        max_waiting = 1500
        if self._lattice is None:
            self._waiting[len(self.stretches) - 1] = seen
            while sum(len(one.views) for one in self._waiting.values()) > max_waiting:
                del self._waiting[min(self._waiting)]
        return stretch

    def _end_observations(self) -> _Observations:
        """Cut the signals of the current stretch into dashes."""
        for signal in self._signals:
            self._lit += signal.state == LineState.LIT
            self._observed += signal.state != LineState.HIDDEN
        usable = self._lines_in_fan()
        views = [find_dashes(signal, usable) for signal in self._signals]
        seen = _Observations(views, [crossings_of(view) for view in views], self._velocities)
        self._signals, self._velocities = [], []
        return seen

    def _track_waiting(self, lattice: NetLattice) -> None:
        """Track the net through the stretches in which its lattice was not known yet."""
        for i, seen in self._waiting.items():
            begin = self._track.place
            self._register(lattice, seen)
            place, piece = self._track.place, self._track.piece
            self.stretches[i] = replace(
                self.stretches[i], begin_place=begin, place=place, piece=piece
            )
        self._waiting.clear()

    def _duration_s(self) -> float:
        """Return the duration of the current stretch at the speed of the last one."""
        speed = float(np.hypot(*self._track.velocity))
        return min(self.options.stretch_s, max(self.options.stretch / max(speed, 1e-6), 1.0))

    def _evaluate(self, seen: _Observations, lattice: NetLattice | None) -> NetStretch:
        views, begin = seen.views, self._track.place
        twine, solidity, sigma, strands = None, None, None, 0.0
        if self._lattice is not None:
            # Without a lattice most of it may be a hole: the net beside it is as before.
            registered = self._register(self._lattice, seen)
            if lattice is not None and registered:
                strands = float(np.mean([one.fit.n_strands for one in registered]))
                twine = measure_twine(dash_kinds(lattice, registered), self.options.twine)
                if twine is not None:
                    solidity, sigma = measure_solidity(lattice, twine, registered) or (None, None)
        return NetStretch(
            first_frame=views[0].index,
            last_frame=views[-1].index,
            begin_s=views[0].time_s,
            end_s=views[-1].time_s,
            n_frames=len(views),
            range=float(np.mean([view.range for view in views])),
            begin_place=begin,
            place=self._track.place,
            piece=self._track.piece,
            lattice=lattice,
            twine=twine,
            solidity=solidity,
            sigma_solidity=sigma,
            n_strands=strands,
            seen_length=sum(view.seen_length for view in views),
        )

    def _register(self, lattice: NetLattice, seen: _Observations) -> list[RegisteredView]:
        """Fit the lattice's place in every frame, update the track, and search for holes."""
        fitter, registered = LatticeFitter(lattice), []
        for i, view in enumerate(seen.views):
            start = self._start(fitter, seen, i) if self._track.begins(view.time_s) else None
            shift = self._track.step(
                fitter, seen.crossings[i], view.time_s, seen.velocities[i], start
            )
            if shift is None:
                continue
            place = self._track.place
            registered.append(RegisteredView(view, fitter.assign(view.dashes, shift.place), place))
            self._map.add(lattice, view, shift.place, place, self._track.piece)
        self._map.update(lattice)
        return registered

    def _start(self, fitter: LatticeFitter, seen: _Observations, first: int) -> TrackStart | None:
        """Fit the start of a track to the next frames, unless a sensor gives the velocity."""
        if seen.velocities[first] is not None:
            return None
        times = np.array([view.time_s for view in seen.views[first : first + START_FRAMES]])
        times = times[times - times[0] < START_S]
        return fitter.start(seen.crossings[first : first + len(times)], times)

    def _lines_in_fan(self) -> BoolArray:
        """Return the search lines (L, J) that each laser's fan reaches, from the dive so far."""
        usable = np.ones(self._lit.shape, np.bool_)
        # Ends of a laser's line that are darker than the rest by this factor are beyond the laser's
        # fan.
        bin_lines, dim = 24, 0.25
        min_looked_at = 600
        edges = np.arange(0, self._lit.shape[1], bin_lines)
        lit = np.add.reduceat(self._lit, edges, axis=1)
        observed = np.add.reduceat(self._observed, edges, axis=1)
        for i in range(len(lit)):
            known = observed[i] > min_looked_at
            if not known.any():
                continue
            share = lit[i] / np.maximum(observed[i], 1.0)
            inside = np.flatnonzero(~known | (share > dim * np.median(share[known])))
            if len(inside):
                usable[i, : edges[inside[0]]] = False
                usable[i, edges[inside[-1]] + bin_lines :] = False
        return usable
