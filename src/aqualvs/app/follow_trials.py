"""The three trials that a loop is judged by: hold, step, follow; in one sea before one net."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from aqualvs.app.follow_fast_eye import SampledEye
from aqualvs.app.follow_rendered import RenderedEye
from aqualvs.app.follow_sim import Eye, Timing
from aqualvs.app.follow_sim_case import SimCase, sea
from aqualvs.app.follow_sim_log import LoopLog
from aqualvs.app.follow_sim_measures import (
    HoldMeasures,
    StepMeasures,
    hold_measures,
    step_measures,
)
from aqualvs.control.gains import ControlGains
from aqualvs.control.mission import HoldMission
from aqualvs.control.missions_follow import FollowMission
from aqualvs.control.setpoint import Setpoint
from aqualvs.simulation.example_rigs import example_rig
from aqualvs.simulation.net_motion import NetWall
from aqualvs.simulation.vehicle_models import VehicleModel

RANGE, STEP, SWAY = 0.6, 0.2, 0.2
"""Held, by how much it is stepped, in metres; speed along the net, in m/s."""
FROM_REST_S = 10.0
"""A run begins at rest in the current; so long it may take to settle."""
STEP_S, HOLD_END_S, FOLLOW_END_S = 40.0, 52.0, 70.0
"""When the step comes, and when the two runs end."""
CURVED = NetWall(curvature=-0.1, sway=0.05, sway_period=8.0, rock=math.radians(1.0))
"""The inside of a cage of 10 m radius, that sways and rocks."""


@dataclass(frozen=True, slots=True)
class Trials:
    """Runs of one vehicle.

    Parameters
    ----------
    model : VehicleModel
    gains : ControlGains
    rendered : bool
        Pictures through the scanner, else postures with its noise.
    fps : float
        Frames a second.
    seed : int
        Of waves and noise.
    waves : float
        Amplitude in metres.
    """

    model: VehicleModel
    gains: ControlGains
    rendered: bool = False
    fps: float = 25.0
    seed: int = 0
    waves: float = 0.1

    def begin(self, seconds: float) -> LoopLog:
        """Take hold before a flat net, from rest in the current."""
        case = self._case(NetWall())
        return case.loop(self._eye(case), HoldMission(Setpoint(RANGE))).run(seconds)

    def hold_and_step(
        self, seconds: float = HOLD_END_S, step_s: float = STEP_S
    ) -> tuple[LoopLog, HoldMeasures, StepMeasures]:
        """Hold before a flat net, then step away from it."""
        case = self._case(NetWall())
        mission = HoldMission(Setpoint(RANGE))

        def step(now_s: float) -> None:
            if now_s >= step_s:
                mission.setpoint = Setpoint(RANGE + STEP)

        log = case.loop(self._eye(case), mission).run(seconds, step)
        answer = step_measures(
            log.column("time_s"), log.column("range"), step_s, RANGE, RANGE + STEP
        )
        # The setpoint in force lags the frame by its delay.
        return log, hold_measures(log, FROM_REST_S, step_s), answer

    def follow(
        self, seconds: float = FOLLOW_END_S, every_frame: Callable[[float], object] | None = None
    ) -> tuple[LoopLog, HoldMeasures]:
        """Go along a curved net that moves."""
        case = self._case(CURVED)
        mission = FollowMission(Setpoint(RANGE), SWAY)
        log = case.loop(self._eye(case), mission).run(seconds, every_frame)
        return log, hold_measures(log, FROM_REST_S)

    def _case(self, net: NetWall) -> SimCase:
        return SimCase(
            model=self.model,
            gains=self.gains,
            water=sea(waves=self.waves, seed=self.seed),
            net=net,
            start_range=RANGE,
            timing=Timing(fps=self.fps),
            seed=self.seed,
        )

    def _eye(self, case: SimCase) -> Eye:
        rng = np.random.default_rng([self.seed, 53])
        if self.rendered:
            return RenderedEye(case.net, example_rig(), rng)
        return SampledEye(case.net, rng)
