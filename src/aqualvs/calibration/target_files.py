"""Read and write what describes targets: `board.yaml`, `box.yaml` and `target.yaml`.

Files speak millimetres, types metres. docs/targets.md explains every key.
"""

import difflib
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from aqualvs.calibration.marker_checks import check_markers
from aqualvs.calibration.target_schema import BoardFile, MarkersFile, parse_target
from aqualvs.calibration.target_text import read_mapping, write_text
from aqualvs.calibration.targets import DICTIONARIES, Board, BoardKind, MarkerSet, dictionary_id
from aqualvs.errors import CalibrationError
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rigtext import TidyDumper

_MM = 1e3
_CORNER_ORDER = "top-left, top-right, bottom-right, bottom-left"
_CORNER_ORDER_TEXT = f"as OpenCV reports: {_CORNER_ORDER} of the upright marker"
_FRAME_TEXTS = {
    "box": "origin at the middle of the open mouth, x right, y forward, z up, mm; "
    "plane: normal . X = d",
    "dome": "dome (origin at the dome's centre, x right, y forward, z up), mm",
    "plate": "plate (x right, y down, origin at its top left), mm; NOT the dome: measure its place",
}
# A board's squares that no camera would be calibrated with.
_SQUARE_MM = (3.0, 1000.0)


def load_board(path: str | Path) -> Board:
    """Load a `board.yaml`.

    Raises
    ------
    CalibrationError
        One line that names the file, the value and the remedy.
    """
    source = Path(path)
    file = parse_target(read_mapping(source, "a board.yaml"), BoardFile, str(source))
    kind = _board_kind(file, source)
    if not _SQUARE_MM[0] <= file.square_mm <= _SQUARE_MM[1]:
        raise CalibrationError(f"{source}: {_unlikely_square(file.square_mm)}")
    try:
        return Board(
            kind=kind,
            squares=_squares(file, source),
            square=file.square_mm / _MM,
            marker=(file.marker_mm or 0.0) / _MM,
            dictionary=_known_dictionary(file.dictionary, "dictionary", source)
            if file.dictionary
            else "",
            border=file.border_mm / _MM,
            legacy_pattern=file.legacy_pattern,
        )
    except CalibrationError as fault:
        text = str(fault)
        raise CalibrationError(
            text if text.startswith(str(source)) else f"{source}: {text}"
        ) from None


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


def _unlikely_square(square_mm: float) -> str:
    unit = "metres" if square_mm < 0.5 else "centimetres" if square_mm < _SQUARE_MM[0] else ""
    looks = f"it looks like {unit}" if unit else "no camera sees one whole"
    return f"square_mm is {square_mm:g}; {looks}, give the side of a square in millimetres"


def _known_dictionary(name: str, key: str, source: Path) -> str:
    if dictionary_id(name) is None:
        close = difflib.get_close_matches(name.upper(), DICTIONARIES, n=1, cutoff=0.5)
        hint = f"did you mean {close[0]}?" if close else f"use one of {', '.join(DICTIONARIES)}"
        raise CalibrationError(f"{source}: {key} is {name!r}, which is unknown; {hint}")
    return name


def load_box(path: str | Path) -> tuple[MarkerSet, float | None]:
    """Load a `box.yaml`: markers on planes, in the box's own frame.

    Returns
    -------
    markers : MarkerSet
        In `box`; every marker lies on one of the planes.
    n_nominal : float or None
        Index that the file says the pictures were taken in.

    Raises
    ------
    CalibrationError
        One line that names the file, the value and the remedy.
    """
    source = Path(path)
    file = parse_target(read_mapping(source, "a box.yaml"), MarkersFile, str(source))
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

    Raises
    ------
    CalibrationError
        One line that names the file, the value and the remedy.
    """
    source = Path(path)
    file = parse_target(read_mapping(source, "a target.yaml"), MarkersFile, str(source))
    if (file.frame or "").startswith("plate"):
        raise CalibrationError(
            f"{source}: frame is plate, so its corners are not in the dome's frame; measure the "
            "plate's place on the vehicle and print it again with --position-mm and --rotation-deg"
        )
    return _markers(file, "dome", source)


def _markers(file: MarkersFile, frame: str, source: Path) -> MarkerSet:
    family = _known_dictionary(file.family, "family", source)
    if file.corner_order is not None and _CORNER_ORDER not in file.corner_order:
        raise CalibrationError(
            f"{source}: corner_order is {file.corner_order!r}; this aqualvs reads only "
            f"'{_CORNER_ORDER}', so reorder the corners"
        )
    check_markers(file, frame, source)
    return MarkerSet(
        frame=frame,
        family=family,
        ids=np.array([part.id for part in file.markers], np.int64),
        corners=np.array([part.corners for part in file.markers], np.float64) / _MM,
        plane_names=tuple(part.plane for part in file.markers),
        planes={
            name: Plane.from_normal(part.normal, part.d / _MM) for name, part in file.planes.items()
        },
    )


def save_board(board: Board, path: str | Path, *, note: str = "") -> None:
    """Write a `board.yaml` that `load_board` turns into the same board.

    Raises
    ------
    OutputError
        If the file cannot be written.
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
    write_text(Path(path), _yaml(content))


def save_markers(markers: MarkerSet, path: str | Path, *, note: str = "") -> None:
    """Write a `box.yaml` or `target.yaml` in the form that `load_box` and `load_target` read.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    content: dict[str, Any] = {"frame": _FRAME_TEXTS.get(markers.frame, markers.frame)}
    if note:
        content["note"] = note
    if markers.planes:
        content["planes"] = {
            name: {"normal": _plain(plane.normal), "d": _to_mm(plane.offset)}
            for name, plane in markers.planes.items()
        }
    content |= {"family": markers.family, "corner_order": _CORNER_ORDER_TEXT}
    lines = [_marker_text(markers, i) for i in range(len(markers))]
    write_text(Path(path), _yaml(content) + "markers:\n" + "".join(lines))


def _marker_text(markers: MarkerSet, i: int) -> str:
    """Return one marker, its corners on one line: YAML's own style would take thirty."""
    corners = [_plain(corner * _MM) for corner in markers.corners[i]]
    size = _to_mm(float(np.linalg.norm(markers.corners[i, 1] - markers.corners[i, 0])))
    plane = markers.plane_names[i]
    on_plane = "" if plane is None else f"    plane: {plane}\n"
    return f"  - id: {int(markers.ids[i])}\n{on_plane}    size_mm: {size}\n    corners: {corners}\n"


def _yaml(content: dict[str, Any]) -> str:
    text: str = yaml.dump(
        content,
        Dumper=TidyDumper,
        sort_keys=False,
        allow_unicode=True,
        width=1000,
        default_flow_style=False,
    )
    return text


def _to_mm(length: float) -> float:
    # Nine decimals keep a picometre and drop the noise of the conversion.
    return round(float(length) * _MM, 9)


def _plain(values: Any) -> list[float]:
    return [round(float(value), 9) + 0.0 for value in values]
