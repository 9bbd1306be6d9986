"""Merge of a dive's pieces into its folder, equal to what `aqualvs run` would have written.

Rows and points are joined in order; the summaries of the pieces add up.
"""

import os
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from aqualvs.batch.dataset import (
    clear,
    drop_net,
    holds_dive,
    put_dive,
    read_valid_manifest,
    scratch,
    write_manifest,
)
from aqualvs.batch.parts import SUMMARY, PieceResult, peak_bytes, piece_folder, piece_key
from aqualvs.batch.summary_page import range_steps
from aqualvs.batch.work import DiveProbe, DiveWork
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
)
from aqualvs.results.points import export_batches, read_points_stream
from aqualvs.results.run_request import RunFile, Status
from aqualvs.results.summary import RunSummary


def joined_summary(dive: OpenDive, pieces: Sequence[Path]) -> RunSummary:
    """Return the summary that a run of the whole dive would have gathered.

    Parameters
    ----------
    dive : OpenDive
    pieces : sequence of Path
        Folders of all pieces, in order.
    """
    summary = summary_for(dive)
    for piece in pieces:
        summary.extend(piece / SUMMARY)
    return summary


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
    return facts if holds_dive(work.dataset, work.name) else None


def join_dive(work: DiveWork, probe: DiveProbe, results: Sequence[PieceResult]) -> dict[str, Any]:
    """Join the pieces of a dive, write its report, and drop the pieces.

    Parameters
    ----------
    work : DiveWork
    probe : DiveProbe
    results : sequence of PieceResult
        Of all pieces, in order.

    Returns
    -------
    facts : dict
        Of the dive, for the summary; ready for JSON.

    Raises
    ------
    PieceLostError
        If a piece must be measured again.
    AqualvsError
        If the dive's folder cannot be written.
    """
    pieces = [piece_folder(work, probe, number) for number in range(len(probe.spans))]
    for number, piece in enumerate(pieces):
        if read_valid_manifest(piece, piece_key(probe, number)) is None:
            raise PieceLostError(f"{piece}: is not intact")
    began_s = time.process_time()
    out, home = work.request.out, work.home
    with writing(out), scratch(home, "joining") as draft:
        _join_files(pieces, draft)
        facts = _write_run_file(work, probe, results, pieces, draft)
        if work.request.report:
            write_report(draft)
        names = _replace_run(draft, out)
        put_dive(work.dataset, work.name, out)
        # That of an older result; its files in the dive's folder are gone already.
        drop_net(work.dataset, work.name)
        (home / JOINED).mkdir(parents=True, exist_ok=True)
        cpu_s = sum(result.cpu_s for result in results) + time.process_time() - began_s
        peak = max(peak_bytes(), *(result.peak_bytes for result in results))
        facts |= {"cpu_s": round(cpu_s, 2), "peak_bytes": peak}
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
        summary = joined_summary(dive, pieces)
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
        if parts:
            _join_rows(parts, folder / name)
    export_batches(
        (batch for piece in pieces for batch in read_points_stream(piece / POINTS_STREAM)),
        folder / POINTS_PARQUET,
        folder / POINTS_PLY,
    )


def _join_rows(parts: Sequence[Path], path: Path) -> None:
    """Write the rows of several CSV files under the head of the first."""
    with path.open("wb") as whole:
        for number, part in enumerate(parts):
            with part.open("rb") as rows:
                head = rows.readline()
                if number == 0:
                    whole.write(head)
                shutil.copyfileobj(rows, whole)


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
