"""Detection of a board or of markers in a picture, to a few hundredths of a pixel.

The result is a `View`, or a clause that says why there is none: what the picture shows instead
(other markers, another board) and what may help.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from aqualvs.calibration.detection.boards import (
    Markers,
    agreed_corners,
    find_charuco,
    find_chessboard,
    read_markers,
)
from aqualvs.calibration.detection.saddle_corners import GreyImage
from aqualvs.calibration.detection.tag_corners import refine_tags
from aqualvs.calibration.targets.targets import DICTIONARIES, Board, BoardKind, MarkerSet, View

MIN_CORNERS = 6
"""Least number of corners that determines a pose and reveals wrong corners."""
# A single marker of a small dictionary is often a false detection in clutter.
_ENOUGH = 4
# The small dictionaries are the first markers of their large ones, ArUco's 36H12 aside.
_LARGEST = tuple(name for name in DICTIONARIES if not name.endswith(("_50", "_100", "_250")))


def _why_no_board(image: GreyImage, board: Board, n_corners: int) -> str:
    """Return one clause on the reason why there is no view of a board."""
    if n_corners > 0:
        return (
            f"too few corners of the board ({n_corners}, at least {MIN_CORNERS} are needed); show "
            "more of it, or come nearer"
        )
    if board.kind is BoardKind.CHESSBOARD:
        n_x, n_y = board.corner_grid
        return (
            f"no chessboard of {n_x} x {n_y} inner corners; it must be seen whole, with a light "
            "border, or the number of squares is wrong"
        )
    markers = read_markers(image, board.dictionary)
    if len(markers) < _ENOUGH:
        return _no_markers(image, board.dictionary, len(markers))
    read = f"{len(markers)} markers of {board.dictionary}"
    counts = [
        (agreed_corners(markers, other).n_agreed, remedy) for other, remedy in _other_boards(board)
    ]
    most, remedy = max(counts, key=lambda count: count[0])
    if agreed_corners(markers, board).n_agreed >= max(_ENOUGH, most + 1):
        return f"{read}, but many are misread; come nearer, or take a sharper picture"
    if most >= _ENOUGH:
        return f"{read}, but not as on this board; {remedy}"
    remedy = "check its squares, marker_mm and dictionary"
    for name in _LARGEST:
        if name != board.dictionary and not _differs(name, board.dictionary):
            n_all = len(read_markers(image, name))
            if n_all >= len(markers) + _ENOUGH:
                remedy = f"{n_all} are of {name}: is it the file of another board?"
    return f"{read}, but not as on this board ({_ids(markers)}); {remedy}"


def _other_boards(board: Board) -> Iterator[tuple[Board, str]]:
    """Return boards that a mistake in the file may have meant, with the remedy."""
    if board.squares[1] % 2 == 0:
        other = replace(board, legacy_pattern=not board.legacy_pattern)
        yield other, f"write 'legacy_pattern: {str(other.legacy_pattern).lower()}'"
    # Difference in the number of squares, each way, that a board file may have by mistake.
    other_counts = 3
    for step in range(-other_counts, other_counts + 1):
        n_x = board.squares[0] + step
        if step and n_x >= 3:
            # The dictionary limits the number of markers; fewer rows suffice for the comparison.
            n_y = max(3, min(board.squares[1], 2 * board.n_markers // n_x))
            yield replace(board, squares=(n_x, n_y)), f"it looks as if squares_x were {n_x}"


def _why_no_markers(
    image: GreyImage, marker_set: MarkerSet, markers: Markers, n_corners: int
) -> str:
    """Return one clause on the reason why there is no view of a set of markers.

    `markers` are all of its family that were read; `n_corners` corners were refined.
    """
    ours = np.isin(markers.ids, marker_set.ids)
    if np.any(ours):
        return (
            f"{np.count_nonzero(ours)} of the markers, but too few clean corners ({n_corners}, at "
            f"least {MIN_CORNERS} are needed); come nearer, or keep stripes and glare off them"
        )
    if len(markers) > 0:
        return (
            f"{len(markers)} markers of {marker_set.family}, but none of the file's "
            f"({_ids(markers)}); check the ids"
        )
    return _no_markers(image, marker_set.family, 0)


def _no_markers(image: GreyImage, dictionary: str, n_read: int) -> str:
    for name in _LARGEST:
        if name == dictionary:
            continue
        n_other = len(read_markers(image, name))
        # A large dictionary holds the markers of the small ones of its family, too.
        n_more = 1 if _differs(name, dictionary) else _ENOUGH
        if n_other >= max(_ENOUGH, n_read + n_more):
            return (
                f"{n_other} markers of {name}, not of {dictionary}; check the dictionary, and "
                "that the file is that of this target"
            )
    what = f"no markers of {dictionary}"
    if n_read > 0:
        what = f"too few markers of {dictionary} ({n_read})"
    return f"{what}; is the target in the picture, sharp and large enough?"


def _differs(name: str, dictionary: str) -> bool:
    """Return whether names differ in family: DICT_4X4_50 is the start of DICT_4X4_1000."""
    return name.split("_")[:2] != dictionary.split("_")[:2] or "APRILTAG" in name


def _ids(markers: Markers) -> str:
    shown = ", ".join(str(number) for number in sorted(markers.ids)[:5])
    return f"read: {shown}{', ...' if len(markers) > 5 else ''}"


def detect_board(image: GreyImage, board: Board, name: str) -> View | str:
    """Find the inner corners of a board in a grey picture, which messages call `name`.

    A ChArUco board may be seen in part, a chessboard only whole. Points of the view are in `board`,
    ids count the inner corners row by row. With fewer than `MIN_CORNERS` corners the reason is
    returned instead, in a clause.
    """
    find = find_charuco if board.kind is BoardKind.CHARUCO else find_chessboard
    grid = find(image, board)
    if grid.n_known < MIN_CORNERS:
        return _why_no_board(image, board, grid.n_known)
    ids = np.flatnonzero(grid.known).astype(np.int64)
    return View(name, ids, board.corner_points()[ids], grid.pixels.reshape(-1, 2)[ids], grid.notes)


def detect_markers(image: GreyImage, marker_set: MarkerSet, name: str) -> View | str:
    """Find the corners of the markers of a set in a grey picture, which messages call `name`.

    Other markers of the family are ignored. Points of the view are in the set's frame, ids are four
    times the index in the set plus the corner's place. Corners that could not be refined cleanly,
    under a laser stripe for example, are missing. With fewer than `MIN_CORNERS` corners the reason
    is returned instead, in a clause.
    """
    markers = read_markers(image, marker_set.family)
    index = {int(number): i for i, number in enumerate(marker_set.ids)}
    ours = np.isin(markers.ids, marker_set.ids)
    tags = refine_tags(image, markers.ids[ours], markers.corners[ours], marker_set.family)
    places = np.array([index[int(number)] for number in markers.ids[ours]], np.int64)
    ids = (4 * places[:, None] + np.arange(4))[tags.valid]
    if len(ids) < MIN_CORNERS:
        return _why_no_markers(image, marker_set, markers, len(ids))
    order = np.argsort(ids, kind="stable")
    return View(name, ids[order], marker_set.points()[ids[order]], tags.pixels[tags.valid][order])
