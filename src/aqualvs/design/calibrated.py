"""Posture errors by errors of the camera and by an off-centre lens, after a laser calibration.

Lasers are calibrated on boards that the same camera sees. An error of the camera model displaces
the boards, and the lasers with them, so that it partly cancels in the posture (`camera_errors`).
`offset_costs` gives the errors for a lens off the dome's centre, if its offset is neglected or
known.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from aqualvs.calibration.solver.initial_pose import target_pose
from aqualvs.calibration.targets.targets import View
from aqualvs.check.finding import index_sigma
from aqualvs.design.settings import Design, Tolerances
from aqualvs.errors import CalibrationError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.optics.expected_error import WallView
from aqualvs.optics.rig import Laser, Rig, rig_moved_by

# Half a side of a board for the calibration of lasers, as a share of its range: boards fill the
# picture.
_HALF_BOARD = 0.8


def camera_errors(design: Design, ranges: Sequence[float]) -> dict[str, FloatArray]:
    """Return the posture errors by the camera's tolerances after a calibration of the lasers.

    By cause, shape (W, 3): standard deviations of (range, pitch, yaw), m and rad, on walls square
    ahead at `ranges` (metres); NaN if lasers light no board. `design` has the final tilts of its
    lasers.
    """
    rig = design.nominal_rig()
    walls = [WallView.ahead(rig, wall) for wall in ranges]
    truth = np.array([[wall, 0.0, 0.0] for wall in ranges])
    found = {}
    for cause, steps in _steps(rig, design.tolerances).items():
        squares = np.zeros((len(walls), 3))
        for step in steps:
            moved = rig_moved_by(rig, list(step), np.array([*step.values()]))
            assumed = lasers_by(moved, rig)
            if assumed is None:
                squares += np.nan
                continue
            read = np.array([wall.measured_by(assumed) for wall in walls])
            squares += (read - truth) ** 2
        found[cause] = np.sqrt(squares)
    return found


def _steps(rig: Rig, tolerances: Tolerances) -> dict[str, list[Mapping[str, float]]]:
    """Return one-sigma steps of the camera's parameters, by cause."""
    lens, turn, dome = tolerances.lens, tolerances.rotation, tolerances.dome
    focal = {"fx": tolerances.focal * rig.lens.fx, "fy": tolerances.focal * rig.lens.fy}
    steps: dict[str, list[Mapping[str, float]]] = {
        "lens place": [{f"lens_{axis}": lens} for axis in "xyz"],
        "camera rotation": [{f"rotation_{axis}": turn} for axis in "xyz"],
        "focal length": [focal],
    }
    if rig.dome is not None:
        steps["dome"] = [{"inner_radius": dome}, {"thickness": dome}]
    if rig.flat_port is not None:
        # A shift of the lens shifts the whole camera; what matters is the distance of the port.
        tilts = [{"port_tilt_x": turn}, {"port_tilt_y": turn}]
        steps["flat port"] = [{"port_distance": lens}, {"thickness": dome}, *tilts]
    return steps


def lasers_by(assumed: Rig, true: Rig) -> Rig | None:
    """Return a rig with lasers calibrated by its own camera in the pictures of another rig.

    The calibration is without noise: the camera of `assumed` gives the poses of boards in the
    working range in pictures that `true` takes, and the stripes on the boards give the lasers. None
    if the boards, or the stripes on them, cannot be used.
    """
    lit: list[list[FloatArray]] = [[] for _ in true.lasers]
    for board in _boards(true.working_range):
        found = _estimated_pose(assumed, true, board)
        if found is None:
            continue
        for points, laser in zip(lit, true.lasers, strict=True):
            points.append(_stripe_on(board, found, laser, assumed, true))
    min_points = 40  # Fewest visible points of a laser on all boards.
    if any(sum(map(len, points)) < min_points for points in lit):
        return None
    lasers = (
        replace(laser, plane=Plane.fitted(np.concatenate(points)), window=None)
        for laser, points in zip(true.lasers, lit, strict=True)
    )
    return replace(assumed, lasers=tuple(lasers))


def _boards(working_range: tuple[float, float]) -> Iterator[SE3]:
    """Yield poses `dome_from_board`; boards lie in their x-z plane."""
    near, far = working_range
    places = (0.15, 0.85)  # Exponents between the ends of the working range.
    # Rotation vectors.
    tilts = (np.deg2rad((25.0, 0.0, 10.0)), np.deg2rad((-15.0, 0.0, -25.0)))
    for share in places:
        middle = np.array([0.0, near * (far / near) ** share, 0.0])
        for tilt in tilts:
            yield SE3(rotation_from_rotvec(tilt), middle)


def _estimated_pose(assumed: Rig, true: Rig, board: SE3) -> SE3 | None:
    """Return the pose of a board that the assumed camera estimates; None if it fails."""
    half, n_corners = _HALF_BOARD * float(board.translation[1]), 11
    x, z = np.meshgrid(*(np.linspace(-half, half, n_corners),) * 2)
    corners = np.stack([x, np.zeros_like(x), z], axis=-1).reshape(-1, 3)
    camera = true.camera()
    pixels, valid = camera.project(board.apply(corners))
    seen = valid & camera.inside_image(pixels)
    view = View("board", np.flatnonzero(seen), corners[seen], pixels[seen])
    try:
        pose = target_pose(assumed.camera(), view, start=board, max_rms_px=np.inf)
    except CalibrationError:
        return None
    return pose.dome_from_target


def _stripe_on(board: SE3, found: SE3, laser: Laser, assumed: Rig, true: Rig) -> FloatArray:
    """Return points (N, 3) of a laser's stripe on a board, located by the assumed camera.

    `board` is the true pose, `found` the pose by the assumed camera.
    """
    face = board.rotate([0.0, 1.0, 0.0])
    along = np.cross(laser.plane.normal, face)
    length = float(np.linalg.norm(along))
    if length < 1e-3:
        return np.empty((0, 3))
    rows = np.stack([laser.plane.normal, face, along / length])
    middle = board.translation
    start = np.linalg.solve(rows, [laser.plane.offset, face @ middle, rows[2] @ middle])
    half, n_points = _HALF_BOARD * float(middle[1]), 161
    points = start + np.linspace(-half, half, n_points)[:, None] * rows[2]
    camera = true.camera()
    pixels, valid = camera.project(points)
    on_board = np.abs(board.inverse().apply(points)) <= half
    seen = valid & camera.inside_image(pixels) & on_board.all(axis=-1)
    normal = found.rotate([0.0, 1.0, 0.0])
    surface = Plane(normal, float(normal @ found.translation))
    placed, met = surface.intersect(assumed.camera().rays(pixels[seen]))
    return placed[met]


INDEX_ERROR = 0.005
"""Approximate difference of the indices of sea water and fresh water."""


@dataclass(frozen=True, slots=True)
class OffsetCost:
    """Errors by an offset of the lens forward of the dome's centre."""

    offset: float  # Metres.
    # Shape (W, 3): errors of (range, pitch, yaw), in m and rad, if the lens is assumed to be in the
    # centre and all else is right.
    neglected: FloatArray
    # Shape (W, 3): the same if the lasers, too, were calibrated with the lens assumed to be in the
    # centre, on boards whose poses are then wrong as well. NaN if no board's pose can be estimated.
    calibrated: FloatArray
    # Shape (W, 3): as `neglected`, for an equal offset to the right.
    aside: FloatArray
    # Shape (W, 3): errors if the offset is known, but the water's index is too large by
    # `INDEX_ERROR`.
    index_error: FloatArray
    # Standard deviation of the water's index from one picture of a known target; see
    # `aqualvs.check.finding.index_sigma`.
    index_sigma: float


def offset_costs(design: Design, ranges: Sequence[float]) -> tuple[OffsetCost, ...]:
    """Return the errors by offsets of the lens, from zero to the largest possible in the dome.

    Among them are the design's own offset and its centring tolerance. Empty without a dome, or a
    posture at any of the ranges. `design` has the final tilts of its lasers; `ranges` are those of
    walls square ahead, in metres.
    """
    dome = design.rig.dome
    if dome is None:
        return ()
    own = float(np.linalg.norm(design.rig.dome_from_cam.translation))
    usual = (0.0, 0.5e-3, 1e-3, 2e-3, 5e-3, 10e-3, 20e-3, 40e-3)
    offsets = {round(value, 5) for value in (*usual, own, design.centring)}
    rig = design.nominal_rig()
    # Largest offset of a lens, as a share of the inner radius.
    max_share = 0.9
    largest = max_share * dome.inner_radius
    costs = tuple(_cost(rig, offset, ranges) for offset in sorted(offsets) if offset <= largest)
    return costs if np.isfinite([one.neglected for one in costs]).any() else ()


def _cost(rig: Rig, offset: float, ranges: Sequence[float]) -> OffsetCost:
    """Return the errors of a lens offset by `offset` metres, forward and to the right."""
    centred = _with_lens(rig, (0.0, 0.0, 0.0))
    ahead, aside = _with_lens(rig, (0.0, offset, 0.0)), _with_lens(rig, (offset, 0.0, 0.0))
    return OffsetCost(
        offset=offset,
        neglected=_errors(ahead, centred, ranges),
        calibrated=_errors(ahead, lasers_by(centred, ahead), ranges),
        aside=_errors(aside, centred, ranges),
        index_error=_errors(ahead, ahead.in_water(rig.n_water + INDEX_ERROR), ranges),
        index_sigma=index_sigma(ahead),
    )


def _with_lens(rig: Rig, position: tuple[float, float, float]) -> Rig:
    return replace(rig, dome_from_cam=SE3(rig.dome_from_cam.rotation, np.array(position)))


def _errors(true: Rig, assumed: Rig | None, ranges: Sequence[float]) -> FloatArray:
    """Return the posture errors (W, 3) of `assumed` on pictures of `true`; NaN without posture."""
    if assumed is None:
        return np.full((len(ranges), 3), np.nan)
    read = [WallView.ahead(true, wall).measured_by(assumed) - [wall, 0.0, 0.0] for wall in ranges]
    return np.array(read)
