"""Target files `board.yaml`, `box.yaml` and `target.yaml`: schema, reading, checks, writing.

Lengths are millimetres in the files, metres in the types. docs/targets.md explains every key.

The reader tolerates free text in notes and is strict about everything else: every key, and for
markers at known places their sizes, corner order, planes and units.
"""

import difflib
import re
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import numpy as np
from pydantic import Field

from aqualvs.calibration.targets.targets import (
    Board,
    BoardKind,
    MarkerSet,
    aruco_dictionary,
    dictionary_hint,
    dictionary_id,
)
from aqualvs.calibration_formats import refuse_foreign
from aqualvs.errors import CalibrationError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.schema import (
    Index,
    NotNegative,
    Number,
    Positive,
    SchemaWords,
    StrictPart,
    Triple,
    validated,
)
from aqualvs.yamlfile import parse_yaml, read_text, write_text, yaml_text

# Keys of free text, often written without quotes but with colons, which YAML would reject.
_FREE_TEXT = re.compile(
    r"^(frame|corner_order|note):[ \t]+(?![\"'|>\[{&*!%@`])(?P<text>\S.*?)[ \t]*$", re.MULTILINE
)


PartT = TypeVar("PartT", bound=StrictPart)


def _quoted(match: re.Match[str]) -> str:
    text = match["text"].replace("'", "''")
    return f"{match[1]}: '{text}'"


def _read(path: Path, what: str, schema: type[PartT]) -> PartT:
    """Return the content of a YAML file; `what` names its kind in messages."""
    raw = read_text(path, what, CalibrationError)
    refuse_foreign(raw, path, what, CalibrationError)
    text = _FREE_TEXT.sub(_quoted, raw)
    content = parse_yaml(text, str(path), CalibrationError)
    if not isinstance(content, dict):
        raise CalibrationError(f"{path}: holds no keys; give the path of {what}")
    return validated(schema, content, path, CalibrationError, _WORDS)


Count = Annotated[int, Field(ge=2, le=1000)]
Corners = Annotated[list[Triple], Field(min_length=4, max_length=4)]


class BoardFile(StrictPart):
    """Schema of `board.yaml`."""

    kind: Literal["chessboard", "charuco"] | None = None
    squares_x: Count | None = None
    squares_y: Count | None = None
    inner_corners_x: Count | None = None
    inner_corners_y: Count | None = None
    square_mm: Positive
    marker_mm: Positive | None = None
    dictionary: str | None = None
    border_mm: NotNegative = 0.0
    legacy_pattern: bool = False
    note: Any = None


class PlanePart(StrictPart):
    """Schema of one of `planes`: normal . X = d."""

    normal: Triple
    d: Number


class MarkerPart(StrictPart):
    """Schema of one of `markers`."""

    id: Annotated[int, Field(ge=0)]
    plane: str | None = None
    size_mm: Positive
    corners: Corners


class MediumPart(StrictPart):
    """Schema of `medium`, in which the pictures were taken."""

    n_outside_nominal: Index


class MarkersFile(StrictPart):
    """Schema of `box.yaml` and `target.yaml`."""

    frame: str | None = None
    planes: dict[str, PlanePart] = Field(default={})
    family: str
    corner_order: str | None = None
    markers: Annotated[list[MarkerPart], Field(min_length=1)]
    medium: MediumPart | None = None
    note: Any = None


_EXAMPLES = {
    "kind": "kind: charuco",
    "squares_x": "squares_x: 11",
    "squares_y": "squares_y: 8",
    "inner_corners_x": "inner_corners_x: 6",
    "inner_corners_y": "inner_corners_y: 9",
    "square_mm": "square_mm: 24.0",
    "marker_mm": "marker_mm: 18.0",
    "dictionary": "dictionary: DICT_4X4_250",
    "border_mm": "border_mm: 12.0",
    "legacy_pattern": "legacy_pattern: false",
    "planes": "planes: {left: {normal: [1.0, 0.0, 0.0], d: -200.0}}",
    "normal": "normal: [1.0, 0.0, 0.0]",
    "d": "d: -200.0",
    "family": "family: DICT_APRILTAG_36h11",
    "markers": "markers: [{id: 0, size_mm: 48.0, corners: [...]}]",
    "id": "id: 0",
    "plane": "plane: left",
    "size_mm": "size_mm: 48.0",
    "corners": "corners: [[x, y, z], [x, y, z], [x, y, z], [x, y, z]]",
    "medium": "medium: {n_outside_nominal: 1.333}",
    "n_outside_nominal": "n_outside_nominal: 1.333",
}
_WORDS = SchemaWords(examples=_EXAMPLES, first_line="note: text")


class _Tolerances(NamedTuple):
    """Tolerances and likely sizes of targets, in millimetres."""

    # Tolerance of a ruler, as a share of the marker and in millimetres.
    side: tuple[float, float] = (0.02, 0.2)
    plane_mm: float = 0.5
    smallest_mm: float = 3.0
    # Limits that reveal other units: a box with all markers nearer to its origin holds no vehicle,
    # and no dome is small enough for a target this near to its centre.
    smallest_box_mm: float = 100.0
    nearest_target_mm: float = 30.0
    # Unlikely sizes of a board's squares.
    square_mm: tuple[float, float] = (3.0, 1000.0)


_TOLERANCES = _Tolerances()

_UNITS = {1e-3: "metres", 1e-1: "centimetres"}


def _check_ids(file: MarkersFile) -> None:
    held = len(aruco_dictionary(file.family).bytesList)
    seen: set[int] = set()
    for part in file.markers:
        if part.id in seen:
            raise CalibrationError(f"marker {part.id} is listed twice; every id is one marker")
        if part.id >= held:
            raise CalibrationError(
                f"marker {part.id} is not in {file.family}, which has ids 0 to {held - 1}; check "
                "the id or the family"
            )
        seen.add(part.id)


def _plane(name: str, normal: list[float], d: float) -> Plane:
    try:
        return Plane.from_normal(normal, d)
    except ValueError:
        raise CalibrationError(
            f"planes.{name}.normal is {normal}; a normal has a direction"
        ) from None


def _check_shape(part: MarkerPart) -> None:
    corners = np.array(part.corners)
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    diagonals = np.linalg.norm(corners[2:] - corners[:2], axis=1)
    if part.size_mm < _TOLERANCES.smallest_mm:
        unit = "metres" if part.size_mm < 0.3 else "centimetres"
        raise CalibrationError(
            f"marker {part.id}: size_mm is {part.size_mm:g}; it looks like {unit}, write "
            "millimetres everywhere"
        )
    for factor, unit in _UNITS.items():
        if np.allclose(sides, factor * part.size_mm, rtol=0.05):
            raise CalibrationError(
                f"marker {part.id}: its corners are {sides[0]:g} apart, but size_mm is "
                f"{part.size_mm:g}; the corners look like {unit}, write millimetres"
            )
    tolerance = max(_TOLERANCES.side[0] * part.size_mm, _TOLERANCES.side[1])
    if np.any(np.abs(sides - np.sqrt(2.0) * part.size_mm) < tolerance):
        raise CalibrationError(
            f"marker {part.id}: its corners are not in order around it; write top-left, "
            "top-right, bottom-right, bottom-left"
        )
    worst = int(np.argmax(np.abs(sides - part.size_mm)))
    if abs(sides[worst] - part.size_mm) > tolerance:
        raise CalibrationError(
            f"marker {part.id}: corners {worst} and {(worst + 1) % 4} are {sides[worst]:.2f} mm "
            f"apart, but size_mm is {part.size_mm:g}; correct the corners or the size"
        )
    if np.any(np.abs(diagonals - np.sqrt(2.0) * part.size_mm) > 2.0 * tolerance):
        raise CalibrationError(
            f"marker {part.id}: its diagonals are {diagonals[0]:.2f} and {diagonals[1]:.2f} mm, "
            "so it is not a square; correct the corners"
        )


def _check_plane(part: MarkerPart, planes: dict[str, Plane]) -> None:
    if part.plane is None:
        return
    if part.plane not in planes:
        close = difflib.get_close_matches(part.plane, planes, n=1, cutoff=0.5)
        known = f"did you mean {close[0]!r}?" if close else f"known are {', '.join(planes)}"
        raise CalibrationError(f"marker {part.id}: plane {part.plane!r} is not in planes; {known}")
    off = planes[part.plane].signed_distance(np.array(part.corners))
    worst = int(np.argmax(np.abs(off)))
    if abs(off[worst]) > _TOLERANCES.plane_mm:
        raise CalibrationError(
            f"marker {part.id}: corner {worst} lies {abs(off[worst]):.1f} mm off plane "
            f"{part.plane!r}; correct the corner, the plane's d, or the plane's name"
        )


def _check_extent(corners: FloatArray, frame: str) -> None:
    distance = np.linalg.norm(corners, axis=-1)
    if frame == "box" and distance.max() < _TOLERANCES.smallest_box_mm:
        raise CalibrationError(
            f"no corner is farther than {distance.max():.3g} mm from the box's origin; it looks "
            "like centimetres, write millimetres"
        )
    if frame == "dome" and distance.min() < _TOLERANCES.nearest_target_mm:
        raise CalibrationError(
            f"a corner is only {distance.min():.3g} mm from the dome's centre, inside any dome; "
            "check the units (millimetres) and that corners are given in the dome's frame"
        )


def _check_facing(file: MarkersFile, corners: FloatArray, frame: str) -> None:
    """Check that markers face the dome's centre, or the inside of a box of several planes."""
    if frame == "box" and len({part.plane for part in file.markers}) < 2:
        return
    viewer = corners.reshape(-1, 3).mean(axis=0) if frame == "box" else np.zeros(3)
    away = np.cross(corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0])
    behind = np.einsum("ij,ij->i", away, corners.mean(axis=1) - viewer)
    for part, side in zip(file.markers, behind, strict=True):
        if side < 0.0:
            raise CalibrationError(
                f"marker {part.id}: seen from the camera its corners run anticlockwise; write "
                "top-left, top-right, bottom-right, bottom-left as the camera sees them"
            )


_MM = 1e3
_CORNER_ORDER = "top-left, top-right, bottom-right, bottom-left"
_CORNER_ORDER_TEXT = f"as OpenCV reports: {_CORNER_ORDER} of the upright marker"
_FRAME_TEXTS = {
    "box": "origin at the middle of the open mouth, x right, y forward, z up, mm; "
    "plane: normal . X = d",
    "dome": "dome (origin at the dome's centre, x right, y forward, z up), mm",
    "plate": "plate (x right, y down, origin at its top left), mm; NOT the dome: measure its place",
}


def load_board(path: str | Path) -> Board:
    """Load a `board.yaml`.

    Raises `CalibrationError` with one line that names the file, the value and the remedy.
    """
    source = Path(path)
    file = _read(source, "a board.yaml", BoardFile)
    kind = _board_kind(file, source)
    if not _TOLERANCES.square_mm[0] <= file.square_mm <= _TOLERANCES.square_mm[1]:
        unit = "metres" if file.square_mm < 0.5 else "centimetres"
        too_small = file.square_mm < _TOLERANCES.square_mm[0]
        looks = f"it looks like {unit}" if too_small else "no camera sees one whole"
        raise CalibrationError(
            f"{source}: square_mm is {file.square_mm:g}; {looks}, give the side of a square in "
            "millimetres"
        )
    squares = _squares(file, source)
    if file.dictionary:
        _check_dictionary(file.dictionary, "dictionary", source)
    try:
        return Board(
            kind=kind,
            squares=squares,
            square=file.square_mm / _MM,
            marker=(file.marker_mm or 0.0) / _MM,
            dictionary=file.dictionary or "",
            border=file.border_mm / _MM,
            legacy_pattern=file.legacy_pattern,
        )
    except CalibrationError as fault:
        raise CalibrationError(f"{source}: {fault}") from None


def _board_kind(file: BoardFile, source: Path) -> BoardKind:
    marked = {"marker_mm": file.marker_mm, "dictionary": file.dictionary}
    given = [key for key, value in marked.items() if value is not None]
    kind = BoardKind(file.kind or ("charuco" if given else "chessboard"))
    if kind is BoardKind.CHESSBOARD and given:
        raise CalibrationError(
            f"{source}: {given[0]} is given, but kind is chessboard; write 'kind: charuco', or "
            f"leave out {given[0]}"
        )
    if kind is BoardKind.CHARUCO and len(given) < 2:
        missing = next(key for key in marked if key not in given)
        raise CalibrationError(f"{source}: {missing} is missing; a ChArUco board has markers")
    return kind


def _squares(file: BoardFile, source: Path) -> tuple[int, int]:
    squares = (file.squares_x, file.squares_y)
    inner = (file.inner_corners_x, file.inner_corners_y)
    if any(squares) and any(inner):
        raise CalibrationError(
            f"{source}: gives squares and inner corners; keep squares_x and squares_y"
        )
    x, y = inner if any(inner) else squares
    if x is None or y is None:
        raise CalibrationError(
            f"{source}: the number of squares is missing; write squares_x and squares_y, or "
            "inner_corners_x and inner_corners_y, one less each"
        )
    return (x + 1, y + 1) if any(inner) else (x, y)


def _check_dictionary(name: str, key: str, source: Path) -> None:
    if dictionary_id(name) is None:
        raise CalibrationError(
            f"{source}: {key} is {name!r}, which is unknown; {dictionary_hint(name)}"
        )


def load_box(path: str | Path) -> tuple[MarkerSet, float | None]:
    """Load a `box.yaml`: markers on planes, in the box's own frame, and the stated medium's index.

    The index is None if the file does not say in which medium pictures were taken. Raises
    `CalibrationError` with one line that names the file, the value and the remedy.
    """
    source = Path(path)
    file = _read(source, "a box.yaml", MarkersFile)
    if not file.planes:
        raise CalibrationError(
            f"{source}: planes is missing; a box has planes, each with 'normal' and 'd'"
        )
    for i, part in enumerate(file.markers):
        if part.plane is None:
            raise CalibrationError(
                f"{source}: markers[{i}].plane is missing (id {part.id}); write one of "
                f"{', '.join(file.planes)}"
            )
    markers = _markers(file, "box", source)
    return markers, None if file.medium is None else file.medium.n_outside_nominal


def load_target(path: str | Path) -> MarkerSet:
    """Load a `target.yaml`: markers fixed to the vehicle, in `dome`.

    Raises `CalibrationError` with one line that names the file, the value and the remedy.
    """
    source = Path(path)
    file = _read(source, "a target.yaml", MarkersFile)
    if (file.frame or "").startswith("plate"):
        raise CalibrationError(
            f"{source}: frame is plate, so its corners are not in the dome's frame; measure the "
            "plate's place on the vehicle and print it again with --position-mm and --rotation-deg"
        )
    return _markers(file, "dome", source)


def _markers(file: MarkersFile, frame: str, source: Path) -> MarkerSet:
    _check_dictionary(file.family, "family", source)
    if file.corner_order is not None and _CORNER_ORDER not in file.corner_order:
        raise CalibrationError(
            f"{source}: corner_order is {file.corner_order!r}; this aqualvs reads only "
            f"'{_CORNER_ORDER}', so reorder the corners"
        )
    try:
        _check_ids(file)
        planes = {name: _plane(name, part.normal, part.d) for name, part in file.planes.items()}
        for part in file.markers:
            _check_shape(part)
            _check_plane(part, planes)
        corners = np.array([part.corners for part in file.markers])
        _check_extent(corners, frame)
        _check_facing(file, corners, frame)
    except CalibrationError as fault:
        raise CalibrationError(f"{source}: {fault}") from None
    return MarkerSet(
        frame=frame,
        family=file.family,
        ids=np.array([part.id for part in file.markers], np.int64),
        corners=corners / _MM,
        plane_names=tuple(part.plane for part in file.markers),
        planes={
            name: Plane.from_normal(part.normal, part.d / _MM) for name, part in file.planes.items()
        },
    )


def save_board(board: Board, path: str | Path, *, note: str = "") -> None:
    """Write a `board.yaml` that `load_board` turns into the same board.

    Raises `OutputError` if the file cannot be written.
    """
    content: dict[str, Any] = {
        "kind": str(board.kind),
        "squares_x": board.squares[0],
        "squares_y": board.squares[1],
        "square_mm": _to_mm(board.square),
    }
    if board.kind is BoardKind.CHARUCO:
        content |= {"marker_mm": _to_mm(board.marker), "dictionary": board.dictionary}
    content["border_mm"] = _to_mm(board.border)
    if board.legacy_pattern:
        content["legacy_pattern"] = True
    if note:
        content["note"] = note
    write_text(Path(path), yaml_text(content))


def save_markers(markers: MarkerSet, path: str | Path) -> None:
    """Write a `box.yaml` or `target.yaml` in the form that `load_box` and `load_target` read.

    Raises `OutputError` if the file cannot be written.
    """
    content: dict[str, Any] = {"frame": _FRAME_TEXTS.get(markers.frame, markers.frame)}
    if markers.planes:
        content["planes"] = {
            name: {"normal": _plain(plane.normal), "d": _to_mm(plane.offset)}
            for name, plane in markers.planes.items()
        }
    content |= {"family": markers.family, "corner_order": _CORNER_ORDER_TEXT}
    lines = [_marker_text(markers, i) for i in range(len(markers))]
    write_text(Path(path), yaml_text(content) + "markers:\n" + "".join(lines))


def _marker_text(markers: MarkerSet, i: int) -> str:
    """Return one marker, its corners on one line instead of YAML's thirty."""
    corners = [_plain(corner * _MM) for corner in markers.corners[i]]
    size = _to_mm(float(np.linalg.norm(markers.corners[i, 1] - markers.corners[i, 0])))
    plane = markers.plane_names[i]
    on_plane = "" if plane is None else f"    plane: {plane}\n"
    return f"  - id: {int(markers.ids[i])}\n{on_plane}    size_mm: {size}\n    corners: {corners}\n"


def _to_mm(length: float) -> float:
    # Nine decimals keep a picometre and drop rounding errors of the conversion.
    return round(float(length) * _MM, 9)


def _plain(values: Any) -> list[float]:
    return [round(float(value), 9) + 0.0 for value in values]
