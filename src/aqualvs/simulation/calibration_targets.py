"""Targets of simulated calibration pictures: prints, files that describe them, and poses.

The poses are of boards before the bare camera and on a rail before the dome, of the vehicle before
a box of markers, and of a plate in the view.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL, Rig
from aqualvs.optics.sheet import sheets_of
from aqualvs.simulation.panels import Panel, PanelScene, RoomLight
from aqualvs.simulation.textures import (
    PAPER,
    CharucoPrint,
    MarkerPrint,
    Texture,
    charuco_texture,
    grid_corners,
    marker_texture,
    mottled,
)

Size = tuple[float, float]

# Places of the board's middle in the picture, from the top left, in turn.
_PLACES = (
    *((0.50, 0.50), (0.25, 0.28), (0.75, 0.30), (0.27, 0.72), (0.74, 0.72), (0.50, 0.25)),
    *((0.48, 0.78), (0.18, 0.50), (0.82, 0.52), (0.38, 0.40), (0.62, 0.60), (0.60, 0.38)),
)
# Middles of the quarters for a plate, slightly off those of the picture.
_QUARTERS = ((0.24, 0.75), (0.76, 0.75), (0.24, 0.25), (0.76, 0.25))
_GOLDEN = np.pi * (3.0 - np.sqrt(5.0))


def board_across(rig: Rig, size: Size, count: int, rng: np.random.Generator) -> list[SE3]:
    """Return `dome_from_board` of a board all over a bare camera's picture, mostly tilted.

    `rig`: the dome plays no part. `size`: width and height of the board's squares, in metres.
    """
    poses = []
    # Widths of the board as shares of the picture's, in turn.
    shares = (0.78, 0.52, 0.60, 0.48, 0.66, 0.56, 0.50, 0.62)
    for k in range(count):
        place = np.array(_PLACES[k % len(_PLACES)]) + rng.uniform(-0.03, 0.03, 2)
        far = size[0] * rig.lens.fx / (shares[k % len(shares)] * rig.size_px[0])
        ahead = rig.bare_camera().rays(place * rig.size_px - 0.5).directions
        ahead = rig.dome_from_cam.inverse().rotate(ahead)
        tilt = np.deg2rad(rng.uniform(20.0, 38.0) if k % 6 else 4.0)
        axis = np.array([np.cos(_GOLDEN * k), np.sin(_GOLDEN * k), 0.0])
        roll = rotation_from_rotvec([0.0, 0.0, np.deg2rad(rng.uniform(-25.0, 25.0))])
        turn = rotation_from_rotvec(tilt * axis) @ roll
        poses.append(rig.dome_from_cam @ _centred(turn, ahead / ahead[2] * far, size))
    return poses


def board_on_rail(
    size: Size, distances: FloatArray, rng: np.random.Generator
) -> tuple[list[SE3], list[float]]:
    """Return `dome_from_board` of a board that is carried along the dome's y axis.

    Every second one is off square, and rolled, by up to 1.5 degrees; all are slightly shifted.

    Parameters
    ----------
    size : (float, float)
        Width and height of the board's squares, in metres.
    distances : array, shape (N,)
        Of the board's middle, in metres.
    rng : Generator
        Random number generator.

    Returns
    -------
    poses : list of SE3
    measured : list of float
        Distance along the y axis to each board's plane, in metres.
    """
    poses, measured = [], []
    for k, distance in enumerate(distances):
        tilt = np.deg2rad(rng.uniform(-1.05, 1.05, 2) * (k % 2))
        roll = np.deg2rad(rng.uniform(-1.5, 1.5) * (k % 2))
        turn = DOME_FROM_CAM_NOMINAL @ rotation_from_rotvec([tilt[0], tilt[1], 0.0])
        turn = turn @ rotation_from_rotvec([0.0, 0.0, roll])
        middle = np.array([rng.uniform(-0.02, 0.02), distance, rng.uniform(-0.02, 0.02)])
        poses.append(_centred(turn, middle, size))
        normal = turn[:, 2]
        measured.append(float(normal @ middle / normal[1]))
    return poses, measured


def vehicle_in_box(count: int, rng: np.random.Generator) -> list[SE3]:
    """Return `box_from_dome` of a vehicle before the open mouth, looking to all sides in turn."""
    poses = []
    # Turn and tilt of the vehicle in the box, in degrees: to the left, upward, clockwise.
    looks = ((0.0, -3.0, 1.0), (12.0, -9.0, -2.0), (-10.0, -10.0, 2.0), (-3.0, -13.0, -1.0))
    for k in range(count):
        left, up, roll = np.deg2rad(np.array(looks[k % len(looks)]) + rng.uniform(-1, 1, 3))
        turn = rotation_from_rotvec([0.0, 0.0, left]) @ rotation_from_rotvec([up, 0.0, 0.0])
        place = np.array([0.0, -0.005, 0.03]) + rng.uniform(-0.012, 0.012, 3)
        poses.append(SE3(turn @ rotation_from_rotvec([0.0, roll, 0.0]), place))
    return poses


def _clearance(rig: Rig, pose: SE3, size: Size) -> float:
    """Return the distance of a rectangle from all sheets, in metres; negative if one crosses it."""
    corners = pose.apply(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) * [*size, 0.0])
    off = np.stack([sheet.signed_distance(corners) for sheet in sheets_of(rig)])
    return float(np.min(np.abs(off.sum(axis=1)) / 4.0 - np.ptp(off, axis=1) / 2.0))


def _centred(turn: FloatArray, middle: FloatArray, size: Size) -> SE3:
    """Return the pose of a rectangle whose origin is its top left, by its middle."""
    return SE3(turn, middle - turn @ np.array([0.5 * size[0], 0.5 * size[1], 0.0]))


FAMILY = "DICT_APRILTAG_36h11"


_CORNER_ORDER = (
    "as OpenCV reports: top-left, top-right, bottom-right, bottom-left of the upright marker"
)
_BOX_FRAME = (
    "origin at the middle of the open mouth, x right, y forward, z up, mm; plane: normal . X = d"
)
_DOME_FRAME = "dome (origin at the dome's centre, x right, y forward, z up), mm"


@dataclass(frozen=True, slots=True)
class Marked:
    """Panel with markers, in a frame of its own."""

    name: str  # Of its plane.
    panel: Panel  # In that frame, not yet in `dome`.
    prints: MarkerPrint  # Its markers.

    def corners(self) -> FloatArray:
        """Return the corners of its markers (M, 4, 3) in OpenCV's order, in metres."""
        square = self.prints.side * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        flat = (self.prints.corners[:, None, :] + square) * self.panel.texture.cell
        depth = np.zeros((*flat.shape[:2], 1))
        return self.panel.dome_from_panel.apply(np.concatenate([flat, depth], axis=-1))


def _is_narrow(width_px: int) -> bool:
    """Return whether a picture needs larger prints, whose markers can still be read."""
    narrow_px = 600
    return width_px < narrow_px


def hand_board(width_px: int) -> CharucoPrint:
    """Return the board that is held before the bare camera."""
    return CharucoPrint(
        squares=(7, 5) if _is_narrow(width_px) else (11, 8),
        square=24e-3,
        marker=18e-3,
        border=12e-3,
        dictionary="DICT_4X4_250",
    )


def rail_board() -> CharucoPrint:
    """Return the large board that is carried before the dome."""
    return CharucoPrint(
        squares=(38, 30), square=28e-3, marker=21e-3, border=14e-3, dictionary="DICT_4X4_1000"
    )


def board_panel(board: CharucoPrint, dome_from_board: SE3) -> Panel:
    """Return a board, placed by the corner of its squares, as a panel that has a border."""
    edge = SE3(np.eye(3), np.array([-board.border, -board.border, 0.0]))
    return Panel(dome_from_board @ edge, charuco_texture(board))


def squares_size(board: CharucoPrint) -> tuple[float, float]:
    """Return width and height of a board's squares, in metres."""
    return board.squares[0] * board.square, board.squares[1] * board.square


def ground(dome_from_ground: SE3, *, cell: float = 6e-3, shift: int = 0) -> Panel:
    """Return a large mottled panel to stand behind everything, placed by its middle.

    `dome_from_ground`: x to the right, y down. `cell`: side of its 800 x 600 cells, in metres.
    `shift`: offset in the noise.
    """
    texture = Texture(mottled((600, 800), 0.26, 0.45, scale=1.6, shift=shift), cell)
    width, height = texture.size
    corner = SE3(np.eye(3), np.array([-0.5 * width, -0.5 * height, 0.0]))
    return Panel(dome_from_ground @ corner, texture)


def marker_box(width_px: int) -> list[Marked]:
    """Return the walls of an open box, 400 x 380 x 700 mm inside, in `box`."""
    side = 32 if _is_narrow(width_px) else 24
    # Inside of the box: width, depth, height in cells of its walls, whose side is in metres.
    wide, deep, high, cell = 200, 350, 190, 2e-3
    half_wide, half_high, depth = 0.5 * wide * cell, 0.5 * high * cell, deep * cell
    x, y, z = np.eye(3)
    # Name, cells across and down, top-left corner, directions across and down as seen from inside.
    walls = (
        ("forward", (wide, high), (-half_wide, depth, half_high), x, -z),
        ("left", (deep, high), (-half_wide, 0.0, half_high), y, -z),
        ("right", (deep, high), (half_wide, depth, half_high), -y, -z),
        ("down", (wide, deep), (-half_wide, depth, -half_high), x, -y),
    )
    marked, first = [], 0
    for k, (name, cells, corner, across, down) in enumerate(walls):
        places = grid_corners(*(_places(n, side) for n in cells))
        pose = SE3(np.column_stack([across, down, np.cross(across, down)]), np.array(corner))
        prints = _prints(first, places, side, side // 6)
        plywood = mottled(cells[::-1], albedo=0.55, contrast=0.16, scale=0.8, shift=97 * k)
        panel = Panel(pose, marker_texture(plywood, cell, prints))
        marked.append(Marked(name, panel, prints))
        first += len(places)
    return marked


def _places(cells: int, side: int) -> IntArray:
    """Return the first cells of markers along one edge of a wall, evenly spaced and centred."""
    pitch = 7 * side // 4
    count = (cells - side - 2 * (side // 6)) // pitch + 1
    first = (cells - side - (count - 1) * pitch) // 2
    return first + pitch * np.arange(count)


def plate_before(rig: Rig, far: float) -> Marked:
    """Return a plate of six markers, fixed in the quarter of the view farthest from the lasers.

    `rig`: in its water. `far`: distance of the plate's middle from the dome's outside, in metres.
    """
    # In cells, whose side is in metres.
    side, gap, cell = 24, 6, 1e-3
    places = grid_corners(*(gap + (side + gap) * np.arange(n) for n in (3, 2)))
    first_on_plate = 300
    prints = _prints(first_on_plate, places, side, 0)
    paper = np.full((2 * side + 3 * gap, 3 * side + 4 * gap), PAPER)
    texture = marker_texture(paper, cell, prints)
    turn = rotation_from_rotvec(np.deg2rad([3.0, 1.0, 6.0])) @ DOME_FROM_CAM_NOMINAL
    rays = rig.camera().rays(np.array(_QUARTERS) * rig.size_px - 0.5)
    poses = [_centred(turn, middle, texture.size) for middle in rays.points_at(np.full(4, far))]
    pose = max(poses, key=lambda pose: _clearance(rig, pose, texture.size))
    return Marked("plate", Panel(pose, texture), prints)


def plate_scene(plate: Marked, i: int, light: RoomLight) -> PanelScene:
    """Return the scene of picture `i` of a plate, before a ground that moves meanwhile."""
    wall = SE3.from_rotvec([0.02, 0.0, 0.05], [0.01 * i, 0.80 + 0.004 * i, 0.0])
    behind = ground(wall @ SE3(DOME_FROM_CAM_NOMINAL, np.zeros(3)), cell=2e-3, shift=40)
    return PanelScene(panels=[plate.panel, behind], light=light)


def _prints(first: int, places: IntArray, side: int, ring: int) -> MarkerPrint:
    ids = first + np.arange(len(places), dtype=np.int64)
    return MarkerPrint(dictionary=FAMILY, ids=ids, corners=places, side=side, ring=ring)


def moved(marked: Marked, dome_from_own: SE3) -> Marked:
    """Return a marked panel carried into another frame."""
    panel = replace(marked.panel, dome_from_panel=dome_from_own @ marked.panel.dome_from_panel)
    return replace(marked, panel=panel)


def board_mapping(board: CharucoPrint) -> dict[str, Any]:
    """Return the content of a `board.yaml`."""
    return {
        "kind": "charuco",
        "squares_x": board.squares[0],
        "squares_y": board.squares[1],
        "square_mm": to_mm(board.square),
        "marker_mm": to_mm(board.marker),
        "dictionary": board.dictionary,
        "border_mm": to_mm(board.border),
    }


def box_mapping(walls: list[Marked], n_outside: float) -> dict[str, Any]:
    """Return the content of a `box.yaml`; the panels are in `box`."""
    planes = {}
    for wall in walls:
        # Positive along its axis, as a person would write it.
        normal = np.abs(wall.panel.dome_from_panel.rotation[:, 2])
        offset = float(normal @ wall.panel.dome_from_panel.translation)
        planes[wall.name] = {"normal": normal.tolist(), "d": to_mm(offset)}
    markers = [part for wall in walls for part in _marker_mappings(wall, {"plane": wall.name})]
    return {
        "frame": _BOX_FRAME,
        "planes": planes,
        "family": FAMILY,
        "corner_order": _CORNER_ORDER,
        "markers": markers,
        "medium": {"n_outside_nominal": float(n_outside)},
    }


def target_mapping(plate: Marked) -> dict[str, Any]:
    """Return the content of a `target.yaml`; the panel is in `dome`."""
    return {
        "frame": _DOME_FRAME,
        "family": FAMILY,
        "corner_order": _CORNER_ORDER,
        "markers": _marker_mappings(plate, {}),
    }


def _marker_mappings(marked: Marked, more: dict[str, str]) -> list[dict[str, Any]]:
    size = to_mm(marked.prints.side * marked.panel.texture.cell)
    return [
        {
            "id": int(number),
            **more,
            "size_mm": size,
            "corners": [[to_mm(value) for value in corner] for corner in corners],
        }
        for number, corners in zip(marked.prints.ids, marked.corners(), strict=True)
    ]


def to_mm(metres: float) -> float:
    """Return millimetres, rounded to a picometre."""
    return round(1e3 * float(metres), 9) + 0.0
