"""Signals, CSV logs, and the places that a log and a dive tell together."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aqualvs.errors import OptionError, SourceError
from aqualvs.vehicle_logs import Interpolation, Signal, VehicleLog, VehiclePlaces, read_vehicle_log
from aqualvs.vehicle_logs.vehicle_log import bearing_of, ned_from_dome_of, wrap

TABLE = "time_s,depth_m,heading_deg\n0,1,350\n1,2,10\n2,3,30\n"


def written(folder: Path, text: str, name: str = "log.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def a_signal(times: list[float], values: list[float], kind: Interpolation) -> Signal:
    signal = Signal.from_samples(times, values, kind)
    assert signal is not None
    return signal


def test_between_samples_values_change_evenly() -> None:
    signal = a_signal([0.0, 1.0, 2.0], [0.0, 10.0, 0.0], Interpolation.LINEAR)
    values, valid = signal.at([2.0, 0.25, 1.5])
    assert valid.all()
    np.testing.assert_allclose(values, [0.0, 2.5, 5.0])


def test_outside_the_samples_nothing_is_told() -> None:
    values, valid = a_signal([1.0, 2.0], [5.0, 6.0], Interpolation.LINEAR).at([0.99, 2.01])
    assert not valid.any()
    assert np.isnan(values).all()


def test_gaps_are_not_bridged_but_their_edges_are_known() -> None:
    times = [0.0, 0.1, 0.2, 0.3, 5.0, 5.1, 5.2]
    signal = a_signal(times, times, Interpolation.LINEAR)
    _, valid = signal.at([0.15, 0.3, 0.31, 4.0, 5.0, 5.05])
    assert valid.tolist() == [True, True, False, False, True, True]


def test_one_lost_sample_in_a_row_is_no_gap() -> None:
    times = np.delete(np.arange(0.0, 10.0, 0.3), [7, 8])
    signal = a_signal(list(times), list(times), Interpolation.LINEAR)
    assert signal.at([7 * 0.3, 8 * 0.3])[1].all()


@given(
    first=st.floats(0.0, 2.0 * math.pi, exclude_max=True),
    step=st.floats(-3.1, 3.1),
    share=st.floats(0.0, 1.0),
)
def test_bearings_go_the_shorter_way_round(first: float, step: float, share: float) -> None:
    second = float(bearing_of(np.array([first + step]))[0])
    signal = a_signal([0.0, 1.0], [first, second], Interpolation.BEARING)
    values, valid = signal.at([share])
    assert valid.all()
    assert 0.0 <= values[0] < 2.0 * math.pi
    # A few roundings of numbers up to 2 pi.
    assert abs(wrap(values - (first + share * step))[0]) < 1e-12


def test_samples_without_place_or_value_are_left_out() -> None:
    signal = a_signal(
        [0.0, 1.0, 1.0, 0.5, 2.0, 3.0], [0, 1, 7, 7, math.nan, 3], Interpolation.LINEAR
    )
    assert signal.time_s.tolist() == [0.0, 1.0, 3.0]
    assert signal.values.tolist() == [0.0, 1.0, 3.0]
    assert Signal.from_samples([], []) is None
    assert Signal.from_samples([0.0], [math.nan]) is None


def test_a_table_is_read_in_any_order_of_columns(tmp_path: Path) -> None:
    text = "pitch_deg,heading_deg,note,time_s,roll_deg,depth_m\n5,-10,hello,7,,1.5\n6,10,,8,2,2.5\n"
    log = read_vehicle_log(written(tmp_path, text, "telemetry.txt"))
    assert log.kind == "csv"
    state = log.at([7.0, 7.5, 8.0])
    np.testing.assert_allclose(np.rad2deg(state.heading), [350.0, 0.0, 10.0], atol=1e-9)
    np.testing.assert_allclose(np.rad2deg(state.pitch), [5.0, 5.5, 6.0])
    np.testing.assert_allclose(state.depth, [1.5, 2.0, 2.5])
    assert state.roll_valid.tolist() == [False, False, True]
    assert log.notes == ("columns not used: note",)
    assert log.start_utc_s is None
    assert log.sources["heading"] == "column heading_deg"


def test_utc_is_kept(tmp_path: Path) -> None:
    text = (
        "time,depth_m\n2026-05-31T12:00:00Z,1\n2026-05-31T12:00:00.500,2\n"
        "2026-05-31T14:00:01+02:00,3\n"
    )
    log = read_vehicle_log(written(tmp_path, text))
    assert log.start_utc_s == 1780228800.0
    assert log.depth is not None
    assert log.depth.time_s.tolist() == [0.0, 0.5, 1.0]
    assert log.heading is None


def test_a_table_that_ends_within_a_line_is_read_up_to_there(tmp_path: Path) -> None:
    log = read_vehicle_log(written(tmp_path, TABLE + "3,4"))
    assert log.span_s == (0.0, 2.0)
    assert log.notes == ("line 5, the last, is cut short and left out",)


def test_repeated_times_are_left_out_and_told(tmp_path: Path) -> None:
    log = read_vehicle_log(written(tmp_path, TABLE + "2,9,9\n3,4,50\n"))
    assert log.depth is not None
    assert log.depth.values.tolist() == [1.0, 2.0, 3.0, 4.0]
    assert "1 rows repeat" in log.notes[0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        ("time_s,depth_m,heading_deg\n", "holds no rows"),
        (TABLE.replace(",", ";"), "separated by semicolons"),
        (TABLE.replace("time_s", "t"), "no column of times"),
        (TABLE.replace("time_s", "time_ms"), "'time_ms' is not known; write it as time_s"),
        (TABLE.replace("depth_m", "depth"), "'depth' is not known; write it as depth_m"),
        (TABLE.replace("depth_m", "Depth_cm"), "'Depth_cm' is not known; write it as depth_m"),
        (
            TABLE.replace("heading_deg", "yaw_rad"),
            "'yaw_rad' is not known; write it as heading_deg",
        ),
        (TABLE.replace("depth_m", "a").replace("heading_deg", "b"), "neither depth_m nor heading"),
        (TABLE.replace("heading_deg", "time"), "has time_s and time"),
        (TABLE.replace("heading_deg", "depth_m"), "column depth_m appears twice"),
        (TABLE.replace("2,10", "2,north"), "line 3: heading_deg is 'north'; write a plain number"),
        (TABLE.replace("2,10", "2,4000"), "line 3: heading_deg is '4000'; write the value in deg"),
        (TABLE.replace("1,2,10", "1,inf,10"), "line 3: depth_m is 'inf'; write the value in m"),
        (TABLE.replace("1,2,10", ",2,10"), "line 3 has no time_s"),
        (TABLE.replace("1,2,10", "1,2"), "line 3 has 2 values for 3 columns"),
        (TABLE.replace("2,3,30", "0.5,3,30"), "line 4: the time goes back by 0.5 s"),
        ("time_s,depth_m\n0,-5\n1,-6\n2,-5\n", "line 3: depth_m is -6, above the surface"),
        ("time,depth_m\nnoon,1\n", "line 2: time is 'noon'; write UTC as 2026-"),
        ("time_s,depth_m\n0,\n1,\n", "holds neither depth nor heading"),
        ("ULog\x01", "is a PX4 log"),
        ("\x00\x01\x02", "is no MAVLink telemetry log"),
    ],
)
def test_faults_of_a_table_are_told_in_one_line(tmp_path: Path, text: str, words: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(SourceError) as fault:
        read_vehicle_log(path)
    message = str(fault.value)
    assert message.startswith(f"{path}: ")
    assert words in message
    assert "\n" not in message


def test_files_that_cannot_be_read_are_told(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no such file"):
        read_vehicle_log(tmp_path / "missing.csv")
    with pytest.raises(SourceError, match="is a folder"):
        read_vehicle_log(tmp_path)
    path = tmp_path / "latin.csv"
    path.write_bytes(TABLE.encode() + b"\xe9\n")
    with pytest.raises(SourceError, match="UTF-8"):
        read_vehicle_log(path)


def test_attitude_turns_dome_axes_as_mavlink_says() -> None:
    right, forward, up = np.moveaxis(ned_from_dome_of([0.3], [0.2], [0.0]), -1, 0)
    np.testing.assert_allclose(
        forward[0], [math.cos(0.2) * math.cos(0.3), math.cos(0.2) * math.sin(0.3), -math.sin(0.2)]
    )
    np.testing.assert_allclose(right[0], [-math.sin(0.3), math.cos(0.3), 0.0], atol=1e-15)
    np.testing.assert_allclose(np.cross(right[0], forward[0]), up[0], atol=1e-15)
    # Rolled to the right, the right side points down.
    assert ned_from_dome_of([0.0], [0.0], [0.1])[0, 2, 0] == pytest.approx(math.sin(0.1))


def log_of(heading: float, pitch: float, roll: float) -> VehicleLog:
    times = [0.0, 10.0]
    return VehicleLog(
        name="log",
        kind="csv",
        depth=Signal(np.array(times), np.array([2.0, 4.0]), Interpolation.LINEAR, 20.0),
        heading=Signal(np.array(times), np.full(2, heading), Interpolation.BEARING, 20.0),
        pitch=Signal(np.array(times), np.full(2, pitch), Interpolation.ANGLE, 20.0),
        roll=Signal(np.array(times), np.full(2, roll), Interpolation.ANGLE, 20.0),
    )


def rotation(axis: int, angle: float) -> np.ndarray:
    """Right-handed rotation about one axis, written out for the test alone."""
    c, s = math.cos(angle), math.sin(angle)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    matrix = np.eye(3)
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
    return matrix


@settings(max_examples=200)
@given(
    heading=st.floats(0.0, 6.28),
    pitch=st.floats(-0.5, 0.5),
    roll=st.floats(-0.5, 0.5),
    bearing_off=st.floats(-0.5, 0.5),
    lean=st.floats(-0.4, 0.4),
)
def test_a_scene_gives_back_where_its_net_hangs(
    heading: float, pitch: float, roll: float, bearing_off: float, lean: float
) -> None:
    bearing = heading + bearing_off
    far_normal_in_ned = np.array(
        [math.cos(lean) * math.cos(bearing), math.cos(lean) * math.sin(bearing), -math.sin(lean)]
    )
    # MAVLink's body axes: heading about down, then pitch about right, then roll about forward.
    ned_from_body = rotation(2, heading) @ rotation(1, pitch) @ rotation(0, roll)
    forward, right, down = ned_from_body.T @ far_normal_in_ned
    x, y, z = right, forward, -down
    # docs/conventions.md, with the far normal in `dome`.
    yaw, tilt = math.atan2(x, y), math.atan2(z, y)
    places = VehiclePlaces(log_of(heading, pitch, roll), 3.0).at([2.0], [yaw], [tilt])
    assert places.bearing_valid.all()
    assert places.lean_valid.all()
    # Rounding only.
    assert abs(wrap(places.bearing - bearing)[0]) < 1e-9
    assert places.lean[0] == pytest.approx(lean, abs=1e-9)
    assert places.depth[0] == pytest.approx(3.0)
    np.testing.assert_allclose(places.ned_from_dome[0] @ [x, y, z], far_normal_in_ned, atol=1e-12)


def test_level_the_net_bears_heading_plus_yaw() -> None:
    log = log_of(math.radians(350.0), 0.0, 0.0)
    places = VehiclePlaces(log).at([0.0], [math.radians(15.0)], [0.0])
    assert math.degrees(places.bearing[0]) == pytest.approx(5.0)


def test_places_are_masked_where_log_or_posture_does_not_tell() -> None:
    places = VehiclePlaces(log_of(1.0, 0.0, 0.0), -1.0)
    at = places.at([0.5, 2.0, 3.0, 4.0], [0.1, 0.1, math.nan, 0.1], 4 * [0.0], [1, 1, 1, 0])
    assert at.depth_valid.tolist() == [False, True, True, True]
    assert at.bearing_valid.tolist() == [False, True, False, False]
    assert np.isfinite(at.bearing).tolist() == at.bearing_valid.tolist()
    assert not places.at([2.0], [0.1], [math.nan]).bearing_valid.any()


def test_without_attitude_the_vehicle_counts_as_level() -> None:
    whole = log_of(1.0, 0.2, 0.0)
    bare = VehicleLog(name="log", kind="csv", heading=whole.heading)
    at = VehiclePlaces(bare).at([1.0], [0.2], [0.1])
    assert at.level.all()
    assert at.bearing[0] == pytest.approx(1.2)
    assert not at.depth_valid.any()
    assert not at.lean_valid.any()


def test_an_offset_must_be_a_number() -> None:
    with pytest.raises(OptionError, match="time offset is nan"):
        VehiclePlaces(log_of(0.0, 0.0, 0.0), math.nan)
