"""The net's condition over a dive: evaluation scan by scan, its files, and scans of a stored run.

`NetPass` takes scans one by one and writes the files. `read_run` reads the scans of a run back
from `posture.csv` and its points.

Modules that evaluate and draw are imported where they are used, because every run imports this
module and few evaluate a net.
"""

import csv
import math
from array import array
from collections.abc import Iterator, Sequence
from itertools import groupby, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from aqualvs import __version__
from aqualvs.errors import OptionError, SourceError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.nets.target_file import NetRequest
from aqualvs.optics.rig import Rig
from aqualvs.results.files import writing
from aqualvs.results.folder import (
    HOLES_CSV,
    NET_CSV,
    NET_GEOJSON,
    NET_MAP_PNG,
    NET_MAP_SVG,
    POSTURE_CSV,
    check_run_files,
)
from aqualvs.results.points import POINTS_SCHEMA, plain_column, points_file, stored_batches
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.scanning.scan import Label, Scan, ScanPoints

if TYPE_CHECKING:
    from aqualvs.nets.tables import UnrolledNet


class NetResult(NamedTuple):
    """Result of a net's evaluation, as written to its files."""

    summary: dict[str, Any]  # As `net.geojson` has it.
    lines: list[str]  # The same in words.


class NetPass:
    """Evaluation of a dive's net, scan by scan, and the writer of its files.

    The log of the request is read at once; raises `AqualvsError` if it cannot be read.
    """

    def __init__(self, rig: Rig, request: NetRequest) -> None:
        from aqualvs.nets.condition import NetCondition
        from aqualvs.nets.places import open_log

        self._rig, self._request = rig, request
        self._log = open_log(request.log, request.log_offset_s)
        self._condition = NetCondition(rig, request.options())
        # Time, range, pitch and yaw, four numbers a frame.
        self._postures = array("d")
        self._n_frames = 0

    def add(self, scan: Scan) -> None:
        """Take the next scan; scans of other targets than nets are ignored."""
        self._n_frames += 1
        posture = scan.posture
        if not isinstance(posture, Posture) or not _is_net(scan):
            return
        self._postures.extend((scan.time_s, posture.range, posture.pitch, posture.yaw))
        self._condition.add(scan)

    def write(self, folder: Path, video: Path | None = None) -> NetResult:
        """Finish, write the files of `NET_FILES` into a folder that exists; return the result.

        The clock of the dive's video may help to lay the log on it. Raises `OutputError` if a file
        cannot be written, `OptionError` if the twine was given thicker than the mesh's bars are
        long.
        """
        from aqualvs.nets.places import DivePostures, align_log, place_net
        from aqualvs.nets.tables import net_dict, net_lines, unroll

        self._condition.finish()
        stretches, holes = self._condition.stretches, self._condition.holes
        self._check_twine([one.lattice.bar for one in stretches if one.lattice is not None])
        postures = DivePostures(*np.array(self._postures).reshape(-1, 4).T.copy())
        log = None
        if self._log is not None:
            log = align_log(self._log, postures, self._request.log_offset_s, video)
        places = place_net(stretches, holes, postures, log.places if log else None)
        wall = unroll(stretches, holes, places, self._rig, postures)
        area = self._condition.area
        summary = net_dict(wall, area, self._n_frames, len(postures.time_s))
        metadata = {
            "version": __version__,
            "options": self._request.to_dict(),
            "log": None if log is None else log.to_dict(),
            "summary": summary,
        }
        with writing(folder):
            has_map = write_net_files(folder, wall, metadata)
        lines = net_lines(wall, area, self._n_frames)
        if log is not None:
            lines += [*log.log.notes, log.words()]
        lines.append(f"map of the net: {folder / NET_MAP_PNG if has_map else _NO_MAP}")
        return NetResult(summary, lines)

    def _check_twine(self, bars: Sequence[float]) -> None:
        twine_mm = self._request.twine_mm
        if twine_mm is None or not bars:
            return
        bar_mm = 1e3 * float(np.median(bars))
        if twine_mm >= bar_mm:
            raise OptionError(
                f"--twine-mm {twine_mm:g}: not thinner than the mesh's bar, measured as "
                f"{bar_mm:.1f} mm; give the diameter of one twine in millimetres"
            )


_NO_MAP = "not drawn, matplotlib is missing; pip install 'aqualvs[plots]'"


def write_net_files(folder: Path, wall: "UnrolledNet", metadata: dict[str, Any]) -> bool:
    """Write tables first, pictures last; return whether there is a map (`draw_map`).

    Raises `OSError` as the system says it.
    """
    from aqualvs.nets.map import draw_map
    from aqualvs.nets.tables import (
        HOLE_COLUMNS,
        NET_COLUMNS,
        hole_rows,
        stretch_rows,
        write_geojson,
        write_table,
    )

    write_table(folder / NET_CSV, NET_COLUMNS, stretch_rows(wall))
    write_table(folder / HOLES_CSV, HOLE_COLUMNS, hole_rows(wall))
    write_geojson(folder / NET_GEOJSON, wall, metadata)
    return draw_map(wall, [folder / NET_MAP_PNG, folder / NET_MAP_SVG])


def _is_net(scan: Scan) -> bool:
    labels = scan.points.label[scan.points.used]
    # Least share of net among the inliers for the posture to be that of a net.
    net_share = 0.5
    return bool(np.count_nonzero(labels == Label.NET) > net_share * len(labels))


_BATCH = 1 << 15
_SIGMAS = ("sigma_range_m", "sigma_pitch_deg", "sigma_yaw_deg")
_RIG_SIGMAS = ("sigma_range_rig_m", "sigma_pitch_rig_deg", "sigma_yaw_rig_deg")

Columns: TypeAlias = dict[str, NDArray[Any]]
_NONE = np.empty(0)


def read_run(run_folder: str | Path) -> Iterator[Scan]:
    """Yield the scans of a run in the order of their frames.

    Parameters
    ----------
    run_folder : str or Path
        With `posture.csv` and `points.parquet`, or `points.arrows` of a run that was killed.

    Yields
    ------
    scan : Scan
        As the scanner gave it, as far as it was stored: pixels, points, sigma, intensity, width and
        quality as float32, range to a micrometre, angles to 1e-5 degrees. The covariances hold
        the variances alone (what is between range and angles was not stored; the rig's are NaN in
        older runs), `rms` is NaN, a refusal has lost its detail.

    Raises
    ------
    SourceError
        If a file is missing, cannot be read, or lacks a column; an older run lacks `intensity` and
        `width_px`.

    Notes
    -----
    Memory holds one batch of points, however long the dive.
    """
    folder = Path(run_folder)
    points, path = _points_by_frame(folder), folder / POSTURE_CSV
    none = _scan_points([])
    frame, found = -math.inf, none
    for row in _posture_rows(path):
        try:
            index, posture = int(row["frame"]), _posture(row)
            time_s, n_water = float(row["time_s"]), _number(row["n_water"])
        except ValueError as fault:
            raise SourceError(
                f"{path}: frame {row['frame']} holds a value that is not a number "
                f"({fault}); fix the row"
            ) from fault
        while frame < index:
            frame, found = next(points, (math.inf, none))
        here, found = (found, none) if frame == index else (none, found)
        yield Scan(index, time_s, posture, here, n_water)


def check_stored(run_folder: Path) -> None:
    """Raise if `read_run` could not read a run.

    Raises `SourceError` as `read_run` does.
    """
    check_run_files(run_folder)
    next(_posture_rows(run_folder / POSTURE_CSV), None)
    next(_batches(run_folder), None)


def _posture_rows(path: Path) -> Iterator[dict[str, str]]:
    """Yield the whole rows of a `posture.csv`; one that was cut short is left out."""
    try:
        with path.open(newline="", encoding="ascii", errors="replace") as file:
            reader = csv.DictReader(file)
            missing = {"frame", "time_s", "valid", "reason", "range_m", "n_water", *_SIGMAS}
            missing -= set(reader.fieldnames or ())
            if missing:
                raise SourceError(
                    f"{path}: no column {sorted(missing)[0]}; give the folder of a run"
                )
            last = (reader.fieldnames or [""])[-1]
            yield from (row for row in reader if row[last] is not None)
    except FileNotFoundError:
        raise SourceError(f"{path}: no such file; give the folder of a run") from None
    except csv.Error as fault:
        raise SourceError(f"{path}: is damaged ({fault}); run the dive again") from None
    except OSError as fault:
        raise SourceError(f"{path}: cannot be read ({fault.strerror}); check the disk") from fault


def _posture(row: dict[str, str]) -> Posture | Refusal:
    if row["valid"] != "1":
        # A reason that this version does not know is no target.
        known = row["reason"] in set(Reason)
        return Refusal(Reason(row["reason"]) if known else Reason.NO_TARGET)
    pitch, yaw = math.radians(float(row["pitch_deg"])), math.radians(float(row["yaw_deg"]))
    normal = np.array([math.tan(yaw), 1.0, math.tan(pitch)])
    return Posture(
        range=float(row["range_m"]),
        pitch=pitch,
        yaw=yaw,
        covariance=_variances(row, _SIGMAS),
        normal_in_dome=normal / np.linalg.norm(normal),
        slant_range=float(row["slant_range_m"]),
        nearest=float(row["nearest_m"]),
        n_points=int(row["n_points"]),
        rms=math.nan,
        curvature=_pair_along_axes(row, "curvature_{}_per_m"),
        sigma_curvature=_pair_along_axes(row, "sigma_curvature_{}_per_m"),
        rig_covariance=_variances(row, _RIG_SIGMAS),
    )


def _variances(row: dict[str, str], names: tuple[str, ...]) -> FloatArray:
    """Return a covariance (3, 3) with zero correlations."""
    sigma = np.array([_number(row.get(name)) for name in names])
    sigma[1:] = np.deg2rad(sigma[1:])
    return np.diag(sigma**2)


def _pair_along_axes(row: dict[str, str], name: str) -> tuple[float, float] | None:
    """Return a pair along x and z, None where it is empty or the run older than its columns."""
    words = [row.get(name.format(axis)) for axis in "xz"]
    if not all(words):
        return None
    return _number(words[0]), _number(words[1])


def _number(text: str | None) -> float:
    return float(text) if text else math.nan


def _points_by_frame(run_folder: Path) -> Iterator[tuple[int, ScanPoints]]:
    """Yield each frame's points, in ascending order; frames without points are left out."""
    for frame, parts in groupby(_parts_of_frames(run_folder), key=lambda part: part[0]):
        yield frame, _scan_points([columns for _, columns in parts])


def _parts_of_frames(run_folder: Path) -> Iterator[tuple[int, Columns]]:
    """Yield each frame's points, in parts where the file's batches split them."""
    for columns in _batches(run_folder):
        frame = columns["frame"]
        edges = [0, *(np.flatnonzero(np.diff(frame)) + 1).tolist(), len(frame)]
        for begin, end in pairwise(edges):
            if begin < end:
                part = {name: column[begin:end] for name, column in columns.items()}
                yield int(frame[begin]), part


def _batches(run_folder: Path) -> Iterator[Columns]:
    path = points_file(run_folder)
    try:
        for batch in stored_batches(path, _BATCH):
            missing = [name for name in POINTS_SCHEMA.names if name not in batch.schema.names]
            if missing:
                raise SourceError(
                    f"{path}: has no column {' and no '.join(missing)}, as runs of older versions; "
                    "run the dive again with this version"
                )
            yield {
                name: plain_column(batch.column(name), labels=name == "label")
                for name in POINTS_SCHEMA.names
            }
    except FileNotFoundError:
        raise SourceError(
            f"{path}: no such file; give the folder of a run, or run the dive again"
        ) from None
    except (pa.ArrowInvalid, OSError) as fault:
        line = str(fault).splitlines()[0]
        raise SourceError(f"{path}: cannot be read ({line}); run the dive again") from fault


def _scan_points(parts: list[Columns]) -> ScanPoints:
    """Join the parts of one frame's points."""

    def of(*names: str) -> FloatArray:
        columns = [np.concatenate([part[name] for part in parts] or [_NONE]) for name in names]
        return np.stack(columns, axis=-1).astype(np.float64)

    return ScanPoints(
        laser=of("laser")[:, 0].astype(np.int8),
        pixels=of("u_px", "v_px"),
        points_in_dome=of("x_m", "y_m", "z_m"),
        sigma=of("sigma_m")[:, 0],
        intensity=of("intensity")[:, 0],
        width=of("width_px")[:, 0],
        quality=of("quality")[:, 0],
        label=of("label")[:, 0].astype(np.uint8),
        used=of("used")[:, 0].astype(np.bool_),
    )
