"""`aqualvs doctor`: readiness of machine, stream and autopilot, in sentences.

With `--mavlink` it waits for the autopilot's heartbeat, reads its parameters, and explains their
effect on `aqualvs live` and `aqualvs follow`.
"""

import contextlib
import importlib.metadata
import importlib.resources
import itertools
import os
import platform
import shutil
import statistics
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from rich.console import Console

from aqualvs import __version__
from aqualvs.check.finding import findings_table, shutter_finding
from aqualvs.control.vehicle import Mode, VehicleState
from aqualvs.demo import bundled_dive
from aqualvs.errors import AqualvsError
from aqualvs.geometry.compiled import compiled_at_once, is_cached_on_disk
from aqualvs.live.mavlink.ardusub import ArduSubLink, ArduSubOptions
from aqualvs.live.mavlink.ardusub_parameters import (
    FOR_DISTANCE,
    FOR_STICKS,
    advise_on_distance,
    advise_on_fail_safe,
    advise_on_speed,
    advise_on_station,
)
from aqualvs.live.mavlink.link import MavlinkLink
from aqualvs.live.options import VehicleSetup
from aqualvs.optics.projection import project_all
from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import load_rig
from aqualvs.optics.shutter import AT_ONCE, Shutter
from aqualvs.scanner import Scanner
from aqualvs.scanning.scan import Frame
from aqualvs.sources import open_source
from aqualvs.sources.base import State
from aqualvs.sources.fields import FieldEvidence, frames_of
from aqualvs.sources.live_frames import NOTHING_YET
from aqualvs.sources.opening import is_address
from aqualvs.sources.video import sampled_pictures
from aqualvs.terminal import told_if_slow
from aqualvs.text import Finding, Severity

# Longest wait for the first heartbeat, which is sent every second; then time to count messages.
_HEARTBEAT_S, _LISTEN_S = 6.0, 3.0
# MAV_TYPE_SUBMARINE.
_SUBMARINE = 12
# Meaning of the vehicle's mode for `aqualvs follow`; `{own}` are the modes in which it engages.
_MODES = {
    Mode.OURS: "follow engages in it",
    Mode.PILOT: "follow does not engage in it; choose {own}",
    Mode.NO_STATION: "follow does not engage without its ground station",
    Mode.IGNORED: "follow does not engage",
    Mode.CONFLICT: "follow does not engage while two speak as the vehicle; use --mavlink-peer",
    Mode.UNKNOWN: "follow does not engage",
}


def autopilot(address: str, vehicle: VehicleSetup, rig: Path | None = None) -> Iterator[Finding]:
    """Wait for the heartbeat of an autopilot, listen for a while, and read its parameters.

    `address` is as in `parse_address`; `rig` is the file of a rig whose working range the
    autopilot's rangefinder should accept.
    """
    working_range = None if rig is None else load_rig(rig).working_range
    with contextlib.closing(MavlinkLink(address, vehicle.link)) as link:
        end_s = time.monotonic() + _HEARTBEAT_S
        while link.autopilot() is None and time.monotonic() < end_s:
            time.sleep(0.05)
        heard, health = link.autopilot(), link.health()
        if heard is None:
            yield Finding.bad(
                f"{address}: no heartbeat of an autopilot in {_HEARTBEAT_S:.0f} s "
                f"({health.detail}); add this machine as an endpoint in BlueOS, or check address "
                "and port"
            )
            return
        answered = Finding.ok if health.state is State.OK else Finding.warn
        yield answered(f"{address}: {health.detail}")
        if heard.message.type != _SUBMARINE:
            yield Finding.warn("not ArduSub: live sends to it, follow cannot steer it")
            return
        yield from _ardusub(link, vehicle, working_range)


def _ardusub(
    link: MavlinkLink, vehicle: VehicleSetup, working_range: tuple[float, float] | None
) -> Iterator[Finding]:
    """Listen to an ArduSub for a while; yield findings on modes, messages and parameters."""
    began_s = time.monotonic()
    before = {kind: link.n_received(kind) for kind in _RATES}
    parameters = link.read_parameters((*FOR_STICKS, *FOR_DISTANCE), timeout_s=_LISTEN_S)
    # Counting messages, and hearing the ground station, takes some seconds.
    time.sleep(max(0.0, began_s + _LISTEN_S - time.monotonic()))
    span_s = time.monotonic() - began_s
    rates_hz = {kind: (link.n_received(kind) - n) / span_s for kind, n in before.items()}
    steering = vehicle.steering
    state = ArduSubLink(link, steering, advises=False).state()
    yield _mode(state, steering.own_modes)
    yield _station(link, steering)
    for kind, rate_hz in rates_hz.items():
        yield _rate(kind, rate_hz)
    if not parameters:
        yield Finding.warn(
            "no parameters received: the vehicle does not answer; check its settings in the "
            "ground station (docs/ardusub.md lists them)"
        )
        return
    yield advise_on_station(parameters, steering.ground_station)
    yield from advise_on_fail_safe(parameters)
    yield from advise_on_speed(parameters)
    yield from advise_on_distance(parameters, working_range)


def _mode(state: VehicleState, own_modes: tuple[str, ...]) -> Finding:
    means = _MODES[state.mode].format(own=" or ".join(own_modes))
    armed = "armed" if state.armed else "disarmed: follow engages once it is armed"
    fits = state.mode in (Mode.OURS, Mode.PILOT)
    # The part after a semicolon repeats the finding on the station.
    name = state.mode_name.partition(";")[0]
    return Finding(Severity.OK if fits else Severity.WARN, f"mode {name}: {means}; {armed}")


def _station(link: MavlinkLink, steering: ArduSubOptions) -> Finding:
    station = steering.ground_station
    beat = link.latest("HEARTBEAT", system=station)
    if beat is not None and beat.age_s < _LISTEN_S:
        return Finding.ok(f"ground station {station} is heard")
    if steering.station_timeout_s is None:
        return Finding.ok(f"ground station {station} is not heard, and need not be")
    return Finding.warn(
        f"ground station {station} is not heard: follow does not engage; let the router forward "
        "its heartbeat, or set ground_station in the vehicle file"
    )


_RATES = {
    # Between heartbeats, this message shows that the vehicle is alive.
    "ATTITUDE": (
        10.0,
        "EXTRA1",
        "follow hears the vehicle between its heartbeats",
        "follow regards the vehicle as silent between its heartbeats",
    ),
    # This message shows the positions of the pilot's sticks.
    "RC_CHANNELS": (
        5.0,
        "RC_CHAN",
        "follow sees the pilot's sticks, and whether ours are obeyed",
        "follow sees the pilot's sticks late or not at all, and not whether ours are obeyed",
    ),
}
"""By message: the rate that is enough, in hertz, the parameter of ArduSub that sets the rate, and
what is said of enough and of too few messages."""


def _rate(kind: str, rate_hz: float) -> Finding:
    enough_hz, parameter, enough, too_few = _RATES[kind]
    text = f"{kind} {rate_hz:.0f} Hz"
    if rate_hz >= enough_hz:
        return Finding.ok(f"{text}: {enough}")
    return Finding.warn(
        f"{text}: {too_few}; set MAV1_{parameter} 10 (before 4.7: SR0_{parameter}; the number is "
        "that of the autopilot's port)"
    )


_EXTRAS = {
    "dashboard": (("starlette", "uvicorn", "websockets"), "the pilot's page"),
    "mavlink": (("pymavlink", "pyserial"), "MAVLink, .tlog and .BIN logs"),
    "bags": (("mcap", "rosbags"), "ROS bags as source, ROS 1 live"),
    "foxglove": (("foxglove-sdk",), "Foxglove live"),
    "rerun": (("rerun-sdk",), "--rerun"),
    "dds": (("cyclonedds", "rosbags"), "ROS 2 without ROS"),
    "batch": (("distributed",), "aqualvs batch"),
    "plots": (("matplotlib",), "maps of nets, figures"),
}
"""By extra of the package: the packages that it installs, and their purpose."""

# Frames of the bundled dive that are measured, and the rate, in hertz, to keep up with.
_N_FRAMES, _FRAME_RATE = 40, 25.0
# Longest time to receive a stream.
_STREAM_S = 8.0


def run_doctor(
    source: str | None = None,
    rig: Path | None = None,
    mavlink: str | None = None,
    vehicle: VehicleSetup | None = None,
    console: Console | None = None,
) -> None:
    """Check the machine, a rig file, a stream and an autopilot; print the findings.

    `source`: a stream, camera or file, whose pictures should fit the rig, if both are given.
    `mavlink`: address of the autopilot. `vehicle`: expected systems, and options of steering.

    Raises `AqualvsError` with the first bad finding, after all checks.
    """
    console = console or Console()
    console.print(f"aqualvs {__version__}", style="bold", highlight=False)
    checks: list[Callable[[], Iterator[Finding]]] = [_machine, _packages, _pipeline]
    if rig is not None:
        checks.append(partial(_rig_file, rig))
    if source is not None:
        checks.append(partial(_stream, source, rig))
    if mavlink is not None:
        checks.append(partial(autopilot, mavlink, vehicle or VehicleSetup(), rig))
    bad: list[str] = []
    for check in checks:
        found: list[Finding] = []
        try:
            for finding in check():
                found.append(finding)
        except AqualvsError as fault:
            found.append(Finding.bad(str(fault)))
        console.print(findings_table(found))
        bad += [finding.sentence for finding in found if finding.severity is Severity.BAD]
    if bad:
        raise AqualvsError(f"not ready: {bad[0]}")


def _machine() -> Iterator[Finding]:
    """Yield findings on cores, disk space and the cache of compiled kernels."""
    cores = os.cpu_count() or 1
    text = f"Python {platform.python_version()}, {platform.machine()}, {cores} cores"
    yield Finding(Severity.OK if cores > 1 else Severity.WARN, text)
    free_gb = shutil.disk_usage(Path.cwd()).free / 1e9
    min_free_gb = 2.0
    if free_gb < min_free_gb:
        yield Finding.warn(f"only {free_gb:.1f} GB free here; recordings need about 1 GB an hour")
    if not is_cached_on_disk(project_all):
        yield Finding.warn(
            "every command recompiles its kernels, because no cache folder is writable; set "
            "NUMBA_CACHE_DIR to a writable folder"
        )


def _packages() -> Iterator[Finding]:
    """Yield a finding for each optional extra of the package."""
    for extra, (packages, purpose) in _EXTRAS.items():
        missing = [name for name in packages if not _installed(name)]
        if missing:
            yield Finding.warn(
                f"{purpose}: {', '.join(missing)} missing; pip install 'aqualvs[{extra}]'"
            )
        else:
            found = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in packages)
            yield Finding.ok(f"{purpose}: {found}")


def _installed(package: str) -> bool:
    try:
        importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def _pipeline() -> Iterator[Finding]:
    """Decode the bundled dive and measure its postures."""
    with importlib.resources.as_file(bundled_dive()) as folder:
        rig = load_rig(folder / "rig.yaml")
        with open_source(folder / "dive.mp4") as source:
            frames = list(itertools.islice(source, _N_FRAMES))
        yield Finding.ok(f"H.264 decoded: {len(frames)} frames of the bundled dive")
        yield _speed(rig, frames)


def _speed(rig: Rig, frames: list[Frame]) -> Finding:
    """Measure the frames of the bundled dive; return a finding on postures and time.

    All kernels are compiled before, as in a live run: the time is that of later frames.
    """
    began = time.perf_counter()
    scanner = Scanner(rig)
    times, n_valid = [], 0
    with compiled_at_once():
        with told_if_slow("compiling what measures"):
            scanner.process(frames[0])
        ready_s = time.perf_counter() - began
        for frame in frames:
            began = time.perf_counter()
            n_valid += bool(scanner.process(frame).posture)
            times.append(time.perf_counter() - began)
    median = statistics.median(times)
    width, height = rig.size_px
    text = (
        f"posture in {n_valid} of {len(frames)} frames; {1e3 * median:.1f} ms a frame of "
        f"{width}x{height} px, first after {ready_s:.1f} s"
    )
    if n_valid < 0.9 * len(frames):
        return Finding.bad(f"{text}; the installation is broken, install aqualvs again")
    if median > 0.5 / _FRAME_RATE:
        return Finding.warn(f"{text}; too slow for {_FRAME_RATE:.0f} frames a second")
    return Finding.ok(text)


def _rig_file(path: Path) -> Iterator[Finding]:
    rig = load_rig(path)
    size = "x".join(map(str, rig.size_px))
    yield Finding.ok(f"rig {rig.name!r}: {size} px, lasers: {len(rig.lasers)}")
    shutter = shutter_finding(rig)
    if shutter is not None:
        yield shutter


def _stream(where: str, rig_file: Path | None) -> Iterator[Finding]:
    """Receive frames for a few seconds; report size, rate, losses and the fit to the rig."""
    rig = None if rig_file is None else load_rig(rig_file)
    frames, span_s, health, fault = _received(where)
    if not frames:
        advice = ""
        if health.startswith(NOTHING_YET):
            advice = (
                "; is the sender on, its address this machine's, the port open in the firewall?"
            )
        yield Finding.bad(f"{where}: no picture in {_STREAM_S:.0f} s ({health}){advice}")
        return
    height, width = frames[-1].luma.shape
    lost = frames[-1].index - frames[0].index + 1 - len(frames)
    rate = (len(frames) - 1) / span_s if span_s > 0 else 0.0
    severity = Severity.WARN if lost else Severity.OK
    yield Finding(
        severity, f"{where}: {width}x{height} px, {rate:.1f} frames a second, {lost} lost"
    )
    if fault is not None:
        yield Finding.bad(str(fault))
    if rig is not None:
        yield _fit(rig, frames)
    yield from _fields(where, AT_ONCE if rig is None else rig.shutter, frames)


def _fields(where: str, shutter: Shutter, frames: list[Frame]) -> Iterator[Finding]:
    """Yield a finding if the pictures are interlaced and the rig's shutter is not, or reversely."""
    successive = [
        list(pair) for pair in itertools.pairwise(frames) if pair[1].index == pair[0].index + 1
    ]
    groups, first_field = successive, None
    if not is_address(where) and Path(where).is_file():
        groups, first_field = sampled_pictures(Path(where))
    span_s = frames[-1].time_s - frames[0].time_s
    fps = (frames[-1].index - frames[0].index) / span_s if span_s > 0.0 else None
    wrong = FieldEvidence.of(groups, first_field).contradiction(shutter, fps)
    if wrong:
        yield Finding.warn(f"{where}: {wrong}")


def _received(where: str) -> tuple[list[Frame], float, str, AqualvsError | None]:
    """Receive frames for a few seconds.

    Returns the frames, the time between the first and the last arrival in seconds, the detail of
    the feed's health, and the error that ended the feed, if any. Raises it if no frame arrived.
    """
    from aqualvs.live.runner import FrameReader, Mailbox
    from aqualvs.sources.opening import open_feed

    feed, mailbox = open_feed(where, realtime=True), Mailbox()
    frames: list[Frame] = []
    arrived_ns: list[int] = []
    with FrameReader(feed, mailbox) as reader:
        end = time.monotonic() + _STREAM_S
        while time.monotonic() < end and len(frames) < 2 * _N_FRAMES and not mailbox.exhausted:
            arrival = mailbox.take(0.2)
            if arrival is not None:
                frames.append(arrival.frame)
                arrived_ns.append(arrival.arrived_ns)
        text = reader.health().detail
    if reader.fault is not None and not frames:
        raise reader.fault
    span_s = 1e-9 * (arrived_ns[-1] - arrived_ns[0]) if arrived_ns else 0.0
    return frames, span_s, text, reader.fault


def _fit(rig: Rig, frames: list[Frame]) -> Finding:
    """Return a finding on whether the frames fit the rig and give postures."""
    height, width = frames[-1].luma.shape
    if (width, height) != rig.size_px:
        need = "x".join(map(str, rig.size_px))
        return Finding.bad(
            f"the rig {rig.name!r} has pictures of {need} px; set the camera to that mode, or "
            "calibrate in this one"
        )
    scanner = Scanner(rig)
    frames = list(frames_of(frames, rig.shutter))
    n_valid = sum(bool(scanner.process(frame).posture) for frame in frames)
    text = f"posture in {n_valid} of {len(frames)} frames with the rig {rig.name!r}"
    if not n_valid:
        reason = scanner.process(frames[-1]).posture
        return Finding.warn(f"{text}: {getattr(reason, 'detail', '')}")
    return Finding.ok(text)
