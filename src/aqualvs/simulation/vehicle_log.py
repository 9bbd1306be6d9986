"""The log of the simulated vehicle, and the truth of a net's holes.

The net hangs plumb and faces `NET_BEARING`, its middle `NET_DEPTH` deep; the vehicle's attitude is
what the trajectory asks of it.
"""

import csv
from pathlib import Path

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import SE3
from aqualvs.simulation.scenario import Scenario

NET_BEARING = float(np.deg2rad(65.0))
"""Compass direction in which one looks at the net, in radians."""
NET_DEPTH = 6.0
"""Depth of the scene's origin, in metres."""
LEAD_S = 20.0
"""The log begins so long before the dive, and ends so long after it: its clock is not the video's.

Log time = dive time + `LEAD_S`."""
LOG_COLUMNS = ("time_s", "depth_m", "heading_deg", "roll_deg", "pitch_deg")
HOLE_COLUMNS = ("right_m", "up_m", "diameter_mm", "depth_m", "bearing_deg", "time_s")

_RATE_HZ = 10.0
_SIGMA_DEPTH, _SIGMA_ANGLE = 0.005, float(np.deg2rad(0.2))


def vehicle_attitude(dome_from_scene: SE3) -> tuple[float, float, float]:
    """Return heading, roll and pitch in radians, as MAVLink's ATTITUDE has them.

    Parameters
    ----------
    dome_from_scene : SE3
        Pose of the scene, whose net hangs plumb and faces `NET_BEARING`.
    """
    s, c = np.sin(NET_BEARING), np.cos(NET_BEARING)
    # The scene's x, y and z are along the net, away from the vehicle and up.
    ned_from_scene = np.array([[-s, c, 0.0], [c, s, 0.0], [0.0, 0.0, -1.0]])
    right, forward, up = (ned_from_scene @ dome_from_scene.rotation.T).T
    heading = float(np.arctan2(forward[1], forward[0])) % (2.0 * np.pi)
    return heading, float(np.arctan2(right[2], -up[2])), float(-np.arcsin(forward[2]))


def write_vehicle_log(scenario: Scenario, path: Path) -> None:
    """Write depth and attitude of the vehicle, ten times a second, with the noise of sensors.

    Parameters
    ----------
    scenario : Scenario
        With a net or a wall as its target.
    path : Path
        A CSV file with `LOG_COLUMNS`, on its own clock (`LEAD_S`).

    Raises
    ------
    OSError
        As the system says it.
    """
    rng = np.random.default_rng([scenario.seed, 23])
    with path.open("w", newline="", encoding="ascii") as file:
        table = csv.writer(file)
        table.writerow(LOG_COLUMNS)
        for log_s in np.arange(0.0, scenario.duration + 2.0 * LEAD_S, 1.0 / _RATE_HZ):
            pose = scenario.trajectory.pose_at(log_s - LEAD_S, scenario.duration)
            depth = NET_DEPTH - pose.inverse().translation[2] + _SIGMA_DEPTH * rng.normal()
            angles = np.array(vehicle_attitude(pose)) + _SIGMA_ANGLE * rng.normal(size=3)
            heading, roll, pitch = np.rad2deg(angles)
            cells = (heading % 360.0, roll, pitch)
            table.writerow([f"{log_s:.2f}", f"{depth:.3f}", *(f"{cell:.2f}" for cell in cells)])


def write_hole_truth(scenario: Scenario, path: Path) -> None:
    """Write where the holes of a scenario's nets are.

    Parameters
    ----------
    scenario : Scenario
        With nets.
    path : Path
        A CSV file with `HOLE_COLUMNS`: right and up of the vehicle's foot on the net in the first
        frame, diameter, depth and bearing, and when the vehicle's foot is nearest.

    Raises
    ------
    OSError
        As the system says it.
    """
    times = np.array(list(scenario.times()))
    feet = np.array([_foot(scenario, t) for t in times])
    with path.open("w", newline="", encoding="ascii") as file:
        table = csv.writer(file)
        table.writerow(HOLE_COLUMNS)
        for x, z, radius in (hole for net in scenario.nets for hole in net.holes):
            away = np.hypot(feet[:, 0] - x, feet[:, 1] - z)
            place = (x - feet[0, 0], z - feet[0, 1], 2e3 * radius, NET_DEPTH - z)
            when = (float(np.rad2deg(NET_BEARING)), float(times[int(np.argmin(away))]))
            table.writerow([f"{value:.4f}" for value in (*place, *when)])


def _foot(scenario: Scenario, t: float) -> FloatArray:
    """Return the foot of the perpendicular from the dome's centre in the scene's x and z."""
    centre = scenario.trajectory.pose_at(t, scenario.duration).inverse().translation
    return np.asarray(centre[[0, 2]], np.float64)
