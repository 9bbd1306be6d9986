"""Measures of simulated runs, on made-up curves whose answers are known."""

import math

import numpy as np
import pytest

from aqualvs.follow.log import (
    LoopLog,
    LoopRow,
    effort_measures,
    hold_measures,
    safety_measures,
    step_measures,
    thruster_measures,
)

NAN = math.nan
ROW = LoopRow(
    **dict.fromkeys(LoopRow._fields[:-4], 0.0), engaged=True, stage="holding", reason="", refusal=""
)


def log_of(ranges: np.ndarray, measured: np.ndarray | None = None) -> LoopLog:
    """Rows at 25 Hz about a setpoint of 0.6 m."""
    seen = ranges if measured is None else measured
    rows = [
        ROW._replace(
            time_s=0.04 * i,
            range=r,
            measured_range=m,
            wanted_range=0.6,
            wanted_yaw=0.0,
            clearance=r,
        )
        for i, (r, m) in enumerate(zip(ranges.tolist(), seen.tolist(), strict=True))
    ]
    return LoopLog(rows=rows)


def test_hold_measures_of_a_sine() -> None:
    time_s = 0.04 * np.arange(1000)
    log = log_of(0.6 + 0.02 * np.sin(2.0 * np.pi * time_s / 4.0))
    log.rows[700] = log.rows[700]._replace(refusal="no_target", reason="no_posture")
    found = hold_measures(log, 10.0, 30.0)
    # Whole periods: the rms of a sine is its amplitude over root 2.
    assert found.range_rms == pytest.approx(0.02 / math.sqrt(2.0), rel=0.01)
    assert found.range_worst == pytest.approx(0.02, rel=0.01)
    assert found.min_clearance == pytest.approx(0.58, abs=1e-4)
    assert (found.n_lost, found.n_guarded) == (1, 1)


def test_rows_without_a_setpoint_count_against_the_last_one() -> None:
    log = log_of(np.full(100, 0.63))
    log.rows[0] = log.rows[0]._replace(wanted_range=NAN, wanted_yaw=NAN)
    log.rows[50:] = [row._replace(wanted_range=NAN, wanted_yaw=NAN) for row in log.rows[50:]]
    assert hold_measures(log, 0.0).range_rms == pytest.approx(0.03)


@pytest.mark.parametrize("damping", [0.3, 0.6, 0.9])
def test_step_measures_of_a_second_order_answer(damping: float) -> None:
    time_s = np.arange(0.0, 30.0, 0.01)
    after = np.maximum(time_s - 5.0, 0.0)
    root = math.sqrt(1.0 - damping**2)
    swing = np.cos(root * after) + damping / root * np.sin(root * after)
    share = np.where(after > 0.0, 1.0 - np.exp(-damping * after) * swing, 0.0)
    found = step_measures(time_s, 0.6 + 0.2 * share, 5.0, 0.6, 0.8)
    assert found.overshoot == pytest.approx(math.exp(-math.pi * damping / root), abs=1e-3)
    # Beyond the settling time the curve stays in the band, just before it is outside.
    here = after > found.settling + 0.011
    assert np.all(np.abs(share[here] - 1.0) <= 0.1)
    assert abs(np.interp(5.0 + found.settling - 0.01, time_s, share) - 1.0) > 0.1


def test_a_step_downwards_is_measured_the_same_way() -> None:
    time_s = np.arange(0.0, 10.0, 0.1)
    ranges = np.where(time_s > 2.0, 0.6 - 0.01 * np.exp(-(time_s - 2.0)), 0.8)
    found = step_measures(time_s, ranges, 2.0, 0.8, 0.6)
    assert found.settling == 0.0
    assert found.overshoot == pytest.approx(0.05, abs=0.006)


def test_a_step_that_never_settles() -> None:
    time_s = np.arange(0.0, 10.0, 0.1)
    found = step_measures(time_s, np.full(100, 0.6), 2.0, 0.6, 0.8)
    assert math.isinf(found.settling)
    assert found.overshoot == 0.0


def test_growing_swings_are_unstable() -> None:
    time_s = 0.04 * np.arange(1000)
    wave = np.sin(2.0 * np.pi * time_s / 4.0)
    steady = safety_measures(log_of(0.6 + 0.05 * wave))
    growing = safety_measures(log_of(0.6 + 0.002 * np.exp(0.12 * time_s) * wave))
    assert steady.stable
    assert not growing.stable


def test_contact_and_loss_are_told() -> None:
    ranges = np.concatenate([np.full(500, 0.6), np.linspace(0.6, -0.1, 100)])
    seen = ranges.copy()
    seen[520:] = NAN
    found = safety_measures(log_of(ranges, seen))
    assert found.contact
    assert found.lost_s == pytest.approx(0.04 * 519)
    # What happens after the loss is no swing of the loop.
    assert found.stable
    short = safety_measures(log_of(np.full(600, 0.6)))
    assert not short.contact
    assert math.isinf(short.lost_s)


def test_only_frames_at_which_efforts_pass_are_steered() -> None:
    """Half of the frames are steered: a gate that brakes steers, one that stops does not."""
    steered = [
        ROW,
        ROW._replace(stage="following"),
        ROW._replace(reason="too_fast"),
        ROW._replace(stage="over", reason="mission_over"),
    ]
    not_steered = [
        ROW._replace(engaged=False),
        ROW._replace(stage=""),
        ROW._replace(stage="waiting"),
        ROW._replace(reason="frozen"),
    ]
    assert safety_measures(LoopLog(steered)).steered_share == 1.0
    assert safety_measures(LoopLog(not_steered)).steered_share == 0.0
    assert safety_measures(LoopLog(steered + not_steered)).steered_share == 0.5


def test_late_neutral_is_told() -> None:
    log = log_of(np.full(100, 0.6))
    log.blind_thrust_s = [0.15, 0.21]
    found = safety_measures(log)
    assert found.neutral_late == 0.21


def test_reversals_and_jumps_of_an_effort() -> None:
    # Four frames a second for two minutes: every second up, down, at rest, down.
    efforts = (0.2, -0.1, 0.0, -0.1)
    rows = [ROW._replace(time_s=0.25 * k, forward=efforts[k % 4]) for k in range(481)]
    found = effort_measures(LoopLog(rows), "forward")
    # Up to down and back again; neutral between two downs is none.
    assert found.reversals == pytest.approx(120.0)
    assert found.jumps == pytest.approx(120.0)
    assert effort_measures(LoopLog(rows), "turn").reversals == 0.0


def test_a_forward_effort_that_no_thruster_turns_round_for() -> None:
    """Along a net the pairs push against each other; the worse of them counts."""
    rows = [ROW._replace(time_s=0.25 * k, forward=0.1 * (-1) ** k, right=0.3) for k in range(481)]
    assert effort_measures(LoopLog(rows), "forward").reversals == pytest.approx(240.0)
    assert thruster_measures(LoopLog(rows)).reversals == 0.0
    slow = [row._replace(right=0.05) for row in rows]
    assert thruster_measures(LoopLog(slow)).reversals == pytest.approx(240.0)
    one = [row._replace(right=row.forward) for row in rows]
    assert thruster_measures(LoopLog(one)).reversals == pytest.approx(240.0)
    assert thruster_measures(LoopLog(one)).jumps == pytest.approx(240.0)
