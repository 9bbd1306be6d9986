"""Motion of the water around a simulated vehicle, and of a vehicle without its autopilot."""

import numpy as np

from aqualvs.simulation.vehicle.dynamics import Body, advance, make_work
from aqualvs.simulation.vehicle.water_motion import Flow, WaterMotion, orbit_at, stream_at


def water_at(water: WaterMotion, time_s: float, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Velocity (m/s) and acceleration (m/s²) of the water at a place in the world, (3,) each."""
    flow = water.pack()
    x, y, z = place.tolist()
    stream, orbit = stream_at(float(time_s), flow), orbit_at(float(time_s), (x, y, z), flow)
    return np.add(stream[0], orbit[0]), np.add(stream[1], orbit[1])


def coast(
    y: np.ndarray, thrusts: np.ndarray, wanted: np.ndarray, h: float, n: int, body: Body, flow: Flow
) -> None:
    """Advance state and thrusts by `n` steps of `h` seconds."""
    work = make_work()
    for i in range(n):
        advance(y, thrusts, wanted, i * h, h, body, flow, work)
