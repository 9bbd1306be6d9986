"""From a sample to what the page shows, as JSON."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from aqualvs.app.posture_csv import POSTURE_COLUMNS, posture_row
from aqualvs.app.report_words import laser_colour
from aqualvs.control.setpoint import Setpoint
from aqualvs.live.health import Health, PartHealth
from aqualvs.live.sample import LiveSample
from aqualvs.live.time_filter import FilteredPosture
from aqualvs.optics.rig import Rig
from aqualvs.scanning.posture import Refusal
from aqualvs.scanning.scan import Label, ScanPoints

_MAX_POINTS = 360


def page_state(sample: LiveSample, setpoint: Setpoint | None, recording: Mapping[str, Any]) -> str:
    """Return the message for the page about one sample.

    Its `posture` holds the cells of the frame's row in `posture.csv`, as they are written there.
    """
    row = posture_row(sample.scan).rstrip("\n").split(",")
    posture = sample.scan.posture
    found = {
        "kind": "state",
        "utc_ms": sample.utc_ns // 10**6,
        "posture": dict(zip(POSTURE_COLUMNS, row, strict=True)),
        "detail": posture.detail if isinstance(posture, Refusal) else "",
        "n_water": f"{sample.scan.n_water:.4f}",
        "filtered": _filtered(sample.filtered),
        "setpoint": None
        if setpoint is None
        else {"range_m": setpoint.range, "yaw_deg": math.degrees(setpoint.yaw)},
        "recording": recording,
        "health": _health(sample.health),
        "points": _points(sample.scan.points),
    }
    return json.dumps(_without_nan(found), separators=(",", ":"))


def rig_state(rig: Rig, *, may_command: bool) -> str:
    """Return the message that begins a connection: what does not change."""
    near, far = rig.working_range
    found = {
        "kind": "rig",
        "name": rig.name,
        "size_px": rig.size_px,
        "lasers": [
            {"name": laser.name, "colour": laser_colour(i)} for i, laser in enumerate(rig.lasers)
        ],
        "working_range_m": [near, far],
        "may_command": may_command,
    }
    return json.dumps(found, separators=(",", ":"))


def _points(points: ScanPoints) -> dict[str, Any]:
    """Return every so-many-th point: in the picture, and in metres from above and from the side."""
    step = max(1, math.ceil(len(points) / _MAX_POINTS))
    some = slice(None, None, step)
    xyz = np.round(points.points_in_dome[some], 3)
    pixels = np.round(points.pixels[some], 1)
    return {
        "laser": points.laser[some].tolist(),
        "u": pixels[:, 0].tolist(),
        "v": pixels[:, 1].tolist(),
        "x": xyz[:, 0].tolist(),
        "y": xyz[:, 1].tolist(),
        "z": xyz[:, 2].tolist(),
        "used": points.used[some].astype(int).tolist(),
        "net": (points.label[some] == Label.NET).astype(int).tolist(),
    }


def _filtered(filtered: FilteredPosture | None) -> dict[str, float] | None:
    if filtered is None:
        return None
    sigma = np.sqrt(filtered.total_covariance.diagonal())
    return {
        "range_m": filtered.range,
        "pitch_deg": math.degrees(filtered.pitch),
        "yaw_deg": math.degrees(filtered.yaw),
        "sigma_range_m": float(sigma[0]),
        "age_s": filtered.age_s,
    }


def _health(health: Health) -> dict[str, Any]:
    return {
        "state": health.state.value,
        "rate_hz": round(health.rate_hz, 1),
        "valid_share": health.valid_share,
        "n_frames": health.n_frames,
        "n_dropped": health.n_dropped,
        "n_lost": health.n_lost,
        "quality": health.quality,
        "sigma_n_water": health.sigma_n_water,
        "delays_ms": {
            d.name: [round(1e3 * d.median_s, 2), round(1e3 * d.p99_s, 2)] for d in health.delays
        },
        "source": _part(health.source),
        "lasers": [_part(part) for part in health.lasers],
        "outputs": [_part(part) for part in health.outputs],
    }


def _part(part: PartHealth) -> dict[str, Any]:
    return asdict(part)


def _without_nan(value: Any) -> Any:
    """Return the same with null for what is no number: JSON has no other word for it."""
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
