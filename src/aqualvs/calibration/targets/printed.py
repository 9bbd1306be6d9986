"""Printed targets: black areas of boards and markers, layout on sheets of paper, PDF to scale.

- `board_rectangles` and `marker_rectangles`: the black areas, to print or to render.
- `box_patches`: the markers of a calibration box (paper, 3.3), four planes cut into sheets of
  paper. Frame `box`: origin at the middle of the open mouth, x right, y forward, z up.
- `papers` and `sheet`: sizes of paper, and a page with a ruler of 100 mm and a caption.
- `pdf_bytes`: a true-to-scale PDF of black rectangles and small text, all that printed targets
  need. Lengths are millimetres from a page's top-left corner, x right, y down. All rectangles of a
  page are one path, so that no viewer shows seams between neighbours; the file asks viewers not to
  scale it.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from aqualvs.calibration.detection.tag_corners import marker_cells
from aqualvs.calibration.targets.targets import Board, BoardKind, MarkerSet, aruco_dictionary
from aqualvs.errors import CalibrationError, OptionError
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.planes import Plane


@dataclass(frozen=True, slots=True, kw_only=True)
class BoxPlan:
    """A marker box, open towards the vehicle and at its top."""

    # Inside, along x, z and y, in metres.
    width: float
    height: float
    depth: float
    # Side of a marker, in metres.
    marker: float
    # Name of the markers' dictionary.
    family: str
    # Number of the first marker; the others follow.
    first_id: int = 0


@dataclass(frozen=True, slots=True)
class SheetPatch:
    """Part of a plane that one sheet of paper covers."""

    plane: str  # Name of its plane.
    # From the plane's top-left corner to its own, right and down as seen from inside, in metres.
    offset: tuple[float, float]
    # Width and height, in metres.
    size: tuple[float, float]
    # Numbers of its markers.
    ids: tuple[int, ...]
    # Shape (M, 2): top-left corners of the markers, from the patch's own, in metres.
    corners: FloatArray


class _Wall(NamedTuple):
    """Wall of the box with axes right and down as seen from inside; `origin` is its top left."""

    plane: Plane
    origin: FloatArray
    right: FloatArray
    down: FloatArray
    size: tuple[float, float]


def box_patches(
    plan: BoxPlan, rooms: Sequence[tuple[float, float]]
) -> tuple[MarkerSet, tuple[SheetPatch, ...]]:
    """Return a box's markers, and the patches in which they can be printed.

    `rooms`: printable width and height of a sheet of paper, in metres: upright and across. Infinite
    for sheets as large as a plane. Raises `CalibrationError` if a plane or a sheet is too small for
    a marker, or the dictionary has too few.
    """
    # Pitch of markers, in sides of a marker: leaves a light ring and room for stripes to cross.
    sides_apart = 1.7
    pitch = sides_apart * plan.marker
    _check(plan, pitch, rooms)
    ids: list[int] = []
    corners: list[FloatArray] = []
    names: list[str] = []
    patches: list[SheetPatch] = []
    walls = _walls(plan)
    for name, wall in walls.items():
        placed = _grid(wall, pitch, plan.marker)
        numbers = plan.first_id + len(ids) + np.arange(placed[..., 0].size)
        patches += _patches(name, placed, numbers, pitch, plan.marker, rooms)
        ids += numbers.tolist()
        unit = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        flat = placed.reshape(-1, 1, 2) + plan.marker * unit
        corners.append(wall.origin + flat[..., :1] * wall.right + flat[..., 1:] * wall.down)
        names += [name] * len(numbers)
    held = len(aruco_dictionary(plan.family).bytesList)
    if plan.first_id < 0 or ids[-1] >= held:
        raise CalibrationError(
            f"a box with markers {plan.first_id} to {ids[-1]}, but {plan.family} has ids 0 to "
            f"{held - 1}; take larger markers or a smaller box"
        )
    markers = MarkerSet(
        frame="box",
        family=plan.family,
        ids=np.array(ids, np.int64),
        corners=np.concatenate(corners),
        plane_names=tuple(names),
        planes={name: wall.plane for name, wall in walls.items()},
    )
    return markers, tuple(patches)


def _check(plan: BoxPlan, pitch: float, rooms: Sequence[tuple[float, float]]) -> None:
    smallest = min(plan.width, plan.height, plan.depth)
    if not (plan.marker > 0.0 and smallest >= pitch):
        raise CalibrationError(
            f"a box with a side of {1e3 * smallest:g} mm for markers of {1e3 * plan.marker:g} mm, "
            f"which take {1e3 * pitch:g} mm each; take smaller markers"
        )
    room = max(min(room) for room in rooms)
    if room < pitch:
        raise CalibrationError(
            f"markers of {1e3 * plan.marker:g} mm take {1e3 * pitch:g} mm each, but a sheet has "
            f"only {1e3 * room:g} mm; take larger paper or smaller markers"
        )


def _walls(plan: BoxPlan) -> dict[str, _Wall]:
    x, y, z = np.eye(3)
    left, deep, low = -0.5 * plan.width * x, plan.depth * y, -0.5 * plan.height * z
    side = (plan.depth, plan.height)
    return {
        "forward": _Wall(Plane(y, plan.depth), left + deep - low, x, -z, (plan.width, plan.height)),
        "left": _Wall(Plane(x, -0.5 * plan.width), left - low, y, -z, side),
        "right": _Wall(Plane(x, 0.5 * plan.width), deep - left - low, -y, -z, side),
        "down": _Wall(
            Plane(z, -0.5 * plan.height), left + deep + low, x, -y, (plan.width, plan.depth)
        ),
    }


def _grid(wall: _Wall, pitch: float, marker: float) -> FloatArray:
    """Return the top-left corners (rows, columns, 2) of the markers, in the middle of the wall."""
    counts = [int(side / pitch + 1e-9) for side in wall.size]
    starts = [
        0.5 * (side - n * pitch) + 0.5 * (pitch - marker)
        for side, n in zip(wall.size, counts, strict=True)
    ]
    across, below = (start + pitch * np.arange(n) for start, n in zip(starts, counts, strict=True))
    return np.stack(np.meshgrid(across, below), axis=-1)


def _patches(
    name: str,
    placed: FloatArray,
    numbers: IntArray,
    pitch: float,
    marker: float,
    rooms: Sequence[tuple[float, float]],
) -> list[SheetPatch]:
    """Cut a wall's grid into the fewest blocks of whole cells that fit a sheet."""
    rows, columns = placed.shape[:2]
    numbers = numbers.reshape(rows, columns)
    # Numbers of rows and columns of cells on a sheet.
    ways = [
        (int(min(high / pitch + 1e-9, rows)), int(min(wide / pitch + 1e-9, columns)))
        for wide, high in rooms
        if min(wide, high) >= pitch
    ]
    n_down, n_across = min(ways, key=lambda way: -(-rows // way[0]) * -(-columns // way[1]))
    inset = 0.5 * (pitch - marker)
    patches = []
    for i in range(0, rows, n_down):
        for j in range(0, columns, n_across):
            block = placed[i : i + n_down, j : j + n_across]
            corner = block[0, 0] - inset
            patches.append(
                SheetPatch(
                    name,
                    (float(corner[0]), float(corner[1])),
                    (block.shape[1] * pitch, block.shape[0] * pitch),
                    tuple(numbers[i : i + n_down, j : j + n_across].ravel().tolist()),
                    block.reshape(-1, 2) - corner,
                )
            )
    return patches


def board_rectangles(board: Board) -> FloatArray:
    """Return x, y, width, height (N, 4) of a board's black areas, in `board`, metres."""
    n_x, n_y = board.squares
    column, row = np.meshgrid(np.arange(n_x), np.arange(n_y))
    dark = (column + row) % 2 == (1 if board.first_is_light else 0)
    corner = board.square * np.stack([column[dark], row[dark]], axis=-1).astype(np.float64)
    squares = np.concatenate([corner, np.full_like(corner, board.square)], axis=-1)
    if board.kind is BoardKind.CHESSBOARD:
        return squares
    markers = [
        marker_rectangles(board.dictionary, number, points[0, :2], board.marker)
        for number, points in enumerate(board.marker_points())
    ]
    return np.concatenate([squares, *markers])


def marker_rectangles(family: str, number: int, corner: FloatArray, size: float) -> FloatArray:
    """Return x, y, width, height (N, 4) of the black areas of a dictionary's marker.

    `corner` (2,) is its top left, `size` its side, in one unit.
    """
    cells = marker_cells(family, number)[1:-1, 1:-1]
    cell = size / len(cells)
    rectangles = []
    for row, values in enumerate(cells):
        # Runs of dark cells; light cells at both ends close the runs.
        edges = np.flatnonzero(np.diff(np.concatenate([[1.0], values, [1.0]])))
        for first, after in edges.reshape(-1, 2):
            x, y = corner + cell * np.array([first, row])
            rectangles.append([x, y, cell * (after - first), cell])
    return np.array(rectangles)


_POINTS_PER_MM = 72.0 / 25.4


@dataclass(frozen=True, slots=True)
class Text:
    """A line of Helvetica."""

    # Start of its base line, in millimetres.
    x: float
    y: float
    # Size of the font (em), in millimetres.
    size: float
    # The text, in Latin letters.
    words: str


@dataclass(frozen=True, slots=True)
class PdfPage:
    """Page of the PDF file."""

    # In millimetres.
    width: float
    height: float
    # Shape (N, 4): x, y, width, height of black rectangles, in millimetres.
    rectangles: FloatArray
    texts: tuple[Text, ...] = ()


def pdf_bytes(pages: Sequence[PdfPage], title: str) -> bytes:
    """Return a PDF file of these pages; the same pages give the same bytes."""
    kids = " ".join(f"{4 + 2 * i} 0 R" for i in range(len(pages)))
    objects = [
        "<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        f"<< /Type /Pages /Kids [{kids}] /Count {len(pages)} >>",
        "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
    ]
    for i, page in enumerate(pages):
        width, height = page.width * _POINTS_PER_MM, page.height * _POINTS_PER_MM
        objects.append(
            f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.4f} {height:.4f}] "
            f"/Resources << /Font << /F 3 0 R >> >> /Contents {5 + 2 * i} 0 R >>"
        )
        content = _content(page)
        objects.append(f"<< /Length {len(_encoded(content))} >>\nstream\n{content}\nendstream")
    objects.append(f"<< /Title ({_escaped(title)}) /Producer (aqualvs) >>")
    return _file(objects)


def _content(page: PdfPage) -> str:
    """Return the PDF content stream of a page; coordinates are millimetres, y down."""
    scale = f"{_POINTS_PER_MM:.8f}"
    height = f"{page.height * _POINTS_PER_MM:.4f}"
    lines = [f"{scale} 0 0 -{scale} 0 {height} cm", "0 g"]
    lines += [" ".join(f"{value:.4f}" for value in row) + " re" for row in page.rectangles]
    lines.append("f")
    for text in page.texts:
        place = f"1 0 0 -1 {text.x:.4f} {text.y:.4f} Tm"
        lines.append(f"BT /F {text.size:.3f} Tf {place} ({_escaped(text.words)}) Tj ET")
    return "\n".join(lines)


def _escaped(words: str) -> str:
    return words.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")


def _encoded(text: str) -> bytes:
    return text.encode("cp1252", errors="replace")


def _file(objects: Sequence[str]) -> bytes:
    """Return a PDF file of these objects; the last one is the document information."""
    body = b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n"
    places = []
    for i, text in enumerate(objects):
        places.append(len(body))
        body += f"{i + 1} 0 obj\n".encode() + _encoded(text) + b"\nendobj\n"
    table = "".join(f"{place:010d} 00000 n \n" for place in places)
    n = len(objects) + 1
    end = (
        f"xref\n0 {n}\n0000000000 65535 f \n{table}trailer\n"
        f"<< /Size {n} /Root 1 0 R /Info {n - 1} 0 R >>\nstartxref\n{len(body)}\n%%EOF\n"
    )
    return body + end.encode()


PAPERS_MM: dict[str, tuple[float, float]] = {
    "a4": (210.0, 297.0),
    "a3": (297.0, 420.0),
    "a2": (420.0, 594.0),
    "a1": (594.0, 841.0),
    "a0": (841.0, 1189.0),
    "letter": (215.9, 279.4),
}
"""Width and height of papers, upright."""

FIT = "fit"
"""Paper that is cut to the size of the print."""


class _PrintLayout(NamedTuple):
    """Layout of a printed target, in millimetres of paper."""

    edge_mm: float = 8.0  # Margin that printers leave white.
    # Strip below the print for ruler and caption.
    strip_mm: float = 14.0
    ruler_mm: float = 100.0
    hair_mm: float = 0.2


_PRINT = _PrintLayout()


@dataclass(frozen=True, slots=True)
class Paper:
    """Sheet of paper in one of its two orientations."""

    size_mm: tuple[float, float] | None  # Width and height; None for paper that fits.

    @property
    def room_mm(self) -> tuple[float, float]:
        """Printable width and height, less the ruler's strip."""
        width, height = self.size_mm or (np.inf, np.inf)
        return width - 2.0 * _PRINT.edge_mm, height - 2.0 * _PRINT.edge_mm - _PRINT.strip_mm


def papers(word: str) -> tuple[Paper, Paper]:
    """Return a paper upright and across.

    `word`: "a4", "a3" and so on, "fit", or width x height in millimetres, such as "600x400". Raises
    `OptionError` if it is none of these.
    """
    key = word.strip().lower()
    if key == FIT:
        return Paper(None), Paper(None)
    if key in PAPERS_MM:
        width, height = PAPERS_MM[key]
        return Paper((width, height)), Paper((height, width))
    match = re.fullmatch(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)", key)
    if match is None:
        raise OptionError(
            f"--paper {word}: not known; use {', '.join(PAPERS_MM)}, {FIT}, or millimetres such as "
            "600x400"
        )
    width, height = float(match[1]), float(match[2])
    if min(width, height) < _PRINT.ruler_mm + 2.0 * _PRINT.edge_mm:
        raise OptionError(
            f"--paper {word}: too small for the ruler of 100 mm; take at least 116x116"
        )
    return Paper((width, height)), Paper((height, width))


def best_paper(word: str, width: float, height: float, what: str) -> Paper:
    """Return the orientation that has room for a print of this size, in millimetres.

    Raises `OptionError` if neither has.
    """
    for paper in papers(word):
        room = paper.room_mm
        if width <= room[0] + 1e-6 and height <= room[1] + 1e-6:
            return paper
    raise OptionError(
        f"--paper {word}: {what} measures {width:g} x {height:g} mm and does not fit with its "
        f"ruler; take larger paper, '--paper {FIT}' for a print shop, or smaller squares"
    )


def sheet(paper: Paper, rectangles: FloatArray, size: tuple[float, float], words: str) -> PdfPage:
    """Return a page with a print in its middle, a ruler to check the scale, and a caption.

    `rectangles` (N, 4): x, y, width, height of the black areas, from the print's top left. `size`:
    width and height of the print, light border included. All in millimetres.
    """
    edge = _PRINT.edge_mm
    if paper.size_mm is None:
        width = max(size[0], _PRINT.ruler_mm + 60.0) + 2.0 * edge
        height, top = size[1] + 2.0 * edge + _PRINT.strip_mm, edge
    else:
        width, height = paper.size_mm
        top = 0.5 * (height - _PRINT.strip_mm - size[1])
    left = 0.5 * (width - size[0])
    placed = rectangles + np.array([left, top, 0.0, 0.0])
    ruler_y = height - edge - 8.0
    scale = "the line above measures exactly 100 mm: print at 100 %, without fitting to the page"
    text_mm = 3.2
    texts = (
        Text(edge, height - edge - 4.2, text_mm, words),
        Text(edge, height - edge, text_mm, scale),
    )
    return PdfPage(width, height, np.concatenate([placed, ruler(edge, ruler_y)]), texts)


def ruler(x: float, y: float) -> FloatArray:
    """Return the rectangles (N, 4) of a ruler of 100 mm, with a tick every 10 mm."""
    ticks = np.arange(0.0, _PRINT.ruler_mm + 1.0, 10.0)
    high = np.where(ticks % 50.0 == 0.0, 4.0, 2.5)
    # The outer edges of the first and the last tick are 100 mm apart.
    lefts = x + ticks - _PRINT.hair_mm * ticks / _PRINT.ruler_mm
    marks = np.stack([lefts, y - high, np.full_like(ticks, _PRINT.hair_mm), high], axis=-1)
    return np.concatenate([marks, [[x, y - _PRINT.hair_mm, _PRINT.ruler_mm, _PRINT.hair_mm]]])


def outline(x: float, y: float, width: float, height: float) -> FloatArray:
    """Return the rectangles (4, 4) of a hairline to cut along, in its middle."""
    hair, half = _PRINT.hair_mm, 0.5 * _PRINT.hair_mm
    return np.array(
        [
            [x - half, y - half, width + hair, hair],
            [x - half, y + height - half, width + hair, hair],
            [x - half, y + half, hair, height - hair],
            [x + width - half, y + half, hair, height - hair],
        ]
    )
