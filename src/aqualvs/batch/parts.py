"""Measurement of one piece of a dive: its rows, its points, and its summary for the merge."""

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from aqualvs.batch.dataset import drafted, read_valid_manifest, write_manifest
from aqualvs.batch.work import DiveProbe, DiveWork, digest
from aqualvs.errors import SourceError
from aqualvs.pipeline import OpenDive, open_dive, summary_for
from aqualvs.results.files import writing
from aqualvs.results.folder import POINTS_STREAM, POSTURE_BARE_CSV, POSTURE_CSV, PostureCsv
from aqualvs.results.points import PointsStream
from aqualvs.results.run_request import FrameWindow
from aqualvs.run_outputs import RunBareLens
from aqualvs.scanning.row_motion import REACH
from aqualvs.scanning.scan import Frame
from aqualvs.sources.fields import frames_in, frames_of
from aqualvs.sources.spans import Span, SpanKind, VideoParts, image_frames
from aqualvs.workers.frame_results import (
    FrameProcessor,
    FrameResult,
    FrameScanner,
    corrected_rows,
    in_blocks,
    result_blocks,
)
from aqualvs.workers.run_frames import ready, with_losses

SUMMARY = "summary.npz"
"""File of a piece with the statistics of its frames."""


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


def piece_folder(work: DiveWork, probe: DiveProbe, number: int) -> Path:
    """Return the folder of a piece; another rig, option or version has another."""
    span = probe.spans[number]
    kind = f"{span.first + span.lead:08d}" if span.kind is not SpanKind.WHOLE else "whole"
    return work.home / f"pieces-{probe.key[:12]}" / kind


def piece_key(probe: DiveProbe, number: int) -> str:
    """Return what a piece is made from, as a short text."""
    span = probe.spans[number]
    return digest(
        {
            "dive": probe.key,
            "kind": span.kind,
            "first": span.first,
            "stop": span.stop,
            "lead": span.lead,
        }
    )


def measure_piece(work: DiveWork, probe: DiveProbe, number: int) -> PieceResult:
    """Measure one piece of a dive, or take what an earlier batch has finished.

    Raises
    ------
    UnlikeProbeError
        If the piece does not hold what the survey promised.
    AqualvsError
        If the dive cannot be read any more, or the piece not be written.
    """
    folder, span = piece_folder(work, probe, number), probe.spans[number]
    key = piece_key(probe, number)
    known = read_valid_manifest(folder, key)
    if known is not None:
        return PieceResult(number=number, reused=True, **known)
    began_s = time.process_time()
    # The process has one core to itself.
    cv2.setNumThreads(1)
    with writing(folder), drafted(folder) as draft:
        with open_dive(work.request) as dive:
            facts, names = _write_piece(dive, span, draft, _scanner(dive, probe))
        write_manifest(draft, key, facts, names)
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
    dive: OpenDive, span: Span, folder: Path, scanner: FrameScanner
) -> tuple[dict[str, Any], list[str]]:
    """Write a piece into a folder; returns facts and the names of the files."""
    fault, last_s, summary = "", 0.0, summary_for(dive)
    frames = _frames(dive, span)
    processor = FrameProcessor(dive.rig, scanner)
    with ExitStack() as files:
        posture = files.enter_context(PostureCsv(folder / POSTURE_CSV, dive.rig.shutter))
        points = files.enter_context(PointsStream(folder / POINTS_STREAM))
        bare = files.enter_context(RunBareLens(folder, dive.rig))
        try:
            for block in _blocks(dive, span, frames, processor):
                scans = [measured.scan for measured in block]
                points.write(*scans)
                posture.write(*scans)
                bare.write(*block)
                for scan in scans:
                    summary.add(scan)
                last_s = scans[-1].time_s
        except SourceError as broken_off:
            fault = str(broken_off)
    summary.save(folder / SUMMARY)
    names = [POSTURE_CSV, POINTS_STREAM, SUMMARY]
    if dive.rig.housing is not None:
        names.append(POSTURE_BARE_CSV)
    facts = {
        "n_frames": summary.n_frames,
        "n_valid": summary.n_valid,
        "duration_s": last_s,
        "fault": fault,
    }
    return facts, names


def _frames(dive: OpenDive, span: Span) -> Iterator[Frame]:
    """Return the frames of a piece, and those beside it that they need.

    The first of a dive that is not cut has been decoded.
    """
    path, shutter = Path(dive.request.source), dive.rig.shutter
    if span.kind is SpanKind.WHOLE:
        return ready(iter(dive.source), dive.source, FrameWindow())
    if span.kind is SpanKind.VIDEO:
        pictures = _video_frames(path, span, dive.rig.size_px)
    else:
        pictures = image_frames(path, span, dive.request.fps or 1.0)
    first, stop = frames_in(span, shutter)
    near = range(first - REACH, stop + REACH)
    return (frame for frame in frames_of(pictures, shutter) if frame.index in near)


def _video_frames(path: Path, span: Span, size_px: tuple[int, int]) -> Iterator[Frame]:
    with VideoParts(path, size_px) as video:
        yield from video.frames(span)


def _blocks(
    dive: OpenDive, span: Span, frames: Iterator[Frame], processor: FrameProcessor
) -> Iterator[list[FrameResult]]:
    """Yield the results of a piece's frames, and refusals in place of lost frames."""
    # A recording tells of lost frames itself.
    first, stop = frames_in(span, dive.rig.shutter)
    counted_from = None if dive.is_replay else first - min(span.lead, REACH)
    pairs = with_losses(frames, counted_from, dive.rig.n_water)
    blocks = corrected_rows(
        result_blocks(in_blocks(pairs, processor.block_length), processor), dive.rig
    )
    if not (span.lead or span.trail):
        yield from blocks
        return
    for block in blocks:
        own = [measured for measured in block if first <= measured.scan.index < stop]
        if own:
            yield own


class _Kept(threading.local):
    """The scanner of the last piece, which the next one mostly needs again."""

    key: str = ""
    scanner: FrameScanner | None = None


_KEPT = _Kept()


def _scanner(dive: OpenDive, probe: DiveProbe) -> FrameScanner:
    if dive.is_replay or dive.request.index_target is not None:
        return dive.scanner()
    if _KEPT.key != probe.result_key or _KEPT.scanner is None:
        _KEPT.key, _KEPT.scanner = probe.result_key, dive.scanner()
    return _KEPT.scanner
