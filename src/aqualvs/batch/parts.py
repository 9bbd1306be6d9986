"""Measurement of one piece of a dive: its rows, its points, and notes for the merge.

The notes hold what the merge needs beyond the rows and points on disk. A run monitors its lasers
and its net over the whole dive, and bases its verdicts on the scans of some frames in full
precision, which the monitors choose as the dive goes on. A piece runs monitors of its own. They
know nothing of the pieces before, and therefore look at more frames than those of the dive will;
these are kept.
"""

import threading
import time
from array import array
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from aqualvs.batch.dataset import drafted, seal, sealed
from aqualvs.batch.work import DiveProbe, DiveWork, OpenDive, digest, open_dive
from aqualvs.errors import SourceError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.nets.target_file import NetCheck, net_check
from aqualvs.pipeline import agreement_for
from aqualvs.results.files import writing
from aqualvs.results.folder import JOURNAL, POSTURE_BARE_CSV, POSTURE_CSV, PostureCsv
from aqualvs.results.points import PointsJournal
from aqualvs.results.run_request import FrameWindow
from aqualvs.run_outputs import RunBareLens
from aqualvs.scanning.agreement import LaserAgreement
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.scanning.scan import Frame, Scan, ScanPoints
from aqualvs.sources.spans import Span, SpanKind, UnlikeSurveyError, VideoParts, image_frames
from aqualvs.workers.frame_results import (
    FrameResult,
    Meter,
    ScansFrames,
    in_blocks,
    measured_blocks,
)
from aqualvs.workers.run_frames import ready, with_losses

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
    """Collector of the notes on a piece while it is measured.

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
    """Return a scan that keeps in memory only what a monitor may look at."""
    points = scan.points
    kept = {name: np.array(getattr(points, name), copy=True) for name in _POINT_COLUMNS}
    return replace(scan, points=_scan_points(kept))


class _Witness:
    """Scan that records accesses to its points."""

    def __init__(self, scan: Scan) -> None:
        self.posture = scan.posture
        self.was_looked_at = False
        self._points = scan.points

    @property
    def points(self) -> ScanPoints:
        self.was_looked_at = True
        return self._points


class _Unseen:
    """Placeholder for the points of a frame that no monitor should need."""

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
    """Yield scans that give a run's monitors and summary the same information as the piece's.

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
    """Return the bars that the piece's `NetCheck` found."""
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


NOTES = "notes.npz"


@dataclass(frozen=True, slots=True, kw_only=True)
class PieceResult:
    """Outcome of measuring one piece.

    Attributes
    ----------
    number : int
        Of the piece in its dive.
    n_frames, n_valid : int
        Frames, and those with a posture.
    duration_s : float
        Time of the last frame.
    fault : str
        What ended the source early; empty if nothing did.
    cpu_s : float
        Spent on it, by the process that did it; 0 for one that was finished before.
    peak_bytes : int
        Most memory that process had so far.
    reused : bool
        Whether it was finished before.
    """

    number: int
    n_frames: int
    n_valid: int
    duration_s: float
    fault: str
    cpu_s: float = 0.0
    peak_bytes: int = 0
    reused: bool = False


def piece_folder(work: DiveWork, survey: DiveProbe, number: int) -> Path:
    """Return the folder of a piece; another rig, option or version has another."""
    span = survey.spans[number]
    kind = f"{span.first:08d}" if span.kind is not SpanKind.WHOLE else "whole"
    return work.home / f"pieces-{survey.key[:12]}" / kind


def piece_key(survey: DiveProbe, number: int) -> str:
    """Return what a piece is made from, as a short text."""
    span = survey.spans[number]
    return digest({"dive": survey.key, "kind": span.kind, "first": span.first, "stop": span.stop})


def measure_piece(work: DiveWork, survey: DiveProbe, number: int) -> PieceResult:
    """Measure one piece of a dive, or take what an earlier batch has finished.

    Raises
    ------
    UnlikeSurveyError
        If the piece does not hold what the survey promised.
    AqualvsError
        If the dive cannot be read any more, or the piece not be written.
    """
    folder, span = piece_folder(work, survey, number), survey.spans[number]
    key = piece_key(survey, number)
    known = sealed(folder, key)
    if known is not None:
        return PieceResult(number=number, reused=True, **known)
    began_s = time.process_time()
    # The process has one core to itself.
    cv2.setNumThreads(1)
    with writing(folder), drafted(folder) as draft:
        dive = open_dive(work.request)
        with dive.source:
            facts, names = _write_piece(dive, span, draft, _scanner(dive, survey))
        seal(draft, key, facts, names)
    return PieceResult(
        number=number, cpu_s=time.process_time() - began_s, peak_bytes=peak_bytes(), **facts
    )


def peak_bytes() -> int:
    """Return the peak memory of this process."""
    try:
        import resource
    except ImportError:  # Windows has no such count.
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _write_piece(
    dive: OpenDive, span: Span, folder: Path, scanner: ScansFrames
) -> tuple[dict[str, Any], list[str]]:
    """Write a piece into a folder; returns facts and the names of the files."""
    fault, n_valid, last_s = "", 0, 0.0
    frames = _frames(dive, span)
    meter = Meter(dive.rig, scanner)
    taker = NoteTaker(
        span.first, agreement_for(dive.request, dive.rig), net_check(dive.request.target, dive.rig)
    )
    with ExitStack() as files:
        posture = files.enter_context(PostureCsv(folder / POSTURE_CSV))
        points = files.enter_context(PointsJournal(folder / JOURNAL))
        bare = files.enter_context(RunBareLens(folder, dive.rig))
        try:
            for block in _blocks(dive, span, frames, meter):
                scans = [measured.scan for measured in block]
                points.write(*scans)
                posture.write(*scans)
                bare.write(*block)
                for scan in scans:
                    taker.add(scan)
                n_valid += sum(bool(scan.posture) for scan in scans)
                last_s = scans[-1].time_s
        except SourceError as broken_off:
            fault = str(broken_off)
    write_notes(taker.notes, folder / NOTES)
    names = [POSTURE_CSV, JOURNAL, NOTES]
    if dive.rig.dome is not None:
        names.append(POSTURE_BARE_CSV)
    facts = {
        "n_frames": len(taker.notes),
        "n_valid": n_valid,
        "duration_s": last_s,
        "fault": fault,
    }
    return facts, names


def _frames(dive: OpenDive, span: Span) -> Iterator[Frame]:
    """Return the frames of a piece; the first of them has been decoded."""
    path = Path(dive.request.source)
    if span.kind is SpanKind.VIDEO:
        return _video_frames(path, span, dive.rig.size_px)
    if span.kind is SpanKind.IMAGES:
        return image_frames(path, span, dive.request.fps or 1.0)
    return ready(iter(dive.source), dive.source, FrameWindow())


def _video_frames(path: Path, span: Span, size_px: tuple[int, int]) -> Iterator[Frame]:
    with VideoParts(path, size_px) as video:
        yield from video.frames(span)


def _blocks(
    dive: OpenDive, span: Span, frames: Iterator[Frame], meter: Meter
) -> Iterator[list[FrameResult]]:
    """Yield the results of a piece's frames, and refusals in place of lost frames."""
    # A recording tells of lost frames itself.
    first = None if dive.replay is not None else span.first
    pairs = with_losses(frames, first, dive.rig.n_water)
    return measured_blocks(in_blocks(pairs, meter.block_length), meter)


class _Kept(threading.local):
    """The scanner of the last piece, which the next one mostly needs again."""

    key: str = ""
    scanner: ScansFrames | None = None


_KEPT = _Kept()


def _scanner(dive: OpenDive, survey: DiveProbe) -> ScansFrames:
    if dive.replay is not None or dive.request.index_target is not None:
        return dive.scanner()
    if _KEPT.key != survey.result_key or _KEPT.scanner is None:
        _KEPT.key, _KEPT.scanner = survey.result_key, dive.scanner()
    return _KEPT.scanner
