"""The folder of a run, readable at any time and however the run ends.

==================  ========================================================================
`posture.csv`       one row for every frame, on disk as soon as the frame is done
`posture_bare.csv`  the same without the dome model, for comparison
`points.arrows`     the points during the run; replaced by the next two files at its end
`points.parquet`    every stripe point
`points.ply`        the points on the target; both are `.part` until the run ends
`run.yaml`          source, options, versions, rig, status and summary
==================  ========================================================================

Other modules write the report, the state of a net and the overlay video beside them.
"""

import contextlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

from aqualvs.closing import Closing
from aqualvs.errors import OutputError, SourceError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.shutter import AT_ONCE, Shutter
from aqualvs.results.files import AppendFile, Claim, explain, locked_folder, writing
from aqualvs.results.points import (
    DRAFT,
    PointsExport,
    PointsStream,
    check_idle,
    export_points,
    read_points_stream,
)
from aqualvs.results.run_request import RunFile, Status, now, read_run_yaml, write_yaml
from aqualvs.results.summary import RunSummary, summary_of
from aqualvs.scanning.posture import Posture, deviations
from aqualvs.scanning.scan import Scan
from aqualvs.special_files import refuse_special

POSTURE_COLUMNS = (
    *("frame", "time_s", "valid", "reason", "range_m", "pitch_deg", "yaw_deg"),
    *("sigma_range_m", "sigma_pitch_deg", "sigma_yaw_deg"),
    *("slant_range_m", "nearest_m", "n_points", "n_water"),
    *("curvature_x_per_m", "curvature_z_per_m"),
    *("sigma_curvature_x_per_m", "sigma_curvature_z_per_m"),
    *("sigma_range_rig_m", "sigma_pitch_rig_deg", "sigma_yaw_rig_deg"),
    *("sigma_range_total_m", "sigma_pitch_total_deg", "sigma_yaw_total_deg"),
)
"""Curvatures, horizontal and vertical, are empty unless the target is a curved net. `sigma_range_m`
and its like are due to the frame's noise, `sigma_..._rig_...` to the uncertainty of the rig, which
is common to all frames; `sigma_..._total_...` is the root of the sum of the squares of both."""
_N_NUMBERS = len(POSTURE_COLUMNS) - POSTURE_COLUMNS.index("range_m")


class PostureCsv(Closing):
    """Writer of `posture.csv`, row by row as `AppendFile` does it.

    With an interlaced shutter, each row ends with the field, "top" or "bottom". The constructor and
    `write` raise `OSError` as the system says it.
    """

    def __init__(self, path: Path, shutter: Shutter = AT_ONCE) -> None:
        self._file, self._shutter = AppendFile(path), shutter
        columns = (*POSTURE_COLUMNS, "field") if shutter.is_interlaced else POSTURE_COLUMNS
        try:
            self._append(",".join(columns) + "\n")
        except OSError:
            self.close()
            raise

    def write(self, *scans: Scan) -> None:
        """Append the rows of frames, all or none."""
        self._append("".join(map(self._row, scans)))

    def close(self) -> None:
        """Close the file; further calls do nothing."""
        self._file.close()

    def _row(self, scan: Scan) -> str:
        field = self._shutter.field_of(scan.index)
        return posture_row(scan) if field is None else f"{posture_row(scan)[:-1]},{field}\n"

    def _append(self, row: str) -> None:
        self._file.append(row.encode("ascii"))


def posture_cells(scan: Scan) -> dict[str, str]:
    """Return the cells of a frame's row by their columns."""
    return dict(zip(POSTURE_COLUMNS, posture_row(scan).rstrip("\n").split(","), strict=True))


def posture_row(scan: Scan) -> str:
    """Return a frame's row with its line end; without a posture the numbers stay empty."""
    head = f"{scan.index},{scan.time_s:.6f}"
    posture = scan.posture
    if not isinstance(posture, Posture):
        return f"{head},0,{posture.reason.value},{',' * (_N_NUMBERS - 1)}\n"
    return (
        f"{head},1,,"
        f"{posture.range:.6f},{math.degrees(posture.pitch):.5f},{math.degrees(posture.yaw):.5f},"
        f"{_sigmas(posture.covariance)},"
        f"{posture.slant_range:.6f},{posture.nearest:.6f},{posture.n_points},"
        f"{scan.n_water:.6f},{_curvature(posture)},"
        f"{_sigmas(posture.rig_covariance)},{_sigmas(posture.total_covariance)}\n"
    )


def _curvature(posture: Posture) -> str:
    if posture.curvature is None or posture.sigma_curvature is None:
        return ",,,"
    return ",".join(f"{value:.4g}" for value in (*posture.curvature, *posture.sigma_curvature))


def _sigmas(covariance: FloatArray) -> str:
    return ",".join(f"{sigma:.4g}" for sigma in deviations(covariance))


POSTURE_CSV = "posture.csv"
POSTURE_BARE_CSV = "posture_bare.csv"
POINTS_STREAM = "points.arrows"
POINTS_PARQUET = "points.parquet"
POINTS_PLY = "points.ply"
RUN_YAML = "run.yaml"
OVERLAY_MP4 = "overlay.mp4"
DIVE_MCAP = "dive.mcap"
REPORT_HTML = "report.html"
NET_CSV = "net.csv"
HOLES_CSV = "holes.csv"
NET_GEOJSON = "net.geojson"
NET_MAP_PNG = "net_map.png"
NET_MAP_SVG = "net_map.svg"
NET_FILES = (NET_CSV, HOLES_CSV, NET_GEOJSON, NET_MAP_PNG, NET_MAP_SVG)
"""The state of a net."""
RUN_FILES = (
    RUN_YAML,
    POSTURE_CSV,
    POSTURE_BARE_CSV,
    POINTS_STREAM,
    POINTS_PARQUET,
    POINTS_PLY,
    POINTS_PARQUET + DRAFT,
    POINTS_PLY + DRAFT,
    OVERLAY_MP4,
    DIVE_MCAP,
    REPORT_HTML,
    *NET_FILES,
)
"""Files of a run; nothing else in its folder is ever removed or replaced."""

_KILLED = "the run ended before it could close its files; the folder was completed afterwards"


class RunOutputs:
    """Writer of a run's folder; a context manager that completes it however the run ends.

    `folder` is from `prepare_folder`. Source, rig and options are for `run.yaml`; frames are added
    to the summary, whose monitors are those of the run. Every method raises `OutputError` if the
    disk is full or the folder cannot be written.
    """

    def __init__(
        self,
        folder: Path,
        *,
        source: Mapping[str, Any],
        rig: Mapping[str, Any],
        options: Mapping[str, Any],
        summary: RunSummary | None = None,
        shutter: Shutter = AT_ONCE,
    ) -> None:
        self.folder = folder
        # What `run.yaml` will say if the run ends without a fault; set it before the end.
        self.status = Status.FINISHED
        self.summary = RunSummary() if summary is None else summary  # So far.
        self._run_file = RunFile(folder / RUN_YAML, source, rig, options)
        with contextlib.ExitStack() as stack, writing(folder):
            # First, so that only one of two runs that begin at the same moment continues.
            self._points = stack.enter_context(_new_points_stream(folder))
            self._run_file.write(Status.RUNNING)
            self._posture = stack.enter_context(PostureCsv(folder / POSTURE_CSV, shutter))
            self._export: PointsExport | None = PointsExport(
                folder / POINTS_PARQUET, folder / POINTS_PLY
            )
            self._open_files = stack.pop_all()

    def write(self, *scans: Scan) -> None:
        """Write frames; when this returns, they outlive the process."""
        with writing(self.folder):
            # Points first: a frame that has its row in posture.csv has its points too.
            batch = self._points.write(*scans)
            self._posture.write(*scans)
        if batch is not None and self._export is not None:
            try:
                self._export.add(batch)
            except OSError:
                # The journal is complete: the next attempt, at the end, reports the fault.
                self._discard_export()
        for scan in scans:
            self.summary.add(scan)

    def __enter__(self) -> Self:
        """Return the writer."""
        return self

    def __exit__(self, _kind: object, fault: BaseException | None, _trace: object) -> None:
        """Complete the folder: `points.parquet` and `points.ply` replace the journal."""
        if isinstance(fault, OutputError):
            self._abandon(fault)
            return
        try:
            self._open_files.close()
            if self._export is None:
                _export_points_stream(self.folder)
            else:
                self._export.finish()
            (self.folder / POINTS_STREAM).unlink()
            error = "" if fault is None else f"{fault}" or type(fault).__name__
            status, summary = self._final_status(fault), self.summary.to_dict()
            self._run_file.write(status, error=error, summary=summary)
        except OSError as full:
            refusal = OutputError(explain(self.folder, full))
            self._abandon(refusal)
            raise refusal from full

    def _abandon(self, fault: OutputError) -> None:
        """Close open files, writing no more than a full disk can take."""
        self._discard_export()
        self._points.abandon()
        self._posture.close()
        with contextlib.suppress(OSError):
            self._run_file.write(Status.FAILED, error=str(fault), summary=self.summary.to_dict())

    def _discard_export(self) -> None:
        if self._export is not None:
            self._export.discard()
            self._export = None

    def _final_status(self, fault: BaseException | None) -> Status:
        if fault is None:
            return self.status
        return Status.INTERRUPTED if isinstance(fault, KeyboardInterrupt) else Status.FAILED


def prepare_folder(folder: Path, *, overwrite: bool) -> Claim:
    """Make sure that a run can be written to `folder`, and remove the one that it replaces.

    With `overwrite` the files of a run that is already there are removed (`RUN_FILES`, no others).
    Returns a claim, to be closed when the folder is complete. Raises `OutputError` if the folder
    holds a run and `overwrite` is not set, or files under a run's names that are none of a run's,
    if another process is writing to it, or if it cannot be written.
    """
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with locked_folder(folder):
            check_idle(folder / POINTS_STREAM)
            claim = claim_run(folder, RUN_FILES, overwrite=overwrite)
            for path in claim.found:
                path.unlink()
    return claim


def claim_run(folder: Path, names: Sequence[str], *, overwrite: bool) -> Claim:
    """Return a claim on files of a run's folder, which all commands share that write to it.

    Raises `OutputError` as `Claim` does.
    """
    paths = [folder / name for name in names]
    known = [folder / name for name in RUN_FILES] if _is_run(folder) else []
    return Claim("run", paths, overwrite=overwrite, known=known)


def _is_run(folder: Path) -> bool:
    try:
        return {"status", "source", "versions"} <= read_run_yaml(folder).keys()
    except SourceError:
        return False


def check_run_files(folder: Path) -> None:
    """Refuse a folder with a pipe or a device in the place of a run's file.

    Raises `SourceError` with its path.
    """
    for name in RUN_FILES:
        refuse_special(folder / name)


def recover(folder: Path) -> bool:
    """Complete the folder of a run that was killed; return False if there was nothing left to do.

    Raises `OutputError` if `folder` holds no run, the run is still under way, or the folder cannot
    be written.
    """
    if not (folder / POSTURE_CSV).is_file():
        raise OutputError(f"{folder}: holds no run (no {POSTURE_CSV}); give the folder of a run")
    check_run_files(folder)
    points_stream = folder / POINTS_STREAM
    check_idle(points_stream)
    if not points_stream.exists():
        return False
    with writing(folder):
        _export_points_stream(folder)
        points_stream.unlink()
        _complete_run_file(folder)
    return True


def _new_points_stream(folder: Path) -> PointsStream:
    """Begin the journal of a run.

    Raises `OutputError` if another run has started one since `prepare_folder`.
    """
    try:
        with locked_folder(folder):
            return PointsStream(folder / POINTS_STREAM, exclusive=True)
    except FileExistsError:
        raise OutputError(
            f"{folder}: another run has just begun here; choose another folder"
        ) from None


def _export_points_stream(folder: Path) -> None:
    batches = read_points_stream(folder / POINTS_STREAM)
    export_points(batches, folder / POINTS_PARQUET, folder / POINTS_PLY)


def _complete_run_file(folder: Path) -> None:
    """Replace the status of a run that could not say how it ended."""
    path = folder / RUN_YAML
    try:
        content = read_run_yaml(folder)
    except SourceError:
        return
    if content.get("status") != Status.RUNNING:
        return
    known = {"status", "started", "ended", "error", "summary"}
    head = {
        "status": Status.INTERRUPTED.value,
        "started": content.get("started"),
        "error": _KILLED,
        "completed": now(),
        "summary": summary_of(folder / POSTURE_CSV).to_dict(),
    }
    write_yaml(path, head | {key: value for key, value in content.items() if key not in known})
