"""Pieces of a dive: measurement of one, and their merge into the dive's folder.

A piece has its rows, its points and its summary. The merge equals what `aqualvs run` would have
written: rows and points are joined in order; the summaries of the pieces add up.
"""

import os
import shutil
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from aqualvs.batch.dataset import (
    OF_DIVE,
    OF_NET,
    clear,
    drafted,
    drop,
    holds,
    put_dive,
    read_valid_manifest,
    scratch,
    write_manifest,
)
from aqualvs.batch.summary_page import range_steps
from aqualvs.batch.work import DiveProbe, DiveWork, digest
from aqualvs.errors import SourceError
from aqualvs.optics.rigfile import rig_to_mapping
from aqualvs.pipeline import OpenDive, open_dive, summary_for
from aqualvs.report.run_page import write_report
from aqualvs.results.files import writing
from aqualvs.results.folder import (
    DIVE_MCAP,
    POINTS_PARQUET,
    POINTS_PLY,
    POINTS_STREAM,
    POSTURE_BARE_CSV,
    POSTURE_CSV,
    REPORT_HTML,
    RUN_FILES,
    RUN_YAML,
    PostureCsv,
)
from aqualvs.results.points import PointsStream, export_points, read_points_stream
from aqualvs.results.run_request import FrameWindow, RunFile, Status
from aqualvs.run_outputs import RunBareLens
from aqualvs.scanning.row_motion import REACH
from aqualvs.scanning.scan import Frame
from aqualvs.sources.fields import frames_in, frames_of
from aqualvs.sources.spans import Span, SpanKind, SpanReader
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
    """Outcome of measuring one piece."""

    # Frames, and those with a posture.
    n_frames: int
    n_valid: int
    # Time of the last frame.
    duration_s: float
    # What ended the source early; empty if nothing did.
    fault: str
    # Whether it was finished before.
    reused: bool = False


def piece_folder(work: DiveWork, probe: DiveProbe, number: int) -> Path:
    """Return the folder of a piece; another rig, option or version has another."""
    span = probe.spans[number]
    kind = f"{span.first + span.lead:08d}" if span.kind is not SpanKind.WHOLE else "whole"
    return work.home / f"pieces-{probe.key[:12]}" / kind


def piece_key(probe: DiveProbe, number: int) -> str:
    """Return what a piece is made from, as a short text."""
    span = probe.spans[number]
    of_span = {"kind": span.kind, "first": span.first, "stop": span.stop, "lead": span.lead}
    return digest({"dive": probe.key, **of_span})


def measure_piece(work: DiveWork, probe: DiveProbe) -> PieceResult:
    """Measure the only piece of a probe, or take what an earlier batch has finished.

    Raises `SpanMismatchError` if the piece does not hold what the survey promised. Raises
    `AqualvsError` if the dive cannot be read any more, or the piece not be written.
    """
    folder, key = piece_folder(work, probe, 0), piece_key(probe, 0)
    known = read_valid_manifest(folder, key)
    if known is not None:
        return PieceResult(reused=True, **known)
    # The process has one core to itself.
    cv2.setNumThreads(1)
    with writing(folder), drafted(folder) as draft:
        with open_dive(work.request) as dive:
            facts, names = _write_piece(dive, probe.spans[0], draft, _scanner(dive, probe))
        write_manifest(draft, key, facts, names)
    return PieceResult(**facts)


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
                scans = [result.scan for result in block]
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
    if span.kind is SpanKind.WHOLE:
        return ready(iter(dive.source), dive.source, FrameWindow())
    shutter = dive.rig.shutter
    first, stop = frames_in(span, shutter)
    near = range(first - REACH, stop + REACH)
    return (frame for frame in frames_of(_pictures(dive, span), shutter) if frame.index in near)


def _pictures(dive: OpenDive, span: Span) -> Iterator[Frame]:
    path, fps = Path(dive.request.source), dive.request.fps or 1.0
    with SpanReader(path, dive.rig.size_px, fps) as pictures:
        yield from pictures.frames(span)


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
        own = [result for result in block if first <= result.scan.index < stop]
        if own:
            yield own


class _LastScanner(threading.local):
    """The scanner of the last piece, which the next one mostly needs again."""

    key: str = ""
    scanner: FrameScanner | None = None


_LAST = _LastScanner()


def _scanner(dive: OpenDive, probe: DiveProbe) -> FrameScanner:
    if dive.is_replay or dive.request.index_target is not None:
        return dive.scanner()
    if _LAST.key != probe.result_key or _LAST.scanner is None:
        _LAST.key, _LAST.scanner = probe.result_key, dive.scanner()
    return _LAST.scanner


JOINED = "joined"
"""Folder, below a dive's home, with the seal of its result."""

_VERIFIED = (POSTURE_CSV, POSTURE_BARE_CSV, POINTS_PARQUET, POINTS_PLY, RUN_YAML)
"""Files whose content a later batch checks; the report may be written again by anyone."""


class PieceLostError(Exception):
    """A finished piece is not there any more, or not intact; it must be measured again."""


def finished_dive(work: DiveWork, probe: DiveProbe) -> dict[str, Any] | None:
    """Return the facts of a dive that an earlier batch has finished; None if it has not.

    Its files must be there and intact, and made from the same dive, rig, options and versions.
    """
    out = work.request.out
    facts = read_valid_manifest(work.home / JOINED, probe.key, out)
    if facts is None or (work.request.report and not (out / REPORT_HTML).exists()):
        return None
    return facts if holds(work.dataset, work.name, OF_DIVE) else None


def join_dive(work: DiveWork, probe: DiveProbe, results: Sequence[PieceResult]) -> dict[str, Any]:
    """Join the pieces of a dive, write its report, and drop the pieces.

    `results` are of all pieces, in order. Returns the facts of the dive, for the summary; ready for
    JSON. Raises `PieceLostError` if a piece must be measured again, and `AqualvsError` if the
    dive's folder cannot be written.
    """
    pieces = [piece_folder(work, probe, number) for number in range(len(probe.spans))]
    for number, piece in enumerate(pieces):
        if read_valid_manifest(piece, piece_key(probe, number)) is None:
            raise PieceLostError(f"{piece}: is damaged")
    out, home = work.request.out, work.home
    with writing(out), scratch(home, "joining") as draft:
        _join_files(pieces, draft)
        facts = _write_run_file(work, probe, results, pieces, draft)
        if work.request.report:
            write_report(draft)
        names = _replace_run(draft, out)
        put_dive(work.dataset, work.name, out)
        # That of an older result; its files in the dive's folder are gone already.
        drop(work.dataset, work.name, OF_NET)
        (home / JOINED).mkdir(parents=True, exist_ok=True)
        write_manifest(home / JOINED, probe.key, facts, names, out)
    for old in home.glob("pieces-*"):
        clear(old)
    return facts


def _write_run_file(
    work: DiveWork,
    probe: DiveProbe,
    results: Sequence[PieceResult],
    pieces: Sequence[Path],
    folder: Path,
) -> dict[str, Any]:
    """Write `run.yaml`; returns the facts of the dive."""
    with open_dive(work.request) as dive:
        summary = summary_for(dive)
    for piece in pieces:
        summary.extend(piece / SUMMARY)
    fault, facts, rig = results[-1].fault, summary.to_dict(), rig_to_mapping(dive.rig)
    run_file = RunFile(folder / RUN_YAML, probe.source, rig, dive.request.to_dict())
    run_file.write(Status.FAILED if fault else Status.FINISHED, error=fault, summary=facts)
    return {
        "n_frames": summary.n_frames,
        "n_valid": summary.n_valid,
        "duration_s": results[-1].duration_s,
        "fault": fault,
        "summary": facts,
        "range_steps": range_steps(summary.ranges),
        "rig": str(rig.get("name", "")),
        "rig_file": str(work.request.rig or work.request.source),
        "n_water": dive.rig.n_water,
        "source": dict(probe.source),
        "why_whole": probe.why_whole,
        "n_pieces": len(pieces),
    }


def _join_files(pieces: Sequence[Path], folder: Path) -> None:
    """Write rows and points of all pieces as those of one run."""
    for name in (POSTURE_CSV, POSTURE_BARE_CSV):
        parts = [piece / name for piece in pieces if (piece / name).exists()]
        if not parts:
            continue
        # Rows of all under the head of the first.
        with (folder / name).open("wb") as whole:
            for number, part in enumerate(parts):
                with part.open("rb") as rows:
                    head = rows.readline()
                    if number == 0:
                        whole.write(head)
                    shutil.copyfileobj(rows, whole)
    export_points(
        (batch for piece in pieces for batch in read_points_stream(piece / POINTS_STREAM)),
        folder / POINTS_PARQUET,
        folder / POINTS_PLY,
    )


def _replace_run(draft: Path, out: Path) -> list[str]:
    """Put the files of a run in the place of an older one's; returns the names to be verified."""
    out.mkdir(parents=True, exist_ok=True)
    # A batch makes no recordings; one that is there is somebody's.
    for name in set(RUN_FILES) - {DIVE_MCAP}:
        if (draft / name).exists():
            os.replace(draft / name, out / name)
        else:
            (out / name).unlink(missing_ok=True)
    return [name for name in _VERIFIED if (out / name).exists()]
