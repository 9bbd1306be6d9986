"""The map of what was seen, and the log of what was done."""

import csv
import math
from pathlib import Path

import numpy as np
import pytest

from aqualvs.control.autopilot import Decision
from aqualvs.control.coverage import Across, Coverage, CoverageMap, CoverageOptions
from aqualvs.control.follow_log import FOLLOW_COLUMNS, FollowLog
from aqualvs.control.missions import Guidance, Stage
from aqualvs.control.safety import LimitReason
from aqualvs.control.vehicle import Effort, Setpoint
from aqualvs.errors import OptionError, OutputError
from aqualvs.scanning.posture import Reason as NoPosture
from aqualvs.scanning.posture import Refusal
from control_cases import FRAME_S, posture_at, state_at


def decided(sway: float = 0.2, reason: LimitReason | None = None) -> Decision:
    guidance = Guidance(setpoint=Setpoint(0.6, 0.1), sway=sway, stage=Stage.FOLLOWING)
    return Decision(Effort(forward=0.25, right=-0.5, yaw=0.125), reason, guidance, True)


def swum(
    seconds: float, options: CoverageOptions | None = None, *, heading: bool = True
) -> CoverageMap:
    """Swim along a net 4 m deep at 0.2 m/s, the bearing growing by 3 degrees a second from 350."""
    coverage = Coverage(options)
    for k in range(round(seconds / FRAME_S) + 1):
        now = FRAME_S * k
        told = math.radians(350.0 + 3.0 * now) if heading else None
        state = state_at(now, depth=4.0, heading=told)
        coverage.add(now, posture_at(0.5), decided(), state)
    return coverage.map()


def test_a_leg_covers_its_band_along_the_net() -> None:
    found = swum(10.0, heading=False)
    assert found.across is Across.ALONG
    # 2 m and 0.1 m to either side; 0.1 m above and below: 0.2 m at a range of 1 m.
    assert found.across_edges[[0, -1]] == pytest.approx([-0.1, 2.2])
    assert found.depth_edges[[0, -1]] == pytest.approx([3.9, 4.2])
    # A place in the middle is in view for as long as 0.2 to 0.3 m take at 0.2 m/s.
    middle = found.seconds[1, 10]
    assert 1.0 <= middle <= 1.5 + FRAME_S
    assert found.path[-1] == pytest.approx([10.0, 2.0, 4.0])


def test_bearings_go_on_through_north() -> None:
    found = swum(10.0)
    assert found.across is Across.BEARING
    assert np.degrees(found.across_edges[[0, -1]]) == pytest.approx([350.0, 381.0], abs=1.01)
    seen = np.flatnonzero(found.seconds.sum(axis=0) > 0.0)
    assert len(seen) >= 30


def test_more_than_a_turn_is_folded() -> None:
    found = swum(150.0)
    assert np.degrees(found.across_edges[[0, -1]]) == pytest.approx([0.0, 360.0], abs=1.01)
    # The part that was passed twice was in view longer.
    across = found.seconds.max(axis=0)
    assert across.max() > 1.8 * across.min()


def test_a_radius_widens_what_is_seen() -> None:
    thin, wide = swum(1.0), swum(1.0, CoverageOptions(radius=2.0))
    # 0.1 m to either side at 2 m: 2.9 degrees.
    gained = np.degrees(np.ptp(wide.across_edges) - np.ptp(thin.across_edges))
    assert gained == pytest.approx(5.7, abs=2.0)


def test_nothing_is_seen_without_a_posture_or_a_depth() -> None:
    coverage = Coverage()
    for k in range(50):
        now = FRAME_S * k
        refused = Refusal(NoPosture.NO_STRIPES)
        coverage.add(now, refused, decided(), state_at(now))
        coverage.add(now, posture_at(), decided(), state_at(now, depth=None))
    found = coverage.map()
    assert found.seconds.size == 0


def test_a_gap_does_not_count() -> None:
    coverage = Coverage()
    for now in (0.0, 100.0, 100.04):
        coverage.add(now, posture_at(0.5), decided(), state_at(now, heading=None))
    assert coverage.map().seconds.max() <= 0.04 + 1e-9


def test_sizes_that_cannot_be_are_refused() -> None:
    with pytest.raises(OptionError, match="coverage"):
        CoverageOptions(depth_cell=0.0)
    with pytest.raises(OptionError, match="radius"):
        CoverageOptions(radius=-1.0)


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_the_log_tells_posture_setpoint_errors_effort_and_reason(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "follow.csv"
    with FollowLog(path) as log:
        state = state_at(2.0, depth=4.125, heading=math.radians(30.0), mode_name="ALT_HOLD")
        log.write(2.0, 1.5, posture_at(0.65, 0.2), decided(), state)
        lost = Refusal(NoPosture.NO_STRIPES)
        log.write(
            2.04, 1.54, lost, decided(reason=LimitReason.NO_POSTURE), state_at(2.04, depth=None)
        )
        # On disk at once, while the log is open.
        first, second = rows(path)
    assert tuple(first) == FOLLOW_COLUMNS
    assert (first["posture"], first["reason"], first["mode"]) == ("valid", "", "ALT_HOLD")
    assert float(first["range_error_m"]) == pytest.approx(0.05)
    assert float(first["yaw_error_deg"]) == pytest.approx(math.degrees(0.1), abs=1e-3)
    assert float(first["bearing_deg"]) == pytest.approx(30.0 + math.degrees(0.2), abs=1e-3)
    efforts = [float(first[name]) for name in ("forward", "right", "down", "yaw")]
    assert efforts == [0.25, -0.5, 0.0, 0.125]
    assert (second["posture"], second["reason"]) == ("no_stripes", "no_posture")
    assert second["range_m"] == second["range_error_m"] == second["depth_m"] == ""


def test_a_log_that_cannot_be_written_says_so(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        FollowLog(tmp_path / "file" / "follow.csv")
