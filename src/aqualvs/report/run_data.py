"""A run's folder read for its report: `run.yaml`, `posture.csv`, truth, the bare-lens posture.

`run.yaml` also holds the rig; its lasers are returned with their planes and frames (paper, Eq.
37-40), and its facts as rows of a table. A laser behind a window has a bent sheet, which is shown
as the plane that fits the sheet best where the camera sees it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from pyarrow import csv

from aqualvs.errors import RigError, SourceError
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.optics.rigfile import rig_from_mapping
from aqualvs.optics.sheet import sheets_of
from aqualvs.optics.shutter import FIRST_ROW, Field
from aqualvs.results.folder import POSTURE_BARE_CSV
from aqualvs.results.run_request import read_run_yaml
from aqualvs.results.summary import read_truth as truth_by_frame

POSTURE = ("range_m", "pitch_deg", "yaw_deg")
"""The three columns of a posture, in the order of every (N, 3) array of the report."""
_SIGMAS = tuple(f"sigma_{name}" for name in POSTURE)
_TOTALS = ("sigma_range_total_m", "sigma_pitch_total_deg", "sigma_yaw_total_deg")
_NUMBERS = ("frame", "time_s", *POSTURE, *_SIGMAS, *_TOTALS, "n_points", "n_water")
_TEXTS = ("valid", "reason", "field")
_TRUE = ("true", "1", "yes")


class NoFrameError(SourceError):
    """A table without a row, as of a run that was killed before its first frame."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """`posture.csv` as arrays, one entry per frame, ordered by frame."""

    frame: IntArray  # Shape (N,).
    time_s: FloatArray  # Shape (N,).
    valid: BoolArray  # Shape (N,).
    reason: IntArray  # Shape (N,): index into `reasons`; meaningful where not valid.
    reasons: tuple[str, ...]  # As the file spells them.
    # Shape (N, 3): range in metres, pitch and yaw in degrees; NaN where not valid. `sigma` is what
    # the noise of one frame makes.
    posture: FloatArray
    sigma: FloatArray
    # Shape (N, 3): by noise and rig together; that of the noise in runs of older versions.
    sigma_total: FloatArray
    # Shape (N,): NaN where the file has none.
    n_points: FloatArray
    n_water: FloatArray
    # Field of even frames of an interlaced camera; None where frames are whole pictures.
    first_field: Field | None = None

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.frame)


def read_run_file(run_dir: Path) -> tuple[dict[str, Any], str]:
    """Return the content of `run.yaml` and what is wrong with it, in words ("" if nothing).

    An interrupted run may have left none or half of one; the report is still worth having.
    """
    if not (run_dir / "run.yaml").exists():
        return {}, "run.yaml is missing: rig, options and source are unknown."
    try:
        return read_run_yaml(run_dir), ""
    except SourceError:
        return {}, "run.yaml cannot be read: rig, options and source are unknown."


def read_track(path: Path) -> Track:
    """Read a `posture.csv`; rows that are damaged or cut short are left out.

    Raises `SourceError` if the file is missing, holds no frame, or holds something that is no
    number.
    """
    columns, texts = _read_columns(path)
    order = np.argsort(columns["frame"], kind="stable")
    posture, sigma, total = (
        np.stack([columns[name] for name in names], axis=-1)[order]
        for names in (POSTURE, _SIGMAS, _TOTALS)
    )
    total = np.where(np.isfinite(total), total, sigma)
    words, (reasons, reason) = texts["valid"], texts["reason"]
    says_so = np.array([word.lower() in _TRUE for word in words.names])
    valid = says_so[words.codes][order] & np.isfinite(posture).all(axis=1)
    return Track(
        frame=columns["frame"][order].astype(np.int64),
        time_s=columns["time_s"][order],
        valid=valid,
        reason=reason[order],
        reasons=reasons,
        posture=np.where(valid[:, None], posture, np.nan),
        sigma=np.where(valid[:, None], sigma, np.nan),
        sigma_total=np.where(valid[:, None], total, np.nan),
        n_points=columns["n_points"][order],
        n_water=columns["n_water"][order],
        first_field=_first_field(columns["frame"], texts["field"]),
    )


def _first_field(frame: FloatArray, field: "_Words") -> Field | None:
    """Return the field of even frames, as the first even row names it."""
    named = {field.names[code] for code in field.codes[frame % 2 == 0][:1].tolist()}
    return next((name for name in FIRST_ROW if name in named), None)


def read_truth(path: Path, track: Track) -> FloatArray:
    """Read truth, as `aqualvs.results.summary.read_truth` does, onto the frames of a track.

    Returns it as `Track.posture`, shape (N, 3); NaN where the file has no such frame, or no
    posture of it. Raises `SourceError` if the file cannot be read, or has postures of other frames
    only.
    """
    rows = truth_by_frame(path)
    values = np.array([*rows.values()], dtype=np.float64).reshape(-1, 3)
    truth = _onto(track.frame, np.array([*rows], dtype=np.float64), values)
    if rows and not np.isfinite(truth).any():
        raise SourceError(f"{path}: no frame in common with the run; give the truth of this dive")
    return truth


def noted_truth(run: Mapping[str, Any], track: Track) -> tuple[FloatArray | None, str]:
    """Read the truth that a run was compared with, and return what is wrong with it, in words.

    `run`: content of `run.yaml`. A report does without a truth that is gone, or of another dive.
    """
    path = mapping(run, "options").get("truth")
    if not isinstance(path, str):
        return None, ""
    without = "the report is without the errors against it."
    try:
        if not Path(path).is_file():
            return None, f"{path} is not there any more: {without}"
        return read_truth(Path(path), track), ""
    except OSError:
        # A name that the file system refuses is no file of it.
        return None, f"{path} is not there any more: {without}"
    except SourceError as fault:
        return None, f"{fault}: {without}"


def read_bare(run_dir: Path, track: Track) -> tuple[FloatArray | None, str]:
    """Read the posture that a bare-lens camera gives on the same pixels, if the run has it.

    Returns it as `Track.posture`, shape (N, 3), on the frames of `track`; and what is wrong with
    the file, in words, "" if nothing is, or the run was killed before it had a row.
    """
    path = run_dir / POSTURE_BARE_CSV
    if not path.is_file() or path.stat().st_size == 0:
        return None, ""
    try:
        bare = read_track(path)
    except NoFrameError:
        return None, ""
    except SourceError as fault:
        return None, f"{fault}: no comparison with a bare lens."
    return _onto(track.frame, bare.frame.astype(np.float64), bare.posture), ""


def mapping(content: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """Return the mapping below a key, empty if there is none."""
    found = content.get(key)
    return found if isinstance(found, dict) else {}


def source_name(run: Mapping[str, Any]) -> str:
    """Return the path of the source as the run has it; a folder of images has only a name."""
    source = mapping(run, "source")
    return str(source.get("path") or source.get("name") or "")


def number(value: object) -> float:
    """Return a file's value as a finite float, NaN where it is none."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return float("nan")
    return float(value) if np.isfinite(value) else float("nan")


def _onto(frames: IntArray, from_frames: FloatArray, values: FloatArray) -> FloatArray:
    """Return rows of `values` for each of `frames`, NaN where there is none."""
    known = np.isfinite(from_frames)
    from_frames, values = from_frames[known], values[known]
    found = np.full((len(frames), values.shape[1]), np.nan)
    if not len(from_frames):
        return found
    order = np.argsort(from_frames, kind="stable")
    place = np.searchsorted(from_frames[order], frames).clip(max=len(order) - 1)
    rows = order[place]
    match = from_frames[rows] == frames
    found[match] = values[rows[match]]
    return found


class _Words(NamedTuple):
    """A column of few different words: all of them in order, and the number of each row's."""

    names: tuple[str, ...]
    codes: IntArray


def _read_columns(path: Path) -> tuple[dict[str, FloatArray], dict[str, _Words]]:
    """Read numbers and texts of a `posture.csv`, of the rows that have a frame and its time.

    A missing column becomes NaN or "None".
    """
    table = _read_table(path)
    # With NumPy: filtering an Arrow table imports all of its functions first.
    whole = np.isfinite(_numbers(table["frame"])) & np.isfinite(_numbers(table["time_s"]))
    if not whole.any():
        raise NoFrameError(f"{path}: holds no frame; run the dive again")
    words = table.unify_dictionaries()
    return (
        {name: _numbers(table[name])[whole] for name in _NUMBERS},
        {name: _words(words[name], whole) for name in _TEXTS},
    )


def _read_table(path: Path) -> Any:
    word = pa.dictionary(pa.int32(), pa.string())
    types = dict.fromkeys(_NUMBERS, pa.float64()) | dict.fromkeys(_TEXTS, word)
    convert = csv.ConvertOptions(
        column_types=types, include_columns=list(types), include_missing_columns=True
    )
    parse = csv.ParseOptions(invalid_row_handler=lambda _row: "skip")
    try:
        content = path.read_bytes()
        if not content.isascii():
            # Arrow prints its own complaint of a damaged row that is not UTF-8.
            content = content.decode("utf-8", "replace").encode()
        return csv.read_csv(pa.BufferReader(content), parse_options=parse, convert_options=convert)
    except FileNotFoundError:
        raise SourceError(f"{path}: no such file; name the folder of a run, or run it") from None
    except (pa.ArrowInvalid, OSError) as fault:
        first_line = str(fault).splitlines()[0]
        raise SourceError(f"{path}: cannot be read ({first_line}); fix or remove it") from fault


def _words(column: Any, rows: BoolArray) -> _Words:
    """Return the words of some rows of a dictionary column, those alone that occur there."""
    if column.null_count:
        return _Words(("None",), np.zeros(int(rows.sum()), np.int64))
    chunks = column.chunks
    found = np.concatenate([chunk.indices.to_numpy() for chunk in chunks])[rows]
    codes, place = np.unique(found, return_inverse=True)
    names = [chunks[0].dictionary[code].as_py() for code in codes.tolist()]
    order = sorted(range(len(names)), key=names.__getitem__)
    return _Words(tuple(names[i] for i in order), np.argsort(order)[place])


def _numbers(column: Any) -> FloatArray:
    values = column.to_numpy(zero_copy_only=False).astype(np.float64)
    return np.where(np.isfinite(values), values, np.nan)


@dataclass(frozen=True, slots=True)
class LaserFacts:
    """A laser as the report needs it."""

    name: str
    normal: FloatArray  # Shape (3,): unit normal in `dome`; NaN where the file has none.
    offset: float  # Metres.
    bent: bool = False  # Whether the plane only fits a bent sheet.

    @classmethod
    def unknown(cls, index: int) -> "LaserFacts":
        """Return a laser of which only its number is known."""
        return cls(f"laser {index + 1}", np.full(3, np.nan), float("nan"))

    @property
    def known(self) -> bool:
        """True if the plane is known and has a frame of its own."""
        forward_part = 1.0 - self.normal[1] ** 2
        # Lasers whose plane is square to the forward axis have no projection of it to use as y.
        square = 1e-6
        return bool(np.isfinite(self.offset) and forward_part > square)

    def frame(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return origin, e_x and e_y of the laser's frame in `dome` (paper, Eq. 37-40).

        e_y is the dome's forward axis projected into the plane, e_x = e_y x e_z.
        """
        forward = np.array([0.0, 1.0, 0.0])
        e_y = forward - self.normal * self.normal[1]
        e_y /= np.linalg.norm(e_y)
        return self.normal * self.offset, np.cross(e_y, self.normal), e_y


def lasers_of(rig: Mapping[str, Any]) -> list[LaserFacts]:
    """Return the lasers of a rig file's content; what is missing or malformed becomes NaN."""
    entries = rig.get("lasers")
    if not isinstance(entries, list):
        return []
    lasers = [_laser(entry, i) for i, entry in enumerate(entries) if isinstance(entry, dict)]
    return _fitted(lasers, rig) if any(laser.bent for laser in lasers) else lasers


def _fitted(lasers: list[LaserFacts], rig: Mapping[str, Any]) -> list[LaserFacts]:
    """Return the lasers, those behind windows with the planes of their sheets; NaN if unknown."""
    try:
        known = rig_from_mapping(rig, source_name="run.yaml")
    except RigError:
        nothing = np.full(3, np.nan)
        return [replace(one, normal=nothing, offset=np.nan) if one.bent else one for one in lasers]
    camera = known.camera()
    planes = [sheet.best_plane(camera, known.working_range) for sheet in sheets_of(known)]
    return [
        replace(one, normal=plane.normal, offset=plane.offset) if one.bent else one
        for one, plane in zip(lasers, planes, strict=True)
    ]


def working_range_m(rig: Mapping[str, Any]) -> tuple[float, float] | None:
    """Return the nearest and farthest range at which the rig is believed, in metres."""
    pair = rig.get("working_range_mm")
    if not isinstance(pair, list) or len(pair) != 2:
        return None
    near, far = (1e-3 * number(value) for value in pair)
    return (near, far) if np.isfinite(near) and np.isfinite(far) else None


def housing_name(rig: Mapping[str, Any]) -> str:
    """Return the name of the camera's housing; "housing" where it is not known."""
    names = {"dome": "dome", "flat": "flat port"}
    return next((name for key, name in names.items() if isinstance(rig.get(key), dict)), "housing")


def dome_radius_mm(rig: Mapping[str, Any]) -> float:
    """Return the dome's outer radius in millimetres, NaN where the rig has no dome."""
    dome = mapping(rig, "dome")
    return number(dome.get("inner_radius_mm")) + number(dome.get("thickness_mm"))


def facts(content: Mapping[str, Any], skip: tuple[str, ...] = ()) -> list[tuple[str, str]]:
    """Return a nested mapping as rows (dotted key, value) for a table."""
    rows: list[tuple[str, str]] = []
    for key, value in content.items():
        name = str(key)
        if name in skip:
            continue
        if isinstance(value, dict):
            rows += [(f"{name}.{inner}", text) for inner, text in facts(value)]
        else:
            rows.append((name, _shown(value)))
    return rows


def _shown(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return ", ".join(_shown(item) for item in value)
    return "none" if value is None else str(value)


def _laser(entry: Mapping[str, Any], index: int) -> LaserFacts:
    values = entry.get("normal")
    triple = values if isinstance(values, list) and len(values) == 3 else [None] * 3
    normal = np.array([number(value) for value in triple])
    length = float(np.linalg.norm(normal))
    unknown = LaserFacts.unknown(index)
    name = str(entry.get("name") or unknown.name)
    if not length > 0.0:
        return LaserFacts(name, unknown.normal, unknown.offset)
    # As in rig files, the offset belongs to the unit normal.
    bent = entry.get("window") is not None
    return LaserFacts(name, normal / length, 1e-3 * number(entry.get("offset_mm")), bent)
