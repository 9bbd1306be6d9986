"""Where boards and vehicle stand in simulated calibration pictures."""

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL, Rig
from aqualvs.optics.sheet import sheets_of

Size = tuple[float, float]

# Where in the picture the middle of the board is, from the top left, in turn.
_PLACES = (
    *((0.50, 0.50), (0.25, 0.28), (0.75, 0.30), (0.27, 0.72), (0.74, 0.72), (0.50, 0.25)),
    *((0.48, 0.78), (0.18, 0.50), (0.82, 0.52), (0.38, 0.40), (0.62, 0.60), (0.60, 0.38)),
)
# Widths of the board as shares of the picture's, in turn.
_SHARES = (0.78, 0.52, 0.60, 0.48, 0.66, 0.56, 0.50, 0.62)
# Turn and tilt of the vehicle in the box, in degrees: to the left, upward, clockwise.
_LOOKS = ((0.0, -3.0, 1.0), (12.0, -9.0, -2.0), (-10.0, -10.0, 2.0), (-3.0, -13.0, -1.0))
# Middles of the quarters where a plate may be, a little off those of the picture.
_QUARTERS = ((0.24, 0.75), (0.76, 0.75), (0.24, 0.25), (0.76, 0.25))
_GOLDEN = np.pi * (3.0 - np.sqrt(5.0))


def board_across(rig: Rig, size: Size, count: int, rng: np.random.Generator) -> list[SE3]:
    """Return `dome_from_board` of a board all over a bare camera's picture, most of them tilted.

    Parameters
    ----------
    rig : Rig
        Its lens and its place; the dome plays no part.
    size : (float, float)
        Width and height of the board's squares, in metres.
    count : int
        Number of poses.
    rng : Generator
        Source of chance.
    """
    poses = []
    for k in range(count):
        place = np.array(_PLACES[k % len(_PLACES)]) + rng.uniform(-0.03, 0.03, 2)
        far = size[0] * rig.lens.fx / (_SHARES[k % len(_SHARES)] * rig.size_px[0])
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

    Every second one is off square, and rolled, by up to 1.5 degrees; all are shifted a little.

    Parameters
    ----------
    size : (float, float)
        Width and height of the board's squares, in metres.
    distances : array, shape (N,)
        Of the board's middle, in metres.
    rng : Generator
        Source of chance.

    Returns
    -------
    poses : list of SE3
    measured : list of float
        Where each board's plane meets the y axis, in metres.
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
    for k in range(count):
        left, up, roll = np.deg2rad(np.array(_LOOKS[k % len(_LOOKS)]) + rng.uniform(-1, 1, 3))
        turn = rotation_from_rotvec([0.0, 0.0, left]) @ rotation_from_rotvec([up, 0.0, 0.0])
        place = np.array([0.0, -0.005, 0.03]) + rng.uniform(-0.012, 0.012, 3)
        poses.append(SE3(turn @ rotation_from_rotvec([0.0, roll, 0.0]), place))
    return poses


def plate_in_view(rig: Rig, size: Size, far: float) -> SE3:
    """Return `dome_from_plate` of a plate in that quarter of the view that lasers spare most.

    Parameters
    ----------
    rig : Rig
        In its water.
    size : (float, float)
        Width and height of the plate, in metres.
    far : float
        Distance of its middle from the dome's outside, in metres.
    """
    turn = rotation_from_rotvec(np.deg2rad([3.0, 1.0, 6.0])) @ DOME_FROM_CAM_NOMINAL
    rays = rig.camera().rays(np.array(_QUARTERS) * rig.size_px - 0.5)
    poses = [_centred(turn, middle, size) for middle in rays.points_at(np.full(4, far))]
    return max(poses, key=lambda pose: _clearance(rig, pose, size))


def _clearance(rig: Rig, pose: SE3, size: Size) -> float:
    """Return how far a rectangle stays off all sheets, in metres; negative where one crosses it."""
    corners = pose.apply(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) * [*size, 0.0])
    off = np.stack([sheet.signed_distance(corners) for sheet in sheets_of(rig)])
    return float(np.min(np.abs(off.sum(axis=1)) / 4.0 - np.ptp(off, axis=1) / 2.0))


def _centred(turn: FloatArray, middle: FloatArray, size: Size) -> SE3:
    """Return the pose of a rectangle whose origin is its top left, by its middle."""
    return SE3(turn, middle - turn @ np.array([0.5 * size[0], 0.5 * size[1], 0.0]))
