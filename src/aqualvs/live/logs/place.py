"""Where on the net the dive was looking: depth, heading and the net's bearing for dive times."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.live.logs.signals import bearing_of
from aqualvs.live.logs.vehicle_log import VehicleLog

# Straight up or down no bearing is left to tell.
_LEAST_HORIZONTAL = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Places:
    """Vehicle and net in `world` at some dive times; NaN where not valid.

    Attributes
    ----------
    time_s : array, shape (n,)
        Dive time.
    depth : array, shape (n,)
        Of the vehicle's depth sensor, in metres, positive down.
    heading : array, shape (n,)
        Of the vehicle's nose (the dome's y axis), radians clockwise from north, in [0, 2 pi).
    bearing : array, shape (n,)
        Of the net's far normal: the compass direction in which one looks when square to the net,
        radians in [0, 2 pi). From inside a round cage it says where on the wall the vehicle is.
    lean : array, shape (n,)
        Elevation of the far normal: 0 for a net that hangs plumb, positive where the net's top
        leans towards the vehicle, radians. Needs the vehicle's roll and pitch.
    depth_valid, heading_valid, bearing_valid, lean_valid : bool array, shape (n,)
        Where they are told.
    ned_from_dome : array, shape (n, 3, 3)
        Rotations from `dome` to `world` (north, east, down). The depth of a point in `dome` is
        `depth + (ned_from_dome @ p_in_dome)[2]`, but for the lever arm between the depth sensor
        and the dome. NaN where the heading is not known.
    level : bool array, shape (n,)
        Where roll or pitch is not known and the vehicle was taken as level in `ned_from_dome`
        and `bearing`.
    """

    time_s: FloatArray
    depth: FloatArray
    heading: FloatArray
    bearing: FloatArray
    lean: FloatArray
    depth_valid: BoolArray
    heading_valid: BoolArray
    bearing_valid: BoolArray
    lean_valid: BoolArray
    ned_from_dome: FloatArray
    level: BoolArray


@dataclass(frozen=True, slots=True)
class VehiclePlaces:
    """A log next to a dive: answers for dive times.

    Attributes
    ----------
    log : VehicleLog
        The vehicle's log.
    offset_s : float
        Log time = dive time + offset_s.
    """

    log: VehicleLog
    offset_s: float = 0.0

    def __post_init__(self) -> None:
        if not np.isfinite(self.offset_s):
            raise OptionError(
                f"{self.log.name}: time offset is {self.offset_s}; give a number of seconds"
            )

    def at(
        self,
        time_s: ArrayLike,
        yaw: ArrayLike | None = None,
        pitch: ArrayLike | None = None,
        valid: ArrayLike | None = None,
    ) -> Places:
        """Return where the vehicle and the net were.

        Parameters
        ----------
        time_s : array, shape (n,)
            Dive time.
        yaw, pitch : array, shape (n,), optional
            Posture to the net (paper, Eq. 24-26) at those times. Without yaw no bearing is told;
            without pitch the net counts as square to the dome's y axis in elevation.
        valid : bool array, shape (n,), optional
            Where the posture is valid; everywhere that it is finite, if left out.

        Notes
        -----
        The far normal is (tan yaw, 1, tan pitch) in `dome`, up to its length. Level, its bearing
        is heading + yaw: yaw is positive when the far normal points to the right, headings grow
        clockwise. Roll and pitch of the vehicle are taken into account where the log tells them.
        """
        times = np.atleast_1d(np.asarray(time_s, float))
        state = self.log.at(times + self.offset_s)
        level = ~(state.roll_valid & state.pitch_valid)
        ned_from_dome = ned_from_dome_of(
            state.heading, np.where(level, 0.0, state.pitch), np.where(level, 0.0, state.roll)
        )
        normal, posture_valid = _far_normals(len(times), yaw, pitch, valid)
        normal_in_ned = np.einsum("nij,nj->ni", ned_from_dome, normal)
        north, east, down = normal_in_ned.T
        horizontal = np.hypot(north, east)
        seen = posture_valid & state.heading_valid
        bearing_valid = seen & (horizontal > _LEAST_HORIZONTAL)
        lean_valid = seen & ~level & (pitch is not None)
        return Places(
            time_s=times,
            depth=state.depth,
            heading=state.heading,
            bearing=np.where(bearing_valid, bearing_of(np.arctan2(east, north)), np.nan),
            lean=np.where(lean_valid, np.arctan2(-down, horizontal), np.nan),
            depth_valid=state.depth_valid,
            heading_valid=state.heading_valid,
            bearing_valid=bearing_valid,
            lean_valid=lean_valid,
            ned_from_dome=ned_from_dome,
            level=level,
        )


def ned_from_dome_of(heading: ArrayLike, pitch: ArrayLike, roll: ArrayLike) -> FloatArray:
    """Return rotations from `dome` (right, forward, up) to north, east, down.

    Parameters
    ----------
    heading, pitch, roll : array, shape (n,)
        Of the vehicle, radians, as MAVLink's ATTITUDE: heading clockwise from north, pitch positive
        with the nose up, roll positive with the right side down; applied in the order roll, pitch,
        heading.

    Returns
    -------
    ned_from_dome : array, shape (n, 3, 3)
    """
    turn, nod, tilt = np.broadcast_arrays(*(np.asarray(a, float) for a in (heading, pitch, roll)))
    ch, sh, cp, sp = np.cos(turn), np.sin(turn), np.cos(nod), np.sin(nod)
    cr, sr = np.cos(tilt), np.sin(tilt)
    forward = np.stack([ch * cp, sh * cp, -sp], axis=-1)
    right = np.stack([ch * sp * sr - sh * cr, sh * sp * sr + ch * cr, cp * sr], axis=-1)
    down = np.stack([ch * sp * cr + sh * sr, sh * sp * cr - ch * sr, cp * cr], axis=-1)
    return np.stack([right, forward, -down], axis=-1)


def _far_normals(
    n: int, yaw: ArrayLike | None, pitch: ArrayLike | None, valid: ArrayLike | None
) -> tuple[FloatArray, BoolArray]:
    """Return unit far normals in `dome`, shape (n, 3), and where they are known."""
    if yaw is None:
        return np.full((n, 3), np.nan), np.zeros(n, bool)
    across = np.broadcast_to(np.asarray(yaw, float), n)
    up = np.broadcast_to(np.asarray(0.0 if pitch is None else pitch, float), n)
    known = np.isfinite(across) & np.isfinite(up)
    if valid is not None:
        known = known & np.broadcast_to(np.asarray(valid, bool), n)
    normal = np.stack([np.tan(across), np.ones(n), np.tan(up)], axis=-1)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True), known
