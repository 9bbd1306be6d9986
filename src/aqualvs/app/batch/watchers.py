"""What a join must know of the frames of a piece beyond the rows and points that are on disk.

A run watches its lasers and its net over the whole dive. Its verdicts rest on the scans of some
frames in full precision; which ones, the watchers decide as the dive goes on. A piece asks a
watcher of its own, which knows nothing of the pieces before and therefore looks at more frames than
the dive's will, and keeps those.
"""

from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from aqualvs.app.net_check import NetCheck
from aqualvs.geometry.arrays import FloatArray
from aqualvs.live.sources.span_frames import UnlikeSurveyError
from aqualvs.scanning.agreement import LaserAgreement
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.scanning.scan import Scan, ScanPoints

_REASONS = tuple(Reason)
_POINT_COLUMNS = {
    "laser": np.int8,
    "pixels": np.float64,
    "points_in_dome": np.float64,
    "intensity": np.float64,
    "width": np.float64,
}
"""What a watcher may look at of a point."""


@dataclass(slots=True)
class Notes:
    """Notes on the frames of a piece.

    Attributes
    ----------
    ranges : array of float
        Metres, NaN without a posture; one for each frame.
    reasons : array of int
        Why there is no posture, as an index into `Reason`; -1 where there is one.
    watched : list of Scan
        Scans that a watcher looked at.
    rows : array of int
        Their places among the frames of the piece.
    bars : array of float
        What `NetCheck` found, in metres.
    """

    ranges: "array[float]" = field(default_factory=lambda: array("d"))
    reasons: "array[int]" = field(default_factory=lambda: array("b"))
    watched: list[Scan] = field(default_factory=list)
    rows: "array[int]" = field(default_factory=lambda: array("q"))
    bars: "array[float]" = field(default_factory=lambda: array("d"))

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.ranges)


class NoteTaker:
    """Takes notes while a piece is measured.

    Parameters
    ----------
    n_before : int
        Frames of the dive before the piece.
    agreement : LaserAgreement or None
        A fresh one, if a run would watch its lasers.
    net_check : NetCheck or None
        A fresh one, if a run would watch its net.
    """

    def __init__(
        self, n_before: int, agreement: LaserAgreement | None, net_check: NetCheck | None
    ) -> None:
        self.notes = Notes()
        self._agreement, self._net_check = agreement, net_check
        nothing = Scan(0, 0.0, Refusal(Reason.NO_STRIPES), ScanPoints.none(), 1.0)
        for watcher in (agreement, net_check):
            # Watchers look at every so-manyth frame of the dive, not of the piece.
            for _ in range(n_before if watcher is not None else 0):
                cast("LaserAgreement", watcher).add(nothing)

    def add(self, scan: Scan) -> None:
        """Take note of the next frame."""
        notes = self.notes
        if self._agreement is not None:
            witness = _Witness(scan)
            self._agreement.add(cast("Scan", witness))
            if witness.was_looked_at:
                notes.rows.append(len(notes))
                notes.watched.append(_slim(scan))
        if self._net_check is not None:
            self._net_check.add(scan)
            notes.bars = self._net_check.bars
        posture = scan.posture
        if isinstance(posture, Posture):
            notes.ranges.append(posture.range)
            notes.reasons.append(-1)
        else:
            notes.ranges.append(np.nan)
            notes.reasons.append(_REASONS.index(posture.reason))


def _slim(scan: Scan) -> Scan:
    """Return a scan that keeps nothing in memory but what a watcher may look at."""
    points = scan.points
    kept = {name: np.array(getattr(points, name), copy=True) for name in _POINT_COLUMNS}
    return replace(scan, points=_scan_points(kept))


class _Witness:
    """A scan that notices when its points are looked at."""

    def __init__(self, scan: Scan) -> None:
        self.posture = scan.posture
        self.was_looked_at = False
        self._points = scan.points

    @property
    def points(self) -> ScanPoints:
        self.was_looked_at = True
        return self._points


class _Unseen:
    """The points of a frame that no watcher should want."""

    def __getattr__(self, name: str) -> Any:
        if name not in ScanPoints.__dataclass_fields__:
            raise AttributeError(name)
        raise UnlikeSurveyError(f"a watcher asks for points ({name}) that were not kept")


_UNSEEN = cast("ScanPoints", _Unseen())


def write_notes(notes: Notes, path: Path) -> None:
    """Write notes to a file.

    Raises
    ------
    OSError
        As the system says it.
    """
    scans = notes.watched
    columns: dict[str, NDArray[Any]] = {
        name: np.concatenate([getattr(scan.points, name) for scan in scans])
        for name in _POINT_COLUMNS
        if scans
    }
    postures = [cast("Posture", scan.posture) for scan in scans]
    columns |= {
        "ranges": np.asarray(notes.ranges),
        "reasons": np.asarray(notes.reasons, np.int8),
        "rows": np.asarray(notes.rows, np.int64),
        "bars": np.asarray(notes.bars),
        "counts": np.asarray([len(scan.points) for scan in scans], np.int64),
        "normals": np.asarray([posture.normal_in_dome for posture in postures]).reshape(-1, 3),
    }
    np.savez(path, allow_pickle=False, **columns)


def stand_ins(path: Path) -> Iterator[Scan]:
    """Yield scans that tell a run's watchers and its summary what the piece's own told them.

    Raises
    ------
    UnlikeSurveyError
        If a watcher looks at points that were not kept.
    """
    with np.load(path) as file:
        stored: dict[str, NDArray[Any]] = {name: file[name] for name in file.files}
    edges = [0, *np.cumsum(stored["counts"]).tolist()]
    which = {row: at for at, row in enumerate(stored["rows"].tolist())}
    reasons = stored["reasons"].tolist()
    for row, distance in enumerate(stored["ranges"].tolist()):
        if reasons[row] >= 0:
            refusal = Refusal(_REASONS[reasons[row]])
            yield Scan(row, 0.0, refusal, ScanPoints.none(), 1.0)
        elif row in which:
            at = which[row]
            points = _points(stored, edges[at], edges[at + 1])
            yield Scan(row, 0.0, _posture(distance, stored["normals"][at]), points, 1.0)
        else:
            yield Scan(row, 0.0, _posture(distance, _NO_NORMAL), _UNSEEN, 1.0)


def stored_bars(path: Path) -> "array[float]":
    """Return what the piece's `NetCheck` found."""
    with np.load(path) as file:
        return array("d", file["bars"])


def stored_ranges(path: Path) -> "array[float]":
    """Return the range of every frame of the piece in metres, NaN without a posture."""
    with np.load(path) as file:
        return array("d", file["ranges"])


_NO_NORMAL = np.full(3, np.nan)


def _posture(distance: float, normal: FloatArray) -> Posture:
    unknown = np.nan
    return Posture(
        range=distance,
        pitch=unknown,
        yaw=unknown,
        covariance=np.full((3, 3), unknown),
        normal_in_dome=normal,
        slant_range=unknown,
        nearest=unknown,
        n_points=0,
        rms=unknown,
    )


def _points(stored: dict[str, NDArray[Any]], first: int, stop: int) -> ScanPoints:
    return _scan_points({name: stored[name][first:stop] for name in _POINT_COLUMNS})


def _scan_points(kept: Mapping[str, NDArray[Any]]) -> ScanPoints:
    """Return points with what was kept of them; the rest is said to be nothing."""
    n = len(kept["laser"])
    nothing = np.broadcast_to(np.nan, n)
    return ScanPoints(
        **kept,
        sigma=nothing,
        quality=nothing,
        label=np.broadcast_to(np.uint8(0), n),
        used=np.broadcast_to(np.False_, n),
    )
