"""Lay out the markers of a calibration box (paper, 3.3): four planes, cut into sheets of paper.

Frame `box`: origin at the middle of the open mouth, x right, y forward, z up.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aqualvs.calibration.targets import MarkerSet, aruco_dictionary
from aqualvs.errors import CalibrationError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane

# From marker to marker, in sides of a marker: enough light ring, and room for stripes to cross.
_PITCH = 1.7


@dataclass(frozen=True, slots=True, kw_only=True)
class BoxPlan:
    """A box, open towards the vehicle and at its top.

    Attributes
    ----------
    width, height, depth : float
        Inside, along x, z and y, in metres.
    marker : float
        Side of a marker, in metres.
    family : str
        Name of the markers' dictionary.
    first_id : int
        Number of the first marker; the others follow.
    """

    width: float
    height: float
    depth: float
    marker: float
    family: str
    first_id: int = 0


@dataclass(frozen=True, slots=True)
class Patch:
    """A piece of a plane that one sheet of paper covers.

    Attributes
    ----------
    plane : str
        On which plane it lies.
    offset : (float, float)
        Of its top-left corner from the plane's, right and down as seen from inside, in metres.
    size : (float, float)
        Width and height, in metres.
    ids : tuple of int
        Its markers.
    corners : array, shape (M, 2)
        Their top-left corners from the patch's own, in metres.
    """

    plane: str
    offset: tuple[float, float]
    size: tuple[float, float]
    ids: tuple[int, ...]
    corners: FloatArray


@dataclass(frozen=True, slots=True)
class _Wall:
    """A plane with axes right and down as seen from inside; `origin` is its top left."""

    plane: Plane
    origin: FloatArray
    right: FloatArray
    down: FloatArray
    size: tuple[float, float]


def box_patches(
    plan: BoxPlan, rooms: Sequence[tuple[float, float]]
) -> tuple[MarkerSet, tuple[Patch, ...]]:
    """Return a box's markers, and the pieces in which they can be printed.

    Parameters
    ----------
    plan : BoxPlan
        The box.
    rooms : sequence of (float, float)
        Width and height that a sheet of paper can hold, in metres: upright and across. Infinite
        for sheets as large as a plane.

    Raises
    ------
    CalibrationError
        If a plane or a sheet is too small for a marker, or the dictionary has too few.
    """
    pitch = _PITCH * plan.marker
    _check(plan, pitch, rooms)
    ids: list[int] = []
    corners: list[FloatArray] = []
    names: list[str] = []
    patches: list[Patch] = []
    walls = _walls(plan)
    for name, wall in walls.items():
        first = plan.first_id + len(ids)
        placed = _grid(wall, pitch, plan.marker)
        patches += _patches(name, placed, first, pitch, plan.marker, rooms)
        numbers = first + np.arange(placed.shape[0] * placed.shape[1])
        ids += numbers.tolist()
        corners += [_in_box(wall, corner, plan.marker) for corner in placed.reshape(-1, 2)]
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
        corners=np.array(corners),
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
    first: int,
    pitch: float,
    marker: float,
    rooms: Sequence[tuple[float, float]],
) -> list[Patch]:
    """Cut a wall's grid into blocks of whole cells that fit a sheet, the way that takes fewest."""
    rows, columns = placed.shape[:2]
    numbers = first + np.arange(rows * columns).reshape(rows, columns)
    ways = [_block(room, pitch, rows, columns) for room in rooms if min(room) >= pitch]
    n_down, n_across = min(ways, key=lambda way: -(-rows // way[0]) * -(-columns // way[1]))
    inset = 0.5 * (pitch - marker)
    patches = []
    for i in range(0, rows, n_down):
        for j in range(0, columns, n_across):
            block = placed[i : i + n_down, j : j + n_across]
            corner = block[0, 0] - inset
            patches.append(
                Patch(
                    name,
                    (float(corner[0]), float(corner[1])),
                    (block.shape[1] * pitch, block.shape[0] * pitch),
                    tuple(numbers[i : i + n_down, j : j + n_across].ravel().tolist()),
                    block.reshape(-1, 2) - corner,
                )
            )
    return patches


def _block(room: tuple[float, float], pitch: float, rows: int, columns: int) -> tuple[int, int]:
    """Return how many rows and columns of cells a sheet holds."""
    return int(min(room[1] / pitch + 1e-9, rows)), int(min(room[0] / pitch + 1e-9, columns))


def _in_box(wall: _Wall, corner: FloatArray, marker: float) -> FloatArray:
    """Return a marker's corners (4, 3) in `box`."""
    flat = corner + marker * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    points: FloatArray = wall.origin + flat[:, :1] * wall.right + flat[:, 1:] * wall.down
    return points
