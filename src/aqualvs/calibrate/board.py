"""`aqualvs board`: write a target as a PDF, true to scale, and the file that describes it.

The target is a ChArUco board or chessboard for camera and dome, the markers of a box for the
lasers, or a small plate of markers, fixed to the vehicle, for the water's refractive index.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from aqualvs.calibration.targets.printed import (
    FIT,
    BoxPlan,
    PdfPage,
    SheetPatch,
    best_paper,
    board_rectangles,
    box_patches,
    marker_rectangles,
    outline,
    papers,
    pdf_bytes,
    sheet,
)
from aqualvs.calibration.targets.target_files import save_board, save_markers
from aqualvs.calibration.targets.targets import Board, BoardKind, MarkerSet, aruco_dictionary
from aqualvs.errors import CalibrationError, OptionError, check_options
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL
from aqualvs.results.files import Claim, writing
from aqualvs.terminal import Echo
from aqualvs.text import count_text

_MM = 1e3
# Width of the light border around a board, as a share of a square; keeps the outer squares
# detectable on any background.
_BORDER_SHARE = 0.25
# Gap between the markers of a plate and width of its border, as a share of a marker.
_PLATE_GAP_SHARE = 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardRequest:
    """Request of `aqualvs board`, see its `--help`. Lengths in millimetres, angles in degrees."""

    kind: Literal["charuco", "chessboard", "box", "plate"]  # Kind of target.
    out: Path  # `OUT.pdf` and `OUT.yaml` are written.
    paper: str = "a4"  # A4 to A0, letter, WIDTHxHEIGHT, or "fit".
    # Columns and rows of squares on a board, or of markers on a plate.
    squares_x: int | None = None
    squares_y: int | None = None
    # Side of a square; None takes the largest whole number of millimetres that fits the paper.
    square_mm: float | None = None
    # Side of a marker; None takes 3/4 of the square on a board, 48 in a box, 12 on a plate.
    marker_mm: float | None = None
    # None takes the smallest DICT_4X4 on a board, AprilTag 36h11 otherwise.
    dictionary: str | None = None
    # Light border; None takes a quarter of a square.
    border_mm: float | None = None
    # Inner sizes of the box.
    width_mm: float = 400.0
    height_mm: float = 380.0
    depth_mm: float = 700.0
    # Id of the first marker of a box or plate.
    first_id: int = 0
    # Position of the plate's first corner (top left of its first marker) in `dome`.
    position_mm: tuple[float, float, float] | None = None
    # Rotation vector in `dome`, applied to a plate that faces the camera upright.
    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # Whether to replace files that this command wrote before.
    overwrite: bool = False

    def __post_init__(self) -> None:
        """Raise `OptionError` for counts and lengths that cannot be printed."""
        check_options(self, "squares_x", "squares_y", least=1.0, wanted="1 or more")
        # A length below a millimetre was most likely given in metres.
        lengths = ("square_mm", "marker_mm", "width_mm", "height_mm", "depth_mm")
        check_options(self, *lengths, least=1.0, wanted="millimetres, 1 or more")
        check_options(self, "border_mm", least=0.0, wanted="millimetres, 0 or more")


def print_board(request: BoardRequest, echo: Echo) -> None:
    """Write the PDF and the yaml of a target.

    Raises `OptionError` if the target is impossible or does not fit the paper, or `out` has no file
    name. Raises `OutputError` if a file cannot be written.
    """
    out = request.out.with_suffix("") if request.out.suffix == ".pdf" else request.out
    if out.name in ("", ".."):
        raise OptionError(f"--out: {out} names no file; give one, such as {out / 'board'}")
    pdf, yaml = out.with_name(f"{out.name}.pdf"), out.with_name(f"{out.name}.yaml")
    with Claim("board", [pdf, yaml], overwrite=request.overwrite):
        printers = {"box": _print_box, "plate": _print_plate}
        try:
            pages, notes = printers.get(request.kind, _print_squares)(request, yaml)
        except CalibrationError as fault:
            raise OptionError(str(fault)) from None
        with writing(pdf):
            pdf.write_bytes(pdf_bytes(pages, f"aqualvs {request.kind}"))
    n_pages = count_text(len(pages), "page")
    echo(f"pages: {pdf} ({n_pages}; print at 100 %, then measure the ruler)")
    echo(f"file: {yaml}")
    for note in notes:
        echo(f"note: {note}")


def _print_squares(request: BoardRequest, yaml: Path) -> tuple[list[PdfPage], list[str]]:
    """Write the file of a board; return its page and notes."""
    board = _board(request)
    border = _MM * board.border
    width, height = (_MM * side + 2.0 * border for side in board.size)
    paper = best_paper(request.paper, width, height, "the board")
    rectangles = _MM * board_rectangles(board) + np.array([border, border, 0.0, 0.0])
    page = sheet(paper, rectangles, (width, height), f"aqualvs: {board.describe()}")
    save_board(board, yaml)
    measure = f"measure {board.squares[0]} squares: {_MM * board.size[0]:g} mm"
    return [page], [f"glue it flat on a stiff plate, and {measure}; else correct square_mm"]


def _board(request: BoardRequest) -> Board:
    """Return the board of a request, with defaults for what is left out."""
    squares = (request.squares_x or 11, request.squares_y or 8)
    square = request.square_mm or _largest_square(request, squares)
    border = _BORDER_SHARE * square if request.border_mm is None else request.border_mm
    kind = BoardKind(request.kind)
    marker, dictionary = 0.0, ""
    if kind is BoardKind.CHARUCO:
        # Ratio of marker to square, about that of OpenCV's own boards.
        marker_share = 0.75
        marker = marker_share * square if request.marker_mm is None else request.marker_mm
        dictionary = request.dictionary or _smallest_dictionary(squares[0] * squares[1] // 2)
    return Board(
        kind=kind,
        squares=squares,
        square=square / _MM,
        marker=marker / _MM,
        dictionary=dictionary,
        border=border / _MM,
    )


def _largest_square(request: BoardRequest, squares: tuple[int, int]) -> float:
    """Return the side of the largest square, in whole millimetres, that fits the paper."""
    border = request.border_mm
    shares = np.array(squares) + (2.0 * _BORDER_SHARE if border is None else 0.0)
    sides = []
    for paper in papers(request.paper):
        if paper.size_mm is None:
            raise OptionError(f"--paper {FIT}: needs --square-mm, the side of a square")
        sides.append(np.min((np.array(paper.room_mm) - 2.0 * (border or 0.0)) / shares))
    side = float(np.floor(max(sides)))
    if side < 4.0:
        raise OptionError(
            f"--paper {request.paper}: {squares[0]} x {squares[1]} squares would be smaller than "
            "4 mm; take fewer squares or larger paper"
        )
    return side


def _smallest_dictionary(n_markers: int) -> str:
    # Numbers of markers of OpenCV's dictionaries.
    for n in (50, 100, 250, 1000):
        if n >= n_markers:
            return f"DICT_4X4_{n}"
    raise OptionError(f"{n_markers} markers: no dictionary has more than {n}; take fewer squares")


def _print_box(request: BoardRequest, yaml: Path) -> tuple[list[PdfPage], list[str]]:
    """Write the file of a box; return its pages and notes."""
    plan = BoxPlan(
        width=request.width_mm / _MM,
        height=request.height_mm / _MM,
        depth=request.depth_mm / _MM,
        marker=(request.marker_mm or 48.0) / _MM,
        family=request.dictionary or "DICT_APRILTAG_36h11",
        first_id=request.first_id,
    )
    rooms = [paper.room_mm for paper in papers(request.paper)]
    markers, patches = box_patches(plan, [(x / _MM, y / _MM) for x, y in rooms])
    pages = [_patch_page(request, plan, patch) for patch in patches]
    save_markers(markers, yaml)
    return pages, [
        "cut along the lines and glue each sheet where its caption says, upright as seen from "
        "inside; the box needs no other pattern",
        "measure the box: where a sheet lies elsewhere, correct the corners and planes in the file",
    ]


def _patch_page(request: BoardRequest, plan: BoxPlan, patch: SheetPatch) -> PdfPage:
    """Return the page of one sheet of markers for a plane of the box."""
    width, height = _MM * patch.size[0], _MM * patch.size[1]
    paper = best_paper(request.paper, width, height, f"a sheet of plane {patch.plane}")
    rectangles = [
        _MM * marker_rectangles(plan.family, number, corner, plan.marker)
        for number, corner in zip(patch.ids, patch.corners, strict=True)
    ]
    left, top = _MM * patch.offset[0], _MM * patch.offset[1]
    caption = (
        f"aqualvs box: plane {patch.plane}; top-left corner {left:.1f} mm from its left edge and "
        f"{top:.1f} mm from its top edge; markers of {_MM * plan.marker:g} mm, "
        f"ids {min(patch.ids)}-{max(patch.ids)}"
    )
    black = np.concatenate([*rectangles, outline(0.0, 0.0, width, height)])
    return sheet(paper, black, (width, height), caption)


def _print_plate(request: BoardRequest, yaml: Path) -> tuple[list[PdfPage], list[str]]:
    """Write the file of a plate; return its page and notes."""
    columns, rows = request.squares_x or 3, request.squares_y or 2
    size = request.marker_mm or 12.0
    family, count = request.dictionary or "DICT_APRILTAG_36h11", columns * rows
    n_ids = len(aruco_dictionary(family).bytesList)
    if request.first_id < 0 or request.first_id + count > n_ids:
        raise OptionError(
            f"--first-id {request.first_id}: {count} markers from there, but {family} has ids 0 to "
            f"{n_ids - 1}; begin lower or print fewer"
        )
    # Corners (M, 4, 2) of the markers, row by row, from the first one's top left; y down.
    column, row = np.meshgrid(np.arange(columns), np.arange(rows))
    first = (1.0 + _PLATE_GAP_SHARE) * size * np.stack([column.ravel(), row.ravel()], axis=-1)
    corners = first[:, None, :] + size * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    border = _PLATE_GAP_SHARE * size if request.border_mm is None else request.border_mm
    width, height = corners.reshape(-1, 2).max(axis=0) + 2.0 * border
    paper = best_paper(request.paper, width, height, "the plate")
    ids = request.first_id + np.arange(count, dtype=np.int64)
    rectangles = [
        marker_rectangles(family, int(number), corner[0] + border, size)
        for number, corner in zip(ids, corners, strict=True)
    ]
    black = np.concatenate([*rectangles, outline(0.0, 0.0, width, height)])
    what = f"{columns} x {rows} markers of {size:g} mm, {family}, ids {ids[0]}-{ids[-1]}"
    save_markers(_plate_markers(request, family, ids, corners / _MM), yaml)
    page = sheet(paper, black, (float(width), float(height)), f"aqualvs plate: {what}")
    return [page], _plate_notes(request, yaml)


def _plate_markers(
    request: BoardRequest, family: str, ids: IntArray, flat: FloatArray
) -> MarkerSet:
    """Return the markers with flat corners (M, 4, 2), in metres, in the plate's or dome's frame."""
    corners: FloatArray = np.concatenate([flat, np.zeros((*flat.shape[:2], 1))], axis=-1)
    frame = "plate"
    if request.position_mm is not None:
        rotation = rotation_from_rotvec(np.deg2rad(request.rotation_deg)) @ DOME_FROM_CAM_NOMINAL
        corners = SE3(rotation, np.array(request.position_mm) / _MM).apply(corners)
        frame = "dome"
    return MarkerSet(
        frame=frame, family=family, ids=ids, corners=corners, plane_names=(None,) * len(ids)
    )


def _plate_notes(request: BoardRequest, yaml: Path) -> list[str]:
    fix = "fix the plate where the camera sees it sharp, off the middle, beside the lasers"
    if request.position_mm is not None:
        return [fix, f"{yaml} has the corners in the dome's frame, at the position given"]
    return [
        fix,
        f"{yaml} does not have the plate's position yet; measure where the top-left corner of "
        f"marker {request.first_id} is in the dome's frame, and print again with --position-mm "
        "X Y Z (and --rotation-deg if the plate does not face straight back)",
    ]
