"""Whether the net that is seen is the one that the target file describes.

Along a laser's line strands follow one another at distances that depend on the way the mesh is
turned; over three lasers and a dive their mean tells the bar. For parallel lines thrown at random
on a net with a length L of twine on every square metre it is pi / (2 L) (Crofton); L is 2 / bar for
square and diamond meshes and 2 / (sqrt(3) bar) for hexagons.
"""

from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from aqualvs.app.target_file import NetFacts, target_facts
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Rig
from aqualvs.optics.sheet import sheets_of
from aqualvs.scanning.posture import Posture
from aqualvs.scanning.scan import Label, Scan

# A frame now and then is enough, and costs the run nothing.
_EVERY = 5
_ENOUGH_FRAMES = 5
# Light is one strand's up to gaps of this width; a strand has so many points, a stripe so many
# strands, a frame so many stripes.
_GAP = 3e-3
_MIN_POINTS, _MIN_STRANDS, _MIN_LASERS = 3, 4, 2
# Wider than so many usual distances is a hole, or what stands before the net.
_HOLE = 2.5
# Strands that meet at a knot count once and dim ones are missed: found on random simulated nets.
_MISSED = 1.2
# On those nets the bar comes out at 0.67 to 1.45 of what it is, frame by frame.
_TOO_SHORT, _TOO_LONG = 0.62, 1.6


@dataclass(slots=True)
class NetCheck:
    """Compares the distances between strands with those of the net that was announced.

    Attributes
    ----------
    said : NetFacts
        The target file's net.
    source : str
        The target file's name, for the sentence.
    planes : sequence of Plane
        Of the lasers, in `dome`.
    bars : array of float
        Bar of the frames that were looked at, in metres.
    """

    said: NetFacts
    source: str
    planes: Sequence[Plane]
    bars: "array[float]" = field(default_factory=lambda: array("d"))
    _n_seen: int = 0

    def add(self, scan: Scan) -> None:
        """Look at a frame, if its turn has come and it shows a net."""
        self._n_seen += 1
        if (self._n_seen - 1) % _EVERY == 0:
            bar = bar_of(scan, self.planes, self.said)
            if bar is not None:
                self.bars.append(bar)

    def bar(self) -> float | None:
        """Return the bar as it looks over the dive, in metres; None where too little was seen."""
        return float(np.median(self.bars)) if len(self.bars) >= _ENOUGH_FRAMES else None

    def sentence(self) -> str:
        """Return what is wrong with the file in one line, "" where nothing can be told."""
        bar = self.bar()
        if bar is None or _TOO_SHORT <= bar / self.said.bar <= _TOO_LONG:
            return ""
        return (
            f"the net looks like one with a bar length of about {1e3 * bar:.2g} mm, where "
            f"{self.source} says {1e3 * self.said.bar:g} mm; postures do not depend on it"
        )

    def facts(self) -> dict[str, Any]:
        """Return what `run.yaml` holds of it."""
        bar = self.bar()
        found: dict[str, Any] = {"bar_said_mm": round(1e3 * self.said.bar, 2)}
        if bar is not None:
            found["bar_seen_mm"] = round(1e3 * bar, 1)
        found["n_frames"] = len(self.bars)
        found["words"] = self.sentence()
        return found


def net_check(target: str, rig: Rig) -> NetCheck | None:
    """Return the check of the net that a target file describes; None where it describes none.

    Parameters
    ----------
    target : str
        A word or the path of a target file, as `target_facts` takes it.
    rig : Rig

    Raises
    ------
    OptionError
        As `target_facts`.
    """
    said = target_facts(target).net
    if said is None:
        return None
    camera = rig.camera()
    planes = [sheet.best_plane(camera, rig.working_range) for sheet in sheets_of(rig)]
    return NetCheck(said, target, planes)


def bar_of(scan: Scan, planes: Sequence[Plane], said: NetFacts) -> float | None:
    """Return the bar that the distances between strands in one frame make likely, in metres.

    Parameters
    ----------
    scan : Scan
        Its points labelled net are looked at.
    planes : sequence of Plane
        Of the lasers, in `dome`.
    said : NetFacts
        Its shape of mesh is taken as given.
    """
    posture = scan.posture
    if not isinstance(posture, Posture):
        return None
    on_net = scan.points.label == Label.NET
    densities = []
    for index, plane in enumerate(planes):
        along = np.cross(plane.normal, posture.normal_in_dome)
        along /= np.linalg.norm(along)
        mine = on_net & (scan.points.laser == index)
        distance = strand_distance(scan.points.points_in_dome[mine] @ along)
        if distance is not None:
            densities.append(1.0 / distance)
    if len(densities) < _MIN_LASERS:
        return None
    return float(said.crossings_per_bar / (_MISSED * np.mean(densities)))


def strand_distance(along: FloatArray) -> float | None:
    """Return the mean distance between the strands on one stripe, in metres.

    Parameters
    ----------
    along : array, shape (N,)
        Places of points on the net along the stripe, in metres, in any order.
    """
    if len(along) < _MIN_STRANDS * _MIN_POINTS:
        return None
    along = np.sort(along)
    gaps = np.flatnonzero(np.diff(along) > _GAP)
    first, last = np.append(0, gaps + 1), np.append(gaps, len(along) - 1)
    strand = last - first + 1 >= _MIN_POINTS
    if np.count_nonzero(strand) < _MIN_STRANDS:
        return None
    apart = np.diff(0.5 * (along[first] + along[last])[strand])
    return float(np.mean(apart[apart <= _HOLE * np.median(apart)]))
