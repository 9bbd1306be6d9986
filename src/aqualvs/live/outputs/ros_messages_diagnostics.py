"""Health as ROS's diagnostics: one status for each part, with figures."""

import math
from dataclasses import dataclass
from enum import IntEnum

from aqualvs.live.health import Health, PartHealth, State
from aqualvs.live.sample import LiveSample

_PREFIX = "aqualvs: "


class Level(IntEnum):
    """As in diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


_LEVELS = {State.OK: Level.OK, State.WARN: Level.WARN, State.FAULT: Level.ERROR}


@dataclass(frozen=True, slots=True)
class Status:
    """As diagnostic_msgs/DiagnosticStatus; `values` are pairs of key and value."""

    level: Level
    name: str
    message: str
    hardware_id: str
    values: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class DiagnosticsMessage:
    """As diagnostic_msgs/DiagnosticArray; its header names no frame."""

    stamp_ns: int
    statuses: tuple[Status, ...]


def diagnostics_message(sample: LiveSample) -> DiagnosticsMessage:
    """Return how the run is: posture, pipeline, source, lasers, outputs."""
    health, rig = sample.health, sample.rig.name
    parts = [
        ("source", health.source),
        *((f"laser {part.name}", part) for part in health.lasers),
        *((f"output {part.name}", part) for part in health.outputs),
    ]
    return DiagnosticsMessage(
        sample.utc_ns,
        (
            _posture_status(sample),
            _pipeline_status(health, rig),
            *(_part_status(name, part, rig) for name, part in parts),
        ),
    )


def _posture_status(sample: LiveSample) -> Status:
    name, rig, posture = f"{_PREFIX}posture", sample.rig.name, sample.scan.posture
    if not posture:
        told = f"{posture.reason}: {posture.detail}" if posture.detail else str(posture.reason)
        return Status(Level.WARN, name, told, rig, (("reason", str(posture.reason)),))
    pitch, yaw = math.degrees(posture.pitch), math.degrees(posture.yaw)
    frame, whole = (
        [math.sqrt(covariance[i, i]) for i in range(3)]
        for covariance in (posture.covariance, posture.total_covariance)
    )
    return Status(
        Level.OK,
        name,
        f"{posture.range:.3f} m, pitch {pitch:+.1f} deg, yaw {yaw:+.1f} deg",
        rig,
        _texts(
            range_m=posture.range,
            pitch_deg=pitch,
            yaw_deg=yaw,
            sigma_range_m=frame[0],
            sigma_pitch_deg=math.degrees(frame[1]),
            sigma_yaw_deg=math.degrees(frame[2]),
            sigma_range_total_m=whole[0],
            sigma_pitch_total_deg=math.degrees(whole[1]),
            sigma_yaw_total_deg=math.degrees(whole[2]),
            slant_range_m=posture.slant_range,
            nearest_m=posture.nearest,
            n_points=posture.n_points,
        ),
    )


def _pipeline_status(health: Health, rig: str) -> Status:
    share = "" if math.isnan(health.valid_share) else f", {health.valid_share:.0%} with a posture"
    delays = {
        f"{stage.name}_{which}_ms": 1e3 * delay_s
        for stage in health.delays
        for which, delay_s in (("median", stage.median_s), ("p99", stage.p99_s))
    }
    return Status(
        Level.OK if health.rate_hz > 0.0 else Level.WARN,
        f"{_PREFIX}pipeline",
        f"{health.rate_hz:.1f} frames/s{share}",
        rig,
        _texts(
            rate_hz=health.rate_hz,
            valid_share=health.valid_share,
            n_frames=health.n_frames,
            n_dropped=health.n_dropped,
            n_lost=health.n_lost,
            quality=health.quality,
            n_water=health.n_water,
            sigma_n_water=health.sigma_n_water,
            **delays,
        ),
    )


def _part_status(name: str, part: PartHealth, rig: str) -> Status:
    idle = part.state is State.OFF
    return Status(
        Level.OK if idle else _LEVELS[part.state],
        f"{_PREFIX}{name}",
        (f"not in use: {part.detail}" if part.detail else "not in use") if idle else part.detail,
        rig,
        (("state", str(part.state)), ("n_dropped", str(part.n_dropped))),
    )


def _texts(**figures: float) -> tuple[tuple[str, str], ...]:
    return tuple((key, f"{value:.6g}") for key, value in figures.items())
