"""Calibration targets, boards and markers at known places, and views of them.

A `View` is the known points of a target that were found in one picture, with their pixels.

Frame `board` is OpenCV's: x right, y down, z into the board, origin at the outer corner of the
top-left square. Lengths in metres.
"""

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import cv2
import numpy as np

from aqualvs.errors import CalibrationError
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.planes import Plane


@dataclass(frozen=True, slots=True)
class View:
    """View of a target: its points found in one picture."""

    name: str  # File name of the picture, for messages and reports.
    # Shape (N,): points of the target: corner of a board, or four times the index of a marker plus
    # the corner's place.
    ids: IntArray
    # Shape (N, 3): the points in the target's own frame (`board`, `box`, or `dome` for an index
    # target), in metres.
    points: FloatArray
    # Shape (N, 2): their measured places, in `image`.
    pixels: FloatArray
    # Remarks for the user on the detection.
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.ids)

    @property
    def middle(self) -> FloatArray:
        """Mean (3,) of the points, the centre of small turns of the target."""
        middle: FloatArray = np.add.reduce(self.points) / len(self.points)
        return middle

    def where(self, keep: BoolArray) -> "View":
        """Return the points that `keep` (N,) marks."""
        return replace(self, ids=self.ids[keep], points=self.points[keep], pixels=self.pixels[keep])


DICTIONARIES: dict[str, int] = {
    name: getattr(cv2.aruco, name)
    for name in sorted(dir(cv2.aruco))
    # OpenCV accepts an older spelling of the AprilTag families, 36h11 for 36H11 and the like.
    if name.startswith("DICT_") and name.replace("h", "H") == name
}
"""Marker dictionaries by name; `dictionary_id` knows further spellings of AprilTag families."""


def check_enough(views: Sequence[View], n_needed: int, what: str, good: str) -> None:
    """Refuse too few pictures of a board, or too few corners in them.

    `what`, `good`: what is calibrated, and what makes it good, in words. Raises `CalibrationError`.
    """
    if len(views) < n_needed:
        raise CalibrationError(
            f"pictures that show the board: {len(views)}; the {what} needs {n_needed} at least, "
            f"and {good} to be good"
        )
    points = sum(len(view) for view in views)
    min_points = 60
    if points < min_points:
        raise CalibrationError(
            f"board corners in all pictures together: {points}; the {what} needs {min_points} at "
            "least; show more of the board, or more often"
        )


def dictionary_id(name: str) -> int | None:
    """Return OpenCV's number of a marker dictionary, None for a name it does not know."""
    return DICTIONARIES.get(name.replace("h", "H"))


def dictionary_hint(name: str) -> str:
    """Return what to write instead of an unknown name of a marker dictionary."""
    written = name.upper().replace("-", "_")
    if not written.startswith("DICT_"):
        written = f"DICT_{written}"
    # AprilTag's own names are such as tag36h11.
    written = written.replace("DICT_TAG", "DICT_APRILTAG_")
    # Share of letters in common from which a name is taken for a misspelling.
    alike = 0.85
    if close := difflib.get_close_matches(written, DICTIONARIES, n=1, cutoff=alike):
        return f"did you mean {close[0]}?"
    others = [one for one in DICTIONARIES if one.split("_")[1] in ("APRILTAG", "ARUCO")]
    return (
        "use DICT_4X4_N, DICT_5X5_N, DICT_6X6_N or DICT_7X7_N with N = 50, 100, 250 or 1000, or "
        f"one of {', '.join(others)}"
    )


class BoardKind(StrEnum):
    """Kind of pattern on a board."""

    CHESSBOARD = "chessboard"
    """Squares alone; it must be seen whole."""
    CHARUCO = "charuco"
    """Squares with a marker in each light one; a part of it is enough."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Board:
    """A flat board of squares.

    Raises `CalibrationError` if such a board is impossible.
    """

    kind: BoardKind  # Chessboard or ChArUco.
    # Number of squares along x and y. Points are the inner corners, one less each way.
    squares: tuple[int, int]
    # Side of a square, in metres.
    square: float
    # Side of a marker, in metres; 0 on a chessboard.
    marker: float = 0.0
    # Name of the markers' dictionary; empty on a chessboard.
    dictionary: str = ""
    # Light border around the squares, in metres.
    border: float = 0.0
    # ChArUco pattern of OpenCV before 4.6: with an even number of rows its first square is light.
    legacy_pattern: bool = False

    def __post_init__(self) -> None:
        if min(self.squares) < 3:
            raise CalibrationError(f"a board of {_by(self.squares)} squares; it needs 3 each way")
        if not (self.square > 0.0 and self.border >= 0.0):
            raise CalibrationError(
                f"a board with squares of {_mm(self.square)} and a border of {_mm(self.border)}; "
                "lengths must be positive"
            )
        if self.kind is not BoardKind.CHARUCO:
            return
        if not 0.0 < self.marker < self.square:
            raise CalibrationError(
                f"markers of {_mm(self.marker)} on squares of {_mm(self.square)}; a marker is "
                "smaller than its square"
            )
        held = len(aruco_dictionary(self.dictionary).bytesList)
        if self.n_markers > held:
            raise CalibrationError(
                f"a board of {_by(self.squares)} squares has {self.n_markers} markers, but "
                f"{self.dictionary} only {held}; check the squares or take a larger dictionary"
            )

    @property
    def corner_grid(self) -> tuple[int, int]:
        """Number of inner corners along x and y."""
        return self.squares[0] - 1, self.squares[1] - 1

    @property
    def n_corners(self) -> int:
        """Number of inner corners, which are the board's points."""
        return self.corner_grid[0] * self.corner_grid[1]

    @property
    def n_markers(self) -> int:
        """Number of markers, one in each light square; 0 on a chessboard."""
        # With an odd number of squares the first is dark, so the extra one carries no marker.
        has_markers = self.kind is BoardKind.CHARUCO
        return self.squares[0] * self.squares[1] // 2 if has_markers else 0

    @property
    def first_is_light(self) -> bool:
        """True if the top-left square is light."""
        return self.legacy_pattern and self.squares[1] % 2 == 0

    @property
    def margin_share(self) -> float:
        """Light margin around a marker as a share of the square; 1 on a chessboard."""
        if self.kind is not BoardKind.CHARUCO:
            return 1.0
        return 0.5 * (1.0 - self.marker / self.square)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the squares without the border, in metres."""
        return self.squares[0] * self.square, self.squares[1] * self.square

    def corner_points(self) -> FloatArray:
        """Return the inner corners (N, 3) in `board`, metres; row by row from the top left."""
        n_x, n_y = self.corner_grid
        x, y = np.meshgrid(np.arange(1, n_x + 1), np.arange(1, n_y + 1))
        corners: FloatArray = np.stack([x.ravel(), y.ravel(), np.zeros(n_x * n_y)], axis=-1)
        return self.square * corners

    def marker_squares(self) -> IntArray:
        """Return columns and rows (M, 2) of the light squares of markers 0 to M - 1."""
        column, row = np.meshgrid(np.arange(self.squares[0]), np.arange(self.squares[1]))
        light = (column + row) % 2 == (0 if self.first_is_light else 1)
        return np.stack([column[light], row[light]], axis=-1).astype(np.int64)

    def light_beyond_corners(self) -> BoolArray:
        """Return the mask (N,) of inner corners with a light square towards +x, +y."""
        n_x, n_y = self.corner_grid
        i = np.arange(n_x * n_y)
        light: BoolArray = (i % n_x + i // n_x) % 2 == (0 if self.first_is_light else 1)
        return light

    def marker_points(self) -> FloatArray:
        """Return the markers' corners (M, 4, 3) in `board`, metres, in OpenCV's order."""
        corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        margin = 0.5 * (self.square - self.marker)
        flat = (
            self.square * self.marker_squares()[:, None, :].astype(np.float64)
            + margin
            + self.marker * corners
        )
        return np.concatenate([flat, np.zeros((*flat.shape[:2], 1))], axis=-1)

    def describe(self) -> str:
        """Return a short description for messages."""
        what = f"{self.kind} of {_by(self.squares)} squares of {_mm(self.square)}"
        return f"{what}, {self.dictionary}" if self.dictionary else what


@dataclass(frozen=True, slots=True, kw_only=True)
class MarkerSet:
    """Markers at known places: in a box, or on a plate fixed to the vehicle."""

    frame: str  # Frame of the corners: `box`, or `dome` for an index target.
    family: str  # Name of the markers' dictionary.
    ids: IntArray  # Shape (M,): number of each marker in its dictionary.
    # Shape (M, 4, 3): in `frame`, metres; top-left, top-right, bottom-right, bottom-left of the
    # upright marker.
    corners: FloatArray
    # Length M: plane of each marker.
    plane_names: tuple[str | None, ...]
    # The planes that carry markers, in `frame`.
    planes: dict[str, Plane] = field(default_factory=dict)

    def __len__(self) -> int:
        """Return the number of markers."""
        return len(self.ids)

    def points(self) -> FloatArray:
        """Return all corners (4 M, 3); their row is the id in `View.ids` of a marker view."""
        return self.corners.reshape(-1, 3)


def aruco_dictionary(name: str) -> cv2.aruco.Dictionary:
    """Return OpenCV's dictionary of that name.

    Raises `CalibrationError` if OpenCV does not know it.
    """
    number = dictionary_id(name)
    if number is None:
        raise CalibrationError(f"dictionary {name!r} is unknown; {dictionary_hint(name)}")
    return cv2.aruco.getPredefinedDictionary(number)


def _mm(length: float) -> str:
    return f"{1e3 * length:g} mm"


def _by(counts: tuple[int, int]) -> str:
    return f"{counts[0]} x {counts[1]}"
