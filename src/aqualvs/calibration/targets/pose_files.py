"""`poses.csv`, the measured poses of boards, one row a picture.

Columns of the file: `file`; `distance_mm`, where the board's plane meets the dome's y axis; and
`T00` to `T23`, the first three rows of dome_from_board (translations in millimetres). Either the
distance or the matrix may be left out.
"""

import csv
import difflib
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aqualvs.errors import CalibrationError, check_commas
from aqualvs.geometry.transforms import SE3
from aqualvs.yamlfile import read_text

_MM = 1e3
_MATRIX = tuple(f"T{row}{column}" for row in range(3) for column in range(4))
_COLUMNS = ("file", "distance_mm", *_MATRIX)


@dataclass(frozen=True, slots=True)
class BoardPose:
    """Measured pose of a board, one row of the file."""

    name: str  # File name of the picture.
    distance: float | None  # Distance along the y axis of `dome` to the board's plane, in metres.
    dome_from_board: SE3 | None  # The whole pose.


def load_poses(path: str | Path) -> tuple[BoardPose, ...]:
    """Load a `poses.csv`.

    Raises `CalibrationError` with one line that names the file, the line, the value and the remedy.
    """
    source = Path(path)
    text = read_text(source, "a poses.csv", CalibrationError)
    reader = csv.reader(io.StringIO(text))
    try:
        rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as fault:
        raise CalibrationError(
            f"{source}: line {reader.line_num} cannot be read ({fault}); fix that line"
        ) from None
    if len(rows) < 2:
        raise CalibrationError(
            f"{source}: holds no rows; write a line 'file,distance_mm' and one for each picture"
        )
    columns = _columns([cell.strip() for cell in rows[0][1]], source)
    poses: dict[str, BoardPose] = {}
    for line, row in rows[1:]:
        pose = _pose(columns, row, f"{source}: line {line}")
        if pose.name in poses:
            raise CalibrationError(
                f"{source}: line {line} names {pose.name} a second time; keep one row a picture"
            )
        poses[pose.name] = pose
    return tuple(poses.values())


def _columns(names: list[str], source: Path) -> list[str]:
    check_commas(names, source, CalibrationError)
    for name in names:
        if name not in _COLUMNS:
            close = difflib.get_close_matches(name, _COLUMNS, n=1, cutoff=0.5)
            known = "known are file, distance_mm and T00 to T23"
            hint = f"did you mean '{close[0]}'?" if close else known
            raise CalibrationError(f"{source}: {name!r} is not a column of a poses.csv; {hint}")
        if names.count(name) > 1:
            raise CalibrationError(f"{source}: column {name} appears twice; keep one")
    if "file" not in names:
        raise CalibrationError(f"{source}: column file is missing; it names the picture of a row")
    missing = [name for name in _MATRIX if name not in names]
    if 0 < len(missing) < len(_MATRIX):
        raise CalibrationError(
            f"{source}: column {missing[0]} is missing; give all of T00 to T23, or none"
        )
    if missing and "distance_mm" not in names:
        raise CalibrationError(
            f"{source}: says nothing of poses; add a column distance_mm, or T00 to T23"
        )
    return names


def _pose(columns: list[str], row: list[str], place: str) -> BoardPose:
    if len(row) != len(columns):
        raise CalibrationError(
            f"{place} has {len(row)} values for {len(columns)} columns; fix the line"
        )
    cells = dict(zip(columns, (cell.strip() for cell in row), strict=True))
    name = Path(cells["file"]).name
    if not name:
        raise CalibrationError(f"{place}: file is empty; write the picture's file name")
    values = {key: _number(key, cell, place) for key, cell in cells.items() if key != "file"}
    distance_mm = values.get("distance_mm")
    if distance_mm is not None:
        _check_distance(distance_mm, place)
    pose = _matrix_pose([values.get(key) for key in _MATRIX], place)
    if pose is not None and distance_mm is not None:
        _check_agreement(pose, distance_mm, place)
    return BoardPose(name, None if distance_mm is None else distance_mm / _MM, pose)


def _number(key: str, cell: str, place: str) -> float | None:
    """Return a cell's number; None for an empty cell."""
    if not cell:
        return None
    try:
        value = float(cell)
    except ValueError:
        raise CalibrationError(f"{place}: {key} is {cell!r}; write a plain number") from None
    if not np.isfinite(value):
        raise CalibrationError(f"{place}: {key} is {cell!r}; write a finite number")
    return value


def _check_distance(distance_mm: float, place: str) -> None:
    # Limits that reveal other units: no board stands inside a dome, none is seen at 100 m.
    likely_mm = (30.0, 1e5)
    metres_if_below = 15.0
    if not likely_mm[0] <= distance_mm <= likely_mm[1]:
        small = 0.0 < distance_mm < likely_mm[0]
        unit = "metres" if distance_mm < metres_if_below else "centimetres"
        hint = f"it looks like {unit}, " if small else ""
        raise CalibrationError(
            f"{place}: distance_mm is {distance_mm:g}; {hint}give millimetres from the dome's "
            "centre along its y axis"
        )


def _matrix_pose(matrix: list[float | None], place: str) -> SE3 | None:
    known = [value for value in matrix if value is not None]
    if not known:
        return None
    if len(known) < len(_MATRIX):
        empty = _MATRIX[matrix.index(None)]
        raise CalibrationError(f"{place}: {empty} is empty; give all of T00 to T23, or none")
    whole = np.array(known).reshape(3, 4)
    rotation = whole[:, :3]
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    # Error of a rotation matrix by rounded digits.
    rotation_tolerance = 2e-3
    if off > rotation_tolerance or np.linalg.det(rotation) < 0.0:
        what = "a mirror image" if off <= rotation_tolerance else f"off by {off:.2g}"
        raise CalibrationError(
            f"{place}: T00 to T22 are not a rotation ({what}); give the columns of dome_from_board "
            "with at least four decimals"
        )
    # The nearest rotation, because digits were rounded.
    left, _, right = np.linalg.svd(rotation)
    return SE3(left @ right, whole[:, 3] / _MM)


def _check_agreement(pose: SE3, distance_mm: float, place: str) -> None:
    normal = pose.rotation[:, 2]
    if abs(normal[1]) < 0.1:
        raise CalibrationError(
            f"{place}: the board's plane hardly meets the y axis; leave its distance_mm empty"
        )
    by_matrix_mm = _MM * float(normal @ pose.translation / normal[1])
    # Tolerance between a row's distance and its matrix: half a degree, half a millimetre.
    distance_tolerance_mm = 1.0
    if abs(by_matrix_mm - distance_mm) > distance_tolerance_mm:
        units = abs(_MM * by_matrix_mm - distance_mm) <= 0.01 * distance_mm
        hint = "T03, T13 and T23 look like metres, write millimetres" if units else "correct one"
        raise CalibrationError(
            f"{place}: distance_mm is {distance_mm:g}, but T00 to T23 put the board's plane at "
            f"{by_matrix_mm:.4g} mm on the y axis; {hint}"
        )


def _check_copy(copy: BoardPose, original: BoardPose, source: Path) -> None:
    """Raise `CalibrationError` if one picture was given two poses, under two names."""

    def numbers(pose: BoardPose) -> tuple[float | None, bytes]:
        place = pose.dome_from_board
        if place is None:
            return pose.distance, b""
        return pose.distance, place.rotation.tobytes() + place.translation.tobytes()

    if numbers(copy) != numbers(original):
        first, second = original.distance, copy.distance
        differ = "rows differ"
        if first is not None and second is not None and first != second:
            differ = f"distances are {_MM * first:g} and {_MM * second:g} mm"
        raise CalibrationError(
            f"{source}: {copy.name} is a copy of the picture {original.name}, but their {differ}; "
            "take the wrong row and picture out, or put the right picture there"
        )


def match_poses(
    poses: Sequence[BoardPose],
    names: Sequence[str],
    source: Path,
    *,
    copies: Mapping[str, str] | None = None,
) -> tuple[tuple[BoardPose, ...], tuple[str, ...]]:
    """Return the pose of each picture, in the pictures' order, and remarks.

    `poses` are the rows of the file `source`. `copies` has the names of pictures that are left out
    as copies, with the names of those that they repeat. Raises `CalibrationError` if a picture has
    no row, or the rows of a picture and its copy contradict each other.
    """
    copies = copies or {}
    by_name = {pose.name: pose for pose in poses}
    for copy, original in copies.items():
        if copy in by_name and original in by_name:
            _check_copy(by_name[copy], by_name[original], source)
    for name in names:
        if name not in by_name:
            close = difflib.get_close_matches(name, by_name, n=1, cutoff=0.6)
            hint = f"; is {close[0]} meant?" if close else ""
            raise CalibrationError(
                f"{source}: has no row for {name}; add one, or leave the picture out{hint}"
            )
    spare = [name for name in by_name if name not in {*names, *copies}]
    notes: tuple[str, ...] = ()
    if spare:
        shown = ", ".join(spare[:3]) + (", ..." if len(spare) > 3 else "")
        notes = (f"{source}: without a picture of the board: {shown}",)
    return tuple(by_name[name] for name in names), notes
