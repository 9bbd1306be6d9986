"""`aqualvs doctor --mavlink`: what the autopilot tells, and what its settings mean for us."""

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path

from aqualvs.app.check_finding import Finding, Severity
from aqualvs.control.vehicle import Mode, VehicleState
from aqualvs.live.ardusub_link import ArduSubLink, ArduSubOptions
from aqualvs.live.ardusub_parameters import (
    FOR_DISTANCE,
    FOR_STICKS,
    Advice,
    Weight,
    advise_on_distance,
    advise_on_fail_safe,
    advise_on_speed,
    advise_on_station,
)
from aqualvs.live.health import State
from aqualvs.live.mavlink_link import MavlinkLink
from aqualvs.live.vehicle_file import VehicleSetup
from aqualvs.optics.rigfile import load_rig

_HEARTBEAT_S, _LISTEN_S = 6.0, 3.0
# Between heartbeats the attitude tells that the vehicle is there; channels show the pilot's sticks.
_ATTITUDE_HZ, _CHANNELS_HZ = 10.0, 5.0
_SUBMARINE = 12
_SEVERITY = {
    Weight.FINE: Severity.OK,
    Weight.CARE: Severity.WARN,
    Weight.BROKEN: Severity.BAD,
}
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

    Parameters
    ----------
    address : str
        As in `parse_address`.
    vehicle : VehicleSetup
    rig : Path or None
        Whose working range the autopilot's rangefinder should take.
    """
    working_range = None if rig is None else load_rig(rig).working_range
    with contextlib.closing(MavlinkLink(address, vehicle.link)) as link:
        end_s = time.monotonic() + _HEARTBEAT_S
        while link.autopilot() is None and time.monotonic() < end_s:
            time.sleep(0.05)
        heard, health = link.autopilot(), link.health()
        if heard is None:
            yield Finding(
                Severity.BAD,
                f"{address}: no heartbeat of an autopilot in {_HEARTBEAT_S:.0f} s "
                f"({health.detail}); add this machine as an endpoint in BlueOS, or check address "
                "and port",
            )
            return
        severity = Severity.OK if health.state is State.OK else Severity.WARN
        yield Finding(severity, f"{address}: {health.detail}")
        if heard.message.type != _SUBMARINE:
            yield Finding(Severity.WARN, "not ArduSub: live sends to it, follow cannot steer it")
            return
        yield from _ardusub(link, vehicle, working_range)


def _ardusub(
    link: MavlinkLink, vehicle: VehicleSetup, working_range: tuple[float, float] | None
) -> Iterator[Finding]:
    began_s = time.monotonic()
    before = [link.n_received(kind) for kind in ("ATTITUDE", "RC_CHANNELS")]
    told = link.read_parameters((*FOR_STICKS, *FOR_DISTANCE), patience_s=_LISTEN_S)
    # The ground station is to be heard, and rates are to be counted, for some seconds.
    time.sleep(max(0.0, began_s + _LISTEN_S - time.monotonic()))
    span_s = time.monotonic() - began_s
    after = [link.n_received(kind) for kind in ("ATTITUDE", "RC_CHANNELS")]
    attitude_hz, channels_hz = ((b - a) / span_s for a, b in zip(before, after, strict=True))
    steering = vehicle.steering
    state = ArduSubLink(link, steering, advises=False).state()
    yield _mode(state, steering.own_modes)
    yield _station(link, steering)
    yield _attitude(attitude_hz)
    yield _channels(channels_hz)
    if not told:
        yield Finding(
            Severity.WARN,
            "no parameter is told: the vehicle does not answer us; look its settings up in the "
            "ground station (docs/ardusub.md lists them)",
        )
        return
    advice = [advise_on_station(told, steering.ground_station)]
    advice += advise_on_fail_safe(told) + advise_on_speed(told)
    advice += advise_on_distance(told, working_range)
    for one in advice:
        yield _finding(one)


def _finding(advice: Advice) -> Finding:
    return Finding(_SEVERITY[advice.weight], advice.text)


def _mode(state: VehicleState, own_modes: tuple[str, ...]) -> Finding:
    means = _MODES[state.mode].format(own=" or ".join(own_modes))
    armed = "armed" if state.armed else "disarmed: follow engages once it is armed"
    fits = state.mode in (Mode.OURS, Mode.PILOT)
    # The rest of it is told with the station's own line.
    name = state.mode_name.partition(";")[0]
    return Finding(Severity.OK if fits else Severity.WARN, f"mode {name}: {means}; {armed}")


def _station(link: MavlinkLink, steering: ArduSubOptions) -> Finding:
    station = steering.ground_station
    beat = link.latest("HEARTBEAT", system=station)
    if beat is not None and beat.age_s < _LISTEN_S:
        return Finding(Severity.OK, f"ground station {station} is heard")
    if steering.station_timeout_s is None:
        return Finding(Severity.OK, f"ground station {station} is not heard, and need not be")
    return Finding(
        Severity.WARN,
        f"ground station {station} is not heard: follow does not engage; let the router forward "
        "its heartbeat, or set ground_station in the vehicle file",
    )


def _attitude(rate_hz: float) -> Finding:
    words = f"ATTITUDE {rate_hz:.0f} Hz"
    if rate_hz >= _ATTITUDE_HZ:
        return Finding(Severity.OK, f"{words}: follow hears the vehicle between its heartbeats")
    return Finding(
        Severity.WARN,
        f"{words}: follow takes the vehicle for silent between its heartbeats; set MAV1_EXTRA1 "
        f"{_ATTITUDE_HZ:.0f} (before 4.7: SR0_EXTRA1; the number is that of the autopilot's port)",
    )


def _channels(rate_hz: float) -> Finding:
    words = f"RC_CHANNELS {rate_hz:.0f} Hz"
    if rate_hz >= _CHANNELS_HZ:
        return Finding(
            Severity.OK, f"{words}: follow sees the pilot's sticks, and whether ours are obeyed"
        )
    return Finding(
        Severity.WARN,
        f"{words}: follow sees the pilot's sticks late or not at all, and not whether ours are "
        "obeyed; set MAV1_RC_CHAN 10 (before 4.7: SR0_RC_CHAN; the number is that of the "
        "autopilot's port)",
    )
