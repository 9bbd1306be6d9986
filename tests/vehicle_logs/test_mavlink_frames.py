"""Telemetry and dataflash logs: written here byte by byte, damaged, and real ones."""

import math
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from aqualvs.errors import SourceError
from aqualvs.vehicle_logs import VehicleLog, read_vehicle_log
from aqualvs.vehicle_logs.mavlink_frames import MESSAGES, read_frames

START_US = 1_700_000_000_000_000
SEEDS = {0: 50, 30: 39, 33: 104, 74: 20, 137: 195}
SUB = (12, 3)


def crc16(data: bytes) -> int:
    """CRC-16/MCRF4XX as MAVLink's guide writes it, bit by bit."""
    crc = 0xFFFF
    for octet in data:
        crc ^= octet
        for _ in range(8):
            crc = crc >> 1 ^ 0x8408 if crc & 1 else crc >> 1
    return crc


def record(
    received_s: float,
    number: int,
    payload: bytes,
    *,
    sender: tuple[int, int] = (1, 1),
    version: int = 2,
    signed: bool = False,
) -> bytes:
    """Return one record of a telemetry log."""
    if version == 2:
        payload = payload.rstrip(b"\0") or b"\0"
        head = struct.pack("<BBBB2B", len(payload), int(signed), 0, 7, *sender)
        body = head + number.to_bytes(3, "little") + payload
    else:
        body = struct.pack("<BB2BB", len(payload), 7, *sender, number) + payload
    check = crc16(body + bytes([SEEDS[number]]))
    frame = bytes([0xFD if version == 2 else 0xFE]) + body + struct.pack("<H", check)
    stamp = struct.pack(">Q", START_US + round(1e6 * received_s))
    return stamp + frame + (b"s" * 13 if signed else b"")


def attitude(boot_s: float, yaw: float, roll: float = 0.1, pitch: float = -0.05) -> bytes:
    return struct.pack("<Iffffff", round(1e3 * boot_s), roll, pitch, yaw, 0.0, 0.0, 0.0)


def position(boot_s: float, altitude_m: float, heading_cdeg: int = 0) -> bytes:
    height = round(1e3 * altitude_m)
    return struct.pack(
        "<IiiiihhhH", round(1e3 * boot_s), 0, 0, 0, height, 10, -20, 30, heading_cdeg
    )


def heartbeat(mode: int, armed: bool, kind: tuple[int, int] = SUB) -> bytes:
    return struct.pack("<IBBBBB", mode, *kind, 128 if armed else 0, 4, 3)


def pressure(boot_s: float, hectopascals: float) -> bytes:
    return struct.pack("<Iffh", round(1e3 * boot_s), hectopascals, 0.0, 1000)


def hud(altitude_m: float, heading_deg: int) -> bytes:
    return struct.pack("<ffffhH", 0.0, 0.0, altitude_m, 0.0, heading_deg, 0)


def telemetry(n: int = 100, boot_0: float = 50.0, **how: object) -> list[bytes]:
    """Records of a dive: 10 Hz attitude, 2 Hz position, 1 Hz heartbeat."""
    records = []
    for i in range(n):
        t = 0.1 * i
        # A tether that delays every message by another time, never by less than 20 ms.
        late = 0.02 + 0.05 * (i * 7 % 10)
        records.append(record(t + late, 30, attitude(boot_0 + t, 0.05 * t), **how))
        if i % 5 == 0:
            records.append(record(t + late, 33, position(boot_0 + t, -t), **how))
        if i % 10 == 0:
            records.append(record(t + late, 0, heartbeat(19 if t < 5 else 2, t >= 3), **how))
    return records


def logged(folder: Path, data: bytes, name: str = "dive.dat") -> VehicleLog:
    path = folder / name
    path.write_bytes(data)
    return read_vehicle_log(path)


@pytest.mark.parametrize("how", [{}, {"version": 1}, {"signed": True}])
def test_a_telemetry_log_is_read(tmp_path: Path, how: dict[str, object]) -> None:
    log = logged(tmp_path, b"".join(telemetry(**how)))
    assert log.kind == "tlog"
    assert log.notes == ()
    state = log.at([0.0, 2.55, 9.85])
    # The position's own 2 Hz, so that the last one is at 9.5 s.
    assert state.depth_valid.tolist() == [True, True, False]
    np.testing.assert_allclose(state.depth[:2], [0.0, 2.55], atol=1e-3)
    # float32 of the message.
    np.testing.assert_allclose(state.heading, [0.0, 0.1275, 0.4925], atol=1e-6)
    np.testing.assert_allclose(state.roll, 0.1, atol=1e-6)
    np.testing.assert_allclose(state.pitch, -0.05, atol=1e-6)
    assert log.start_utc_s == pytest.approx(START_US / 1e6 + 0.02, abs=1e-3)


def test_both_versions_of_mavlink_may_alternate(tmp_path: Path) -> None:
    first, second = telemetry(), telemetry(version=1)
    mixed = [pair[i % 2] for i, pair in enumerate(zip(first, second, strict=True))]
    log = logged(tmp_path, b"".join(mixed))
    assert log.heading is not None
    assert len(log.heading.time_s) == 100


def test_only_the_autopilot_of_the_vehicle_is_read(tmp_path: Path) -> None:
    records = telemetry()
    others = [record(0.1 * i, 30, attitude(900.0 + i, 3.0), sender=(1, 191)) for i in range(300)]
    others += [record(0.1, 0, heartbeat(0, True, (6, 8)), sender=(255, 190))]
    others += [record(0.2, 0, heartbeat(0, True, (18, 8)), sender=(1, 191))]
    log = logged(tmp_path, b"".join(others[:150] + records + others[150:]))
    assert log.heading is not None
    assert log.heading.values.max() < 0.6
    assert log.notes == ()


def test_of_several_vehicles_the_one_that_speaks_most_is_read(tmp_path: Path) -> None:
    log = logged(tmp_path, b"".join(telemetry(20) + telemetry(100, sender=(2, 1))))
    assert log.notes == ("vehicles 1, 2 speak; 2 is read, which speaks most",)
    assert log.span_s[1] == pytest.approx(9.9)


def test_without_attitude_the_next_best_heading_is_taken(tmp_path: Path) -> None:
    beats = [record(0.0, 0, heartbeat(0, False))]
    places = [record(i, 33, position(10.0 + i, -1.0, 9000 if i else 65535)) for i in range(4)]
    log = logged(tmp_path, b"".join(beats + places))
    assert log.sources["heading"] == "GLOBAL_POSITION_INT.hdg"
    assert log.heading is not None
    assert log.heading.time_s.tolist() == [1.0, 2.0, 3.0]
    np.testing.assert_allclose(log.heading.values, math.pi / 2)
    huds = [record(float(i), 74, hud(-3.0, 180)) for i in range(4)]
    log = logged(tmp_path, b"".join(beats + huds))
    assert log.sources["heading"].startswith("VFR_HUD.heading")
    assert log.sources["depth"] == "VFR_HUD.alt"
    assert log.at([1.0]).depth[0] == 3.0
    assert log.at([1.0]).heading[0] == pytest.approx(math.pi)


def test_a_depth_that_stands_still_under_pressure_is_not_believed(tmp_path: Path) -> None:
    records = []
    for i in range(60):
        records += [
            record(float(i), 0, heartbeat(0, False)),
            record(float(i), 33, position(10.0 + i, 0.0)),
            record(float(i), 137, pressure(10.0 + i, 1013.0 + 10.0 * i)),
            record(float(i), 74, hud(-0.1 * i, 0)),
        ]
    log = logged(tmp_path, b"".join(records))
    assert log.sources["depth"] == "VFR_HUD.alt"
    assert log.notes[0].startswith("GLOBAL_POSITION_INT.relative_alt stands still while")


def test_a_restart_of_the_autopilot_keeps_one_clock(tmp_path: Path) -> None:
    before = telemetry()
    after = [record(20.02 + 0.1 * i, 30, attitude(2.0 + 0.1 * i, 1.0)) for i in range(50)]
    log = logged(tmp_path, b"".join(before + after))
    assert log.notes == ("the autopilot restarted 1 times",)
    assert log.heading is not None
    # Both runs' fastest messages are 20 ms late.
    assert log.heading.time_s[100] == pytest.approx(20.0, abs=1e-3)
    assert np.count_nonzero(np.diff(log.heading.time_s) > log.heading.max_gap_s) == 1


def test_a_step_of_the_computers_clock_is_told_and_does_not_matter(tmp_path: Path) -> None:
    early = telemetry(1000)
    late = [record(3700.0 + 0.1 * i, 30, attitude(150.0 + 0.1 * i, 0.0)) for i in range(900)]
    log = logged(tmp_path, b"".join(early + late))
    assert log.span_s[1] == pytest.approx(189.9)
    assert "clock was set by +3600.0 s at about 1" in log.notes[0]
    assert log.start_utc_sigma_s is not None
    assert log.start_utc_sigma_s > 3000.0


def test_a_damaged_telemetry_log_loses_little(tmp_path: Path) -> None:
    records = telemetry(300)
    data = bytearray(b"".join(records))
    del data[5000:5100]
    data[9000:9000] = b"noise" * 30
    data[12000] ^= 0xFF
    log = logged(tmp_path, bytes(data[:-7]))
    assert log.heading is not None
    assert 285 <= len(log.heading.time_s) < 300
    assert log.heading.values.max() < 1.5
    assert any("are left out, the first at byte" in note for note in log.notes)


def test_lost_bytes_cost_the_record_they_are_lost_from_and_no_other(tmp_path: Path) -> None:
    records = telemetry(300)
    # Two attitudes in a row, the first of which loses five bytes.
    records[150:150] = [
        record(0.1, 30, attitude(50.1, 2.0))[:-5],
        record(0.1, 30, attitude(50.1, 2.0)),
    ]
    frames = read_frames(b"".join(records))
    assert len(frames.tables["ATTITUDE"].at) == 301
    parts = dataflash()
    i = next(k for k in range(60, 100) if parts[k][2] == 1)
    parts[i] = parts[i][:-5]
    log = logged(tmp_path, b"".join(parts))
    assert log.heading is not None
    assert log.depth is not None
    assert (len(log.heading.time_s), len(log.depth.time_s)) == (99, 100)


def test_a_flipped_bit_is_caught_by_the_checksum() -> None:
    data = bytearray(b"".join(telemetry(20)))
    sound = read_frames(bytes(data))
    # In the yaw of the first attitude.
    data[8 + 10 + 12] ^= 1
    frames = read_frames(bytes(data))
    assert frames.n_failed == 1
    assert len(frames.tables["ATTITUDE"].at) == len(sound.tables["ATTITUDE"].at) - 1


def test_a_log_without_autopilot_is_refused(tmp_path: Path) -> None:
    records = [
        record(float(i), 0, heartbeat(0, False, (6, 8)), sender=(255, 190)) for i in range(9)
    ]
    with pytest.raises(SourceError, match="no depth or attitude from an autopilot in 9 messages"):
        logged(tmp_path, b"".join(records))


FORMATS = {
    "FMT": (128, "BBnNZ", "Type,Length,Name,Format,Columns"),
    "ATT": (1, "QccC", "TimeUS,Roll,Pitch,Yaw"),
    "CTUN": (2, "Qff", "TimeUS,Alt,BAlt"),
    "BARO": (3, "QBf", "TimeUS,I,Alt"),
    "XKF1": (4, "QBffff", "TimeUS,C,VN,VE,VD,PD"),
    "GPS": (5, "QBIH", "TimeUS,Status,GMS,GWk"),
    "ARM": (6, "QB", "TimeUS,ArmState"),
    "MODE": (7, "QMB", "TimeUS,Mode,ModeNum"),
    "RTC": (8, "QQ", "TimeUS,Epoch"),
}
PACKED = {
    "Q": "Q",
    "B": "B",
    "M": "B",
    "c": "h",
    "C": "H",
    "f": "f",
    "n": "4s",
    "N": "16s",
    "Z": "64s",
}
PACKED |= {"I": "I", "H": "H"}


def entry(name: str, *values: object) -> bytes:
    number, codes, _ = FORMATS[name]
    return b"\xa3\x95" + struct.pack("<B" + "".join(PACKED[c] for c in codes), number, *values)


def formats() -> list[bytes]:
    records = []
    for name, (number, codes, columns) in FORMATS.items():
        length = 3 + struct.calcsize("<" + "".join(PACKED[c] for c in codes))
        texts = (name.encode(), codes.encode(), columns.encode())
        records.append(entry("FMT", number, length, *texts))
    return records


def dataflash(n: int = 100, boot_us: int = 60_000_000) -> list[bytes]:
    records = formats()
    records.append(entry("MODE", boot_us, 19, 19))
    records.append(entry("ARM", boot_us + 3_000_000, 1))
    for i in range(n):
        now = boot_us + 100_000 * i
        yaw = (35900 + 20 * i) % 36000
        records.append(entry("ATT", now, -150, 250, yaw))
        records.append(entry("CTUN", now, -0.1 * i, -0.1 * i - 0.02))
        records.append(entry("XKF1", now, 0, 0.1, 0.2, 0.3, 0.1 * i))
        records.append(entry("XKF1", now, 1, 9.0, 9.0, 9.0, 9.0))
    return records


def test_a_column_without_a_name_costs_its_own_kind_of_records_only(tmp_path: Path) -> None:
    data = b"".join(dataflash())
    assert b"Roll,Pitch,Yaw" in data
    log = logged(tmp_path, data.replace(b"Roll,Pitch,Yaw", b"Roll,,Yaw\0\0\0\0\0"))
    assert log.sources["depth"] == "CTUN.Alt"
    assert "heading" not in log.sources or not log.sources["heading"].startswith("ATT")


def test_a_dataflash_log_is_read(tmp_path: Path) -> None:
    data = b"".join(dataflash())
    log = logged(tmp_path, data)
    assert log.kind == "dataflash"
    assert log.notes == ()
    assert log.sources["depth"] == "CTUN.Alt"
    state = log.at([0.0, 5.0, 9.85])
    np.testing.assert_allclose(state.depth, [0.0, 5.0, 9.85], atol=1e-5)
    np.testing.assert_allclose(np.rad2deg(state.heading), [359.0, 9.0, 18.7], atol=1e-9)
    np.testing.assert_allclose(np.rad2deg(state.roll), -1.5)
    np.testing.assert_allclose(np.rad2deg(state.pitch), 2.5)
    assert log.start_utc_s is None


def test_the_text_form_tells_the_same(tmp_path: Path) -> None:
    lines = [
        f"FMT, {number}, 30, {name}, {codes}, {', '.join(columns.split(','))}"
        for name, (number, codes, columns) in FORMATS.items()
    ]
    for i in range(30):
        lines += [f"ATT, {100000 * i}, -1.5, 2.5, {10 + i}", f"CTUN, {100000 * i}, {-i}, 0"]
    log = logged(tmp_path, "\n".join([*lines, "ATT, 3000000, 1"]).encode())
    assert log.kind == "dataflash text"
    assert log.at([1.0]).depth[0] == pytest.approx(10.0)
    assert np.rad2deg(log.at([1.0]).heading[0]) == pytest.approx(20.0)
    assert log.notes == (
        f"1 lines are no records and are left out, the first at line {len(lines) + 1}: the file is "
        "damaged or cut short",
    )


def test_utc_comes_from_gps_or_else_from_the_clock(tmp_path: Path) -> None:
    # 2026-05-31 12:00:00 UTC is week 2421, 43218 s after the midnight that begins it (18 leap s).
    gps = entry("GPS", 62_000_000, 3, 43_218_000, 2421)
    no_fix = entry("GPS", 61_000_000, 1, 5, 2421)
    log = logged(tmp_path, b"".join([*dataflash(), no_fix, gps]))
    assert log.start_utc_s == pytest.approx(1780228800.0 - 2.0)
    rtc = entry("RTC", 61_000_000, 1_780_228_800_000_000)
    log = logged(tmp_path, b"".join([*dataflash(), no_fix, rtc]))
    assert log.start_utc_s == pytest.approx(1780228800.0 - 1.0)
    assert log.sources["start_utc_s"] == "RTC.Epoch"


def test_of_several_barometers_the_one_in_the_water_is_read(tmp_path: Path) -> None:
    records = formats()
    for i in range(30):
        records.append(entry("BARO", 100_000 * i, 0, 300.0))
        records.append(entry("BARO", 100_000 * i, 1, -2.5))
    log = logged(tmp_path, b"".join(records))
    assert log.sources == {"depth": "BARO.Alt of sensor 1"}
    assert log.at([1.0]).depth[0] == 2.5


@pytest.mark.parametrize(
    "harm",
    [
        lambda data: data[:-5],
        lambda data: data[:4000] + data[4040:],
        lambda data: data[:4000] + b"\xa3\x95\x01" + bytes(50) + data[4000:],
        lambda data: b"lost" + data,
        lambda data: data + b"\xff" * 500,
    ],
)
def test_a_damaged_dataflash_log_loses_little(
    tmp_path: Path, harm: Callable[[bytes], bytes]
) -> None:
    log = logged(tmp_path, harm(b"".join(dataflash())))
    assert log.heading is not None
    assert len(log.heading.time_s) >= 97
    assert "are left out, the first at byte" in log.notes[0]


def test_an_impossible_time_takes_nothing_else_with_it(tmp_path: Path) -> None:
    records = dataflash()
    records.insert(100, entry("ATT", 2**60, 0, 0, 0))
    log = logged(tmp_path, b"".join(records))
    assert log.heading is not None
    assert len(log.heading.time_s) == 100
    assert log.notes == ("1 records have an impossible time and are left out",)


def test_impossible_values_are_left_out(tmp_path: Path) -> None:
    records = dataflash()
    records.append(entry("CTUN", 70_000_000, 1e30, 0.0))
    log = logged(tmp_path, b"".join(records))
    assert log.depth is not None
    assert log.depth.values.max() < 10.0


@pytest.mark.samples
def test_the_real_telemetry_log(samples: Path) -> None:
    log = read_vehicle_log(samples / "ardusub-logs" / "small.tlog")
    assert log.notes == ()
    assert log.sources["depth"] == "GLOBAL_POSITION_INT.relative_alt"
    assert log.span_s[1] == pytest.approx(263.6, abs=0.1)
    assert log.heading is not None
    assert np.median(np.diff(log.heading.time_s)) == pytest.approx(0.05, abs=2e-4)
    # 4 May 2023, from the first attitude.
    assert log.start_utc_s == pytest.approx(1683220541.0, abs=1.0)
    # Bobbing at the surface.
    assert log.depth is not None
    assert np.abs(log.depth.values).max() < 0.4


@pytest.mark.samples
def test_the_real_telemetry_log_reads_as_pymavlink_reads_it(samples: Path) -> None:
    mavutil = pytest.importorskip("pymavlink.mavutil")
    path = samples / "ardusub-logs" / "small.tlog"
    frames = read_frames(path.read_bytes())
    names = {message.name for message in MESSAGES.values()}
    theirs: dict[str, list[list[float]]] = {name: [] for name in names}
    reader = mavutil.mavlink_connection(str(path))
    while (message := reader.recv_match(type=list(names))) is not None:
        table = MESSAGES[message.get_msgId()]
        theirs[table.name].append([getattr(message, field) for field, _ in table.fields])
    reader.close()
    assert frames.n_failed == 0
    for message in MESSAGES.values():
        payload = frames.tables[message.name].payload
        ours = np.stack([payload[field].astype(float) for field, _ in message.fields], axis=1)
        np.testing.assert_array_equal(ours, np.array(theirs[message.name]))


def test_layouts_are_those_of_pymavlink() -> None:
    dialect = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega")
    for number, message in MESSAGES.items():
        known = dialect.mavlink_map[number]
        assert message.crc_extra == known.crc_extra
        assert message.name == known.msgname
        names = [field for field, _ in message.fields]
        assert names == list(known.ordered_fieldnames)[: len(names)]
        assert known.unpacker.format.startswith(
            "<" + "".join(np.dtype(kind).char for _, kind in message.fields)
        )


@pytest.mark.samples
def test_the_real_dataflash_log_reads_as_pymavlink_reads_it(samples: Path) -> None:
    path = samples / "ardusub-logs" / "small.BIN"
    log = read_vehicle_log(path)
    assert log.notes == ()
    assert log.sources["depth"] == "CTUN.Alt"
    dfreader = pytest.importorskip("pymavlink.DFReader")
    reader = dfreader.DFReader_binary(str(path))
    rows = []
    while (message := reader.recv_match(type=["ATT"])) is not None:
        rows.append([message.TimeUS / 1e6, message.Roll, message.Pitch, message.Yaw])
    reader.close()
    theirs = np.array(rows)
    assert log.heading is not None
    assert log.roll is not None
    assert log.pitch is not None
    np.testing.assert_allclose(np.diff(log.heading.time_s), np.diff(theirs[:, 0]), atol=1e-9)
    for signal, column in ((log.roll, 1), (log.pitch, 2), (log.heading, 3)):
        np.testing.assert_allclose(np.rad2deg(signal.values), theirs[:, column], atol=1e-9)
