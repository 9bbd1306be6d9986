"""The simulated loop: delays, losses of sight, noise, and what its log says."""

import csv
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks.random_dives import random_dive

from aqualvs.control.answer_watch import AnswerLimits
from aqualvs.control.missions import HoldMission
from aqualvs.control.safety import LimitReason as GateReason
from aqualvs.control.tune import tune
from aqualvs.control.vehicle import Effort, Setpoint
from aqualvs.errors import OptionError
from aqualvs.follow.case import SimCase, sea, vehicle_model
from aqualvs.follow.log import NEUTRAL_WITHIN_S, LoopLog, LoopRow, write_log
from aqualvs.follow.loop import SimulatedLoop, Timing
from aqualvs.follow.sensor_model import Blind, LossOfSight, PostureNoise, SampledSensor
from aqualvs.scanning.posture import Posture, Reason
from aqualvs.simulation.net_motion import NetWall
from aqualvs.simulation.vehicle.water_motion import WaterMotion

MODEL = vehicle_model("bluerov2")
GAINS = tune(MODEL).gains
CALM = SimCase(model=MODEL, gains=GAINS, water=WaterMotion())
ROUGH = replace(CALM, water=sea(seed=3))


def loop_of(case: SimCase, blind: tuple[Blind, ...] = ()) -> SimulatedLoop:
    sensor = SampledSensor(case.net, np.random.default_rng(5), blind=blind)
    return case.loop(sensor, HoldMission(Setpoint(0.6)))


def test_eye_has_the_noise_that_it_claims() -> None:
    net = NetWall(curvature=-0.1)
    sensor = SampledSensor(net, np.random.default_rng(1))
    dome = net.station(0.7, yaw=0.1)
    seen = [sensor.look(dome, 0.0) for _ in range(2000)]
    postures = [one for one in seen if isinstance(one, Posture)]
    assert len(postures) == len(seen)
    values = np.array([(one.range, one.pitch, one.yaw) for one in postures])
    sigma = np.sqrt(np.diag(postures[0].covariance))
    # Of 2000 draws a standard deviation is known to 1.6 %, a mean to 2.2 % of it: five of each.
    assert values.std(axis=0) == pytest.approx(sigma, rel=0.08)
    assert np.all(np.abs(values.mean(axis=0) - (0.7, 0.0, 0.1)) < 0.12 * sigma)


def test_eye_loses_target_and_stream_when_told_to() -> None:
    net = NetWall()
    blind = (Blind(1.0, 2.0), Blind(3.0, 4.0, LossOfSight.STREAM))
    sensor = SampledSensor(net, np.random.default_rng(1), PostureNoise(), blind)
    near, far = net.station(0.6), net.station(1.5)
    assert sensor.look(near, 0.5)
    lost = sensor.look(near, 1.5)
    assert not lost
    assert lost is not None
    assert lost.reason is Reason.TOO_FEW_POINTS
    assert sensor.look(near, 3.5) is None
    away = sensor.look(far, 5.0)
    assert not isinstance(away, Posture)
    assert away is not None
    assert away.reason is Reason.OUT_OF_RANGE


def test_no_effort_comes_before_the_first_frame_has_arrived() -> None:
    # Too far away by so much that the dead band is crossed at once.
    case = replace(ROUGH, timing=Timing(delay=0.15), start_range=0.7)
    log = loop_of(case).run(1.0)
    thrust = [row.time_s for row in log.rows if row.forward != 0.0]
    # The first frame is exposed at 0; the effort shows in the first row after 0.15 s.
    assert 0.15 <= thrust[0] <= 0.15 + 2.0 / 25.0


@pytest.mark.parametrize("loss", [LossOfSight.TARGET, LossOfSight.STREAM])
def test_thrust_ends_in_time_when_sight_is_lost(loss: LossOfSight) -> None:
    blind = (Blind(6.0, 7.0, loss), Blind(9.0, 9.5, loss))
    log = loop_of(ROUGH, blind).run(12.0)
    assert log.n_blind == 2
    assert len(log.blind_thrust_s) == 2
    assert max(log.blind_thrust_s) <= NEUTRAL_WITHIN_S
    delay = ROUGH.timing.delay
    for start, end in ((6.0, 7.0), (9.0, 9.5)):
        dark = [row for row in log.rows if start + delay + 0.2 <= row.time_s < end + delay]
        assert dark
        assert all(row.forward == row.right == row.turn == 0.0 for row in dark)
    # It comes back by itself.
    assert log.rows[-1].forward != 0.0


def test_thrust_ends_in_time_when_the_picture_stands_still() -> None:
    """Its postures are valid to the scanner: the log counts no stretch without one."""
    blind = (Blind(6.0, 7.0, LossOfSight.FROZEN), Blind(9.0, 9.5, LossOfSight.FROZEN))
    log = loop_of(ROUGH, blind).run(12.0)
    assert log.n_blind == 0
    delay, frame = ROUGH.timing.delay, 1.0 / ROUGH.timing.fps
    for start, end in ((6.0, 7.0), (9.0, 9.5)):
        # The first that repeats is of the frame before; the effort shows in the next row.
        late = start - frame + delay + AnswerLimits().repeats_s + 2.0 * frame
        dark = [row for row in log.rows if late <= row.time_s < end + delay]
        assert dark
        assert all(row.forward == row.right == row.turn == 0.0 for row in dark)
        assert {row.reason for row in dark if row.time_s < end} == {GateReason.FROZEN.value}
        # There was thrust to end.
        assert any(row.forward != 0.0 for row in log.rows if start <= row.time_s < late)
    assert log.rows[-1].forward != 0.0


def test_log_tells_of_thrust_without_sight() -> None:
    log = LoopLog()
    log.note_sight(1.0, 1.5, thrusts=True)
    assert log.blind_thrust_s == [0.5]
    log.note_neutral(2.0, 2.16)
    log.note_sight(2.0, 2.6, thrusts=False)
    assert log.blind_thrust_s == pytest.approx([0.5, 0.16])
    log.note_sight(3.0, 3.1, thrusts=True)
    log.note_sight(4.0, 4.9, thrusts=False)
    assert log.n_blind == 3
    assert len(log.blind_thrust_s) == 2


def test_same_seed_gives_the_same_dive() -> None:
    one, other = (random_dive(MODEL, GAINS, 11).run(4.0) for _ in range(2))
    assert _same(one, other)
    different = random_dive(MODEL, GAINS, 12).run(4.0)
    assert not _same(one, different)


def _same(one: LoopLog, other: LoopLog) -> bool:
    columns = ("time_s", "range", "yaw", "measured_range", "forward", "turn", "depth")
    return all(
        np.array_equal(one.column(name), other.column(name), equal_nan=True) for name in columns
    )


def test_running_on_is_the_same_as_running_at_once() -> None:
    whole = loop_of(ROUGH).run(4.0)
    parts = loop_of(ROUGH)
    parts.run(2.0)
    assert _same(whole, parts.run(4.0))


def test_every_frame_may_end_the_run() -> None:
    log = loop_of(CALM).run(5.0, lambda now_s: now_s < 1.0)
    assert log.rows[-1].time_s < 1.0


def test_pilot_takes_over_by_changing_the_mode() -> None:
    loop = loop_of(ROUGH)
    loop.run(3.0)
    loop.link.vehicle.obeys = False
    log = loop.run(3.5)
    assert not log.rows[-1].engaged
    assert log.rows[-1].reason == "pilot_mode"
    assert loop.link.effort == Effort()


def test_csv_has_units_and_empty_cells(tmp_path: Path) -> None:
    log = loop_of(ROUGH, (Blind(0.5, 0.6),)).run(1.0)
    path = tmp_path / "truth.csv"
    write_log(log, path)
    with path.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(log.rows) == 26
    assert len(rows[0]) == len(LoopRow._fields)
    at = [row.refusal != "" for row in log.rows].index(True)
    assert rows[at]["measured_range_m"] == ""
    assert rows[at]["refusal"] == "too_few_points"
    assert float(rows[5]["yaw_deg"]) == pytest.approx(math.degrees(log.rows[5].yaw), abs=1e-3)
    assert float(rows[5]["range_m"]) == pytest.approx(log.rows[5].range, abs=1e-4)
    assert rows[20]["engaged"] == "1"


def test_a_vehicle_that_is_not_known_is_refused() -> None:
    with pytest.raises(OptionError, match="--vehicle submarine"):
        vehicle_model("submarine")
