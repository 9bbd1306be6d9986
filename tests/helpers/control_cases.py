"""Postures, states and small plants for the tests of controllers, missions and safety."""

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from aqualvs.control.controller import RangeYawController
from aqualvs.control.gains import ControlGains
from aqualvs.control.vehicle import Effort, Mode, Setpoint, VehicleState
from aqualvs.scanning.posture import Posture

FRAME_S = 0.04


def posture_at(distance: float = 0.6, yaw: float = 0.0, nearest: float | None = None) -> Posture:
    return Posture(
        range=distance,
        pitch=0.0,
        yaw=yaw,
        covariance=np.diag([1e-6, 1e-6, 1e-6]),
        normal_in_dome=np.array([math.sin(yaw), math.cos(yaw), 0.0]),
        slant_range=distance,
        nearest=distance if nearest is None else nearest,
        n_points=500,
        rms=1e-3,
    )


def state_at(now_s: float, **others: object) -> VehicleState:
    given = {"heard_s": now_s, "armed": True, "mode": Mode.OURS, "depth": 5.0, "heading": 0.0}
    return VehicleState(**{**given, **others})


@dataclass
class PlanePlant:
    """A vehicle that surges, sways and turns before a plane; drag is anisotropic, as theirs.

    Written from the equations in `controller`'s docstring, without a line of its code: thrust with
    a lag, drag relative to the water, turning rate with a lag, efforts that arrive late.
    """

    gains: ControlGains
    distance: float = 0.6
    yaw: float = 0.0
    mass: float = 1.0
    drag: float = 1.0
    delay: int = 2
    current: tuple[float, float] = (0.0, 0.0)
    thrust_lag: float = 0.1
    turn_lag: float = 0.2
    velocity: list[float] = field(default_factory=lambda: [0.0, 0.0])
    force: list[float] = field(default_factory=lambda: [0.0, 0.0])
    turning: float = 0.0
    time: float = 0.0
    along: float = 0.0
    coming: deque[Effort] = field(default_factory=deque)
    fine: int = 8

    def rates(self) -> tuple[float, float]:
        """Rates of range and yaw."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        swing = self.gains.vehicle.dome_forward * self.turning
        return -(self.velocity[0] * c + (self.velocity[1] + swing) * s), -self.turning

    def step(self, effort: Effort) -> None:
        self.coming.append(effort)
        sent = self.coming.popleft() if len(self.coming) > self.delay else Effort()
        facts = self.gains.vehicle
        wanted = facts.thrust.forces(sent.forward, sent.right)
        dt = FRAME_S / self.fine
        drags = (facts.forward_drag, facts.right_drag)
        for _ in range(self.fine):
            c, s = math.cos(self.yaw), math.sin(self.yaw)
            # The current comes along the plane's normal and along the plane.
            water = (
                self.current[0] * c - self.current[1] * s,
                self.current[0] * s + self.current[1] * c,
            )
            for i in (0, 1):
                self.force[i] += dt / self.thrust_lag * (wanted[i] - self.force[i])
                resist = self.drag * drags[i].force(self.velocity[i] - water[i])
                self.velocity[i] += dt * (self.force[i] - resist) / (facts.mass * self.mass)
            turn = sent.yaw * facts.turning_rate
            self.turning += dt / self.turn_lag * (turn - self.turning)
            range_rate, yaw_rate = self.rates()
            self.along += dt * (self.velocity[1] * c - self.velocity[0] * s)
            self.distance += dt * range_rate
            self.yaw += dt * yaw_rate
        self.time += FRAME_S


@dataclass
class Flown:
    """What a run came to, one entry a frame."""

    time: np.ndarray
    range: np.ndarray
    yaw: np.ndarray
    efforts: list[Effort]


def fly(
    plant: PlanePlant,
    controller: RangeYawController,
    setpoint: Setpoint,
    seconds: float,
    *,
    sway: float = 0.0,
    rates: bool = True,
    noise: np.random.Generator | None = None,
) -> Flown:
    """Close the loop for some time; the noise is that of a good frame: 1 mm, 0.2 degrees."""
    times, ranges, yaws, efforts = [], [], [], []
    for _ in range(round(seconds / FRAME_S)):
        near, turned = plant.distance, plant.yaw
        if noise is not None:
            near += 1e-3 * noise.standard_normal()
            turned += math.radians(0.2) * noise.standard_normal()
        closing, turning = plant.rates() if rates else (None, None)
        effort = controller.update(plant.time, near, turned, closing, turning, setpoint, sway)
        times.append(plant.time)
        ranges.append(plant.distance)
        yaws.append(plant.yaw)
        efforts.append(effort)
        plant.step(effort)
    return Flown(np.array(times), np.array(ranges), np.array(yaws), efforts)


def overshoot_and_settling(
    time: np.ndarray, value: np.ndarray, begin: float, end: float
) -> tuple[float, float]:
    """Share of the step, and seconds until within 5 % of it for good."""
    beyond = (value - end) / (end - begin)
    outside = np.flatnonzero(np.abs(beyond) > 0.05)
    settled = time[outside[-1]] - time[0] if len(outside) else 0.0
    return max(0.0, float(beyond.max())), float(settled)
