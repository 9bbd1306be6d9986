"""How a log is laid on a dive's clock: by the user, by motion, by clocks, or not at all."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aqualvs.errors import OptionError, SourceError
from aqualvs.nets import places as net_log
from aqualvs.nets.places import DivePostures, align_log, open_log
from aqualvs.vehicle_logs.vehicle_log import VehicleLog
from net_app_cases import postures, vehicle_log

DURATION = 60.0
TRUE_S = 4.0
BEARING = 2.0
VIDEO = Path("dive.mp4")


def turn(t):
    """A vehicle's turning that never repeats itself: many sines without a common period."""
    rng = np.random.default_rng(3)
    found = np.zeros_like(t)
    for period in np.geomspace(2.5, 15.0, 12):
        found += 0.02 * np.sin(2 * np.pi * t / period + rng.uniform(0, 2 * np.pi))
    return found


@pytest.fixture
def moving() -> tuple[VehicleLog, DivePostures]:
    """A dive whose yaw shows the turning that its log has `TRUE_S` later on its own clock."""
    log = vehicle_log(
        DURATION, depth=lambda t: 5.0 + 0 * t, heading=lambda t: BEARING + turn(t - TRUE_S)
    )
    return log, postures(DURATION, yaw=lambda t: -turn(t))


@pytest.fixture
def still() -> tuple[VehicleLog, DivePostures]:
    """A dive that shows no motion, whose log knows the time of day."""
    log = vehicle_log(DURATION, depth=lambda t: 5.0 + 0 * t, heading=lambda t: BEARING + 0 * t)
    return replace(log, start_utc_s=1000.0, start_utc_sigma_s=0.5), postures(DURATION)


def test_motion_tells_the_offset(moving):
    log, dive = moving
    laid = align_log(log, dive, None, None)
    assert laid.offset.offset_s == pytest.approx(TRUE_S, abs=0.1)
    assert laid.places is not None
    assert laid.to_dict()["offset_s"] == pytest.approx(TRUE_S, abs=0.1)
    assert "motion" in laid.words()


def test_what_the_user_says_counts(moving):
    log, dive = moving
    laid = align_log(log, dive, 3.5, None)
    assert laid.places.offset_s == 3.5
    assert laid.to_dict()["offset_from"] == "given by the user"


def test_clocks_stand_in_where_motion_says_nothing(still, monkeypatch):
    monkeypatch.setattr(net_log, "dive_start_utc", lambda _: 1002.0)
    log, dive = still
    laid = align_log(log, dive, None, VIDEO)
    assert laid.places.offset_s == pytest.approx(2.0)
    assert laid.offset.sigma_s > 1.0
    assert "clocks" in laid.words()


def test_without_motion_and_clocks_the_log_is_not_used(still, monkeypatch):
    monkeypatch.setattr(net_log, "dive_start_utc", lambda _: None)
    log, dive = still
    laid = align_log(log, dive, None, VIDEO)
    assert laid.places is None
    assert "is not used" in laid.words()
    assert laid.to_dict() == {"file": "vehicle.csv", "used": False, "refused": laid.offset.reason}


def test_a_log_that_covers_none_of_the_dive_is_not_used(moving):
    log, dive = moving
    laid = align_log(log, dive, 500.0, None)
    assert laid.places is None
    assert "none of the dive" in laid.words()


def test_a_log_that_covers_a_part_of_the_dive_says_so(moving):
    log, dive = moving
    assert "covers" not in align_log(log, dive, 3.5, None).words()
    late = log.span_s[1] - 0.5 * dive.time_s[-1]
    laid = align_log(log, dive, late, None)
    assert laid.places is not None
    assert laid.words().endswith("(given by the user); it covers 50 % of the dive")
    assert laid.to_dict()["covered"] == pytest.approx(0.5, abs=0.01)


def test_a_dive_without_a_net_needs_no_offset(moving):
    log, _ = moving
    laid = align_log(log, postures(0.0), None, None)
    assert laid.places is None
    assert "\n" not in laid.words()


def test_logs_that_cannot_be_opened():
    assert open_log(None, None) is None
    with pytest.raises(OptionError, match="add --log"):
        open_log(None, 3.0)
    with pytest.raises(SourceError, match=r"nowhere\.csv"):
        open_log(Path("nowhere.csv"), None)
