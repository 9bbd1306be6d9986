"""A moving net, flat or part of a cage: its pose over time, posture of a vehicle to it, its scene.

Frames: `world` is north, east, down. `net` is fixed to the net: its origin in the middle, x right
and z up as a vehicle before the middle sees them, y away from the vehicle; it is the frame `scene`
of `aqualvs.simulation.scene`. Places on a curved net are counted along it and up.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple, TypeVar

import numpy as np

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.linear_algebra import Vec
from aqualvs.geometry.transforms import SE3
from aqualvs.simulation.scene import Box, Fold, Net, Scene, Swimmer, Wall

_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))
# Pairs of corners that differ in one coordinate.
_EDGES = np.array([(i, i + step) for step in (1, 2, 4) for i in range(8) if not i & step])

AnySwimmer = TypeVar("AnySwimmer", bound=Swimmer)


class NetPosture(NamedTuple):
    """True posture of a vehicle to the net; see docs/conventions.md."""

    # Distance of the dome's centre from the net's nearest point, in metres; negative behind it.
    range: float
    # Of the tangent plane at that point, in radians.
    pitch: float
    yaw: float
    # Place of that point on the net, in metres: along it to the right, and up.
    along: float
    up: float


@dataclass(frozen=True, slots=True, kw_only=True)
class NetWall:
    """Upright net, flat or an upright cylinder, that sways, drifts and tilts as a whole."""

    position: Vec = (0.0, 0.0, 5.0)  # Middle of the net at rest, in the world, in metres.
    bearing: float = 0.0  # Viewing direction to the middle, in radians clockwise from north.
    # In 1/m: 0 is flat, positive a cage seen from outside (it recedes to both sides), negative one
    # seen from inside.
    curvature: float = 0.0
    # Amplitude in metres, period in seconds, phase in radians of a sine along `bearing`.
    sway: float = 0.0
    sway_period: float = 6.0
    sway_phase: float = 0.0
    drift: float = 0.0  # Steady speed along `bearing`, in m/s.
    # In radians about the horizontal through the middle; positive where the far normal points up,
    # as pitch.
    tilt: float = 0.0
    # Amplitude in radians, period in seconds, phase in radians of a sine on top of the tilt.
    rock: float = 0.0
    rock_period: float = 7.0
    rock_phase: float = 0.0

    def world_from_net(self, time_s: float) -> SE3:
        """Return the pose of the net's frame at a time."""
        north, east = math.cos(self.bearing), math.sin(self.bearing)
        angle = self.tilt + self.rock * _sine(time_s, self.rock_period, self.rock_phase)
        c, s = math.cos(angle), math.sin(angle)
        moved = self.drift * time_s + self.sway * _sine(time_s, self.sway_period, self.sway_phase)
        x, y, z = self.position
        turn = np.array(
            [[-east, c * north, -s * north], [north, c * east, -s * east], [0.0, -s, -c]]
        )
        return SE3(turn, np.array([x + moved * north, y + moved * east, z]))

    def posture_at(self, world_from_dome: SE3, time_s: float) -> NetPosture:
        """Return the true posture of a vehicle, as `aqualvs.scanning.posture` defines it.

        Range, pitch and yaw are those of the tangent plane at the nearest point, which is the
        net itself if it is flat. `world_from_dome`: the dome's axes are right, forward, up.
        """
        net = self.world_from_net(time_s)
        centre = (world_from_dome.translation - net.translation) @ net.rotation
        along, distance = self._nearest(centre)
        angle = along * self.curvature
        away = net.rotation @ np.array([-math.sin(angle), math.cos(angle), 0.0])
        x, y, z = (away @ world_from_dome.rotation).tolist()
        return NetPosture(distance, math.atan2(z, y), math.atan2(x, y), along, float(centre[2]))

    def clearance(self, world_from_body: SE3, half_size: Sequence[float], time_s: float) -> float:
        """Return the least distance between net and hull, in metres; negative is a collision.

        `half_size`: half length, width and height of the hull, a box about the body's origin, in
        metres.
        """
        net = self.world_from_net(time_s)
        # Across the net's upright only.
        axes = net.rotation[:, :2]
        centre = (world_from_body.translation - net.translation) @ axes
        corners = (_CORNERS * np.array(half_size)) @ (world_from_body.rotation.T @ axes) + centre
        if self.curvature == 0.0:
            return -float(corners[:, 1].max())
        radius = 1.0 / abs(self.curvature)
        corners = corners - np.array([0.0, 1.0 / self.curvature])
        if self.curvature < 0.0:
            return radius - float(np.linalg.norm(corners, axis=1).max())
        # The axis is outside of the hull's outline, and the outline is made of edges.
        start, way = corners[_EDGES[:, 0]], corners[_EDGES[:, 1]] - corners[_EDGES[:, 0]]
        length = np.maximum(np.sum(way**2, axis=1), 1e-18)
        share = np.clip(-np.sum(start * way, axis=1) / length, 0.0, 1.0)
        return float(np.linalg.norm(start + share[:, None] * way, axis=1).min()) - radius

    def scene_at(self, world_from_dome: SE3, time_s: float, base: Scene) -> Scene:
        """Return the scene before a vehicle, for the renderer.

        Before a flat net the scene stays in place. A curved net is rendered as the paraboloid that
        touches the cylinder at the nearest point, with the mesh, holes and folds of that place; it
        leaves the cylinder by u⁴/(8 R³) at a distance u, and its mesh is stretched by u³/(6 R²).
        The stains on a wall behind a curved net move with the vehicle.

        Parameters
        ----------
        world_from_dome : SE3
            Pose of the dome's axes.
        time_s : float
            Time in seconds; render the scene at the same.
        base : Scene
            Scene in the frame of the net at rest; holes and folds of nets are placed along it and
            up. Its `dome_from_scene` is not used.

        Raises
        ------
        OptionError
            If a net of `base` is bent by itself, or has edges while this wall is curved.
        """
        self._check(base.nets)
        dome_from_net = world_from_dome.inverse() @ self.world_from_net(time_s)
        if self.curvature == 0.0:
            return replace(base, dome_from_scene=dome_from_net)
        centre = dome_from_net.inverse().translation
        along, _ = self._nearest(centre)
        up = float(centre[2])
        net_from_patch = SE3(self._tangent_axes(along), self._point(along, up))
        patch_from_net = net_from_patch.inverse()
        angle = along * self.curvature
        return replace(
            base,
            dome_from_scene=dome_from_net @ net_from_patch,
            nets=tuple(_slid(net, along, up, self.curvature) for net in base.nets),
            walls=tuple(_turned_wall(wall, patch_from_net) for wall in base.walls),
            fish=tuple(_moved(fish, patch_from_net) for fish in base.fish),
            bubbles=tuple(_moved(bubble, patch_from_net) for bubble in base.bubbles),
            boxes=tuple(_turned_box(box, patch_from_net, angle) for box in base.boxes),
        )

    def station(
        self,
        distance: float,
        *,
        along: float = 0.0,
        up: float = 0.0,
        yaw: float = 0.0,
        time_s: float = 0.0,
    ) -> SE3:
        """Return world_from_dome of a level dome at a distance and yaw before a place on the net.

        Parameters
        ----------
        distance : float
            From the nearest point, in metres.
        along, up : float
            Place of that point on the net, in metres.
        yaw : float
            As `Posture.yaw`, in radians.
        time_s : float
            Time in seconds.

        Raises
        ------
        OptionError
            If the distance is not positive, or reaches the axis of a cage from inside.
        """
        if not distance > 0.0 or distance * self.curvature <= -1.0:
            raise OptionError(
                f"net wall: station at {distance:g} m; it must be positive, and inside a cage "
                "less than its radius"
            )
        world_from_net = self.world_from_net(time_s)
        away = world_from_net.rotate(self._tangent_axes(along)[:, 1])
        place = world_from_net.apply(self._point(along, up)) - distance * away
        heading = math.atan2(away[1], away[0]) - yaw
        c, s = math.cos(heading), math.sin(heading)
        return SE3(np.array([[-s, c, 0.0], [c, s, 0.0], [0.0, 0.0, -1.0]]), place)

    def _nearest(self, p: FloatArray) -> tuple[float, float]:
        """Return the place of the nearest point along the net, and its signed distance."""
        k = self.curvature
        if k == 0.0:
            return float(p[0]), -float(p[1])
        side = math.copysign(1.0, k)
        x, y = float(p[0]), float(p[1]) - 1.0 / k
        # The far normal points to the axis from outside and away from it from inside.
        angle = math.atan2(side * x, -side * y)
        return angle / k, side * math.hypot(x, y) - 1.0 / k

    def _tangent_axes(self, along: float) -> FloatArray:
        """Return axes (columns) in `net`: along the net, away from the vehicle, up."""
        c, s = math.cos(along * self.curvature), math.sin(along * self.curvature)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def _point(self, along: float, up: float) -> FloatArray:
        k = self.curvature
        if k == 0.0:
            return np.array([along, 0.0, up])
        half = math.sin(0.5 * along * k)
        return np.array([math.sin(along * k) / k, 2.0 * half * half / k, up])

    def _check(self, nets: Sequence[Net]) -> None:
        for net in nets:
            if any(net.curvature):
                raise OptionError(
                    f"net wall: its net has a curvature {net.curvature} of its own; set the "
                    "wall's instead"
                )
            if self.curvature != 0.0 and np.isfinite(net.half_size).any():
                raise OptionError(
                    f"net wall: a curved wall has no edges, but its net has a half size of "
                    f"{net.half_size} m; leave it infinite"
                )


def _sine(time_s: float, period: float, phase: float) -> float:
    return math.sin(2.0 * math.pi * time_s / period + phase)


def _slid(net: Net, along: float, up: float, curvature: float) -> Net:
    """Return a net moved to a place on it."""
    return replace(
        net,
        curvature=(curvature, 0.0),
        offset=(net.offset[0] - along, net.offset[1] - up),
        holes=tuple((x - along, z - up, radius) for x, z, radius in net.holes),
        folds=tuple(_slid_fold(fold, along, up) for fold in net.folds),
    )


def _slid_fold(fold: Fold, along: float, up: float) -> Fold:
    shift = math.cos(fold.direction) * along + math.sin(fold.direction) * up
    return replace(fold, place=fold.place - shift)


def _turned_wall(wall: Wall, patch_from_net: SE3) -> Wall:
    normal = patch_from_net.rotate([math.tan(wall.yaw), 1.0, math.tan(wall.pitch)])
    x, y, z = normal.tolist()
    depth = float(normal @ patch_from_net.apply([0.0, wall.depth, 0.0])) / y
    return replace(wall, depth=depth, yaw=math.atan2(x, y), pitch=math.atan2(z, y))


def _moved(one: AnySwimmer, patch_from_net: SE3) -> AnySwimmer:
    position, velocity = patch_from_net.apply(one.position), patch_from_net.rotate(one.velocity)
    return replace(one, position=_vec(position), velocity=_vec(velocity))


def _turned_box(box: Box, patch_from_net: SE3, angle: float) -> Box:
    return replace(box, centre=_vec(patch_from_net.apply(box.centre)), heading=box.heading - angle)


def _vec(values: FloatArray) -> Vec:
    x, y, z = values.tolist()
    return x, y, z
