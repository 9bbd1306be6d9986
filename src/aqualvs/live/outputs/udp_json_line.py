"""A live sample as one line of JSON."""

import json
import math
from typing import TypeAlias

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.live.sample import LiveSample
from aqualvs.live.time_filter import FilteredPosture
from aqualvs.scanning.posture import Posture, Refusal

FORMAT_VERSION = 1
"""Rises when a key changes its meaning or goes; new keys may come at any time."""

Value: TypeAlias = str | int | float | bool | None

_POSTURE_KEYS = (
    "range_m",
    "pitch_deg",
    "yaw_deg",
    "sigma_range_m",
    "sigma_pitch_deg",
    "sigma_yaw_deg",
    "slant_range_m",
    "nearest_m",
    "n_points",
    "curvature_x_per_m",
    "curvature_z_per_m",
    "sigma_curvature_x_per_m",
    "sigma_curvature_z_per_m",
    "sigma_range_rig_m",
    "sigma_pitch_rig_deg",
    "sigma_yaw_rig_deg",
    "sigma_range_total_m",
    "sigma_pitch_total_deg",
    "sigma_yaw_total_deg",
)
_FILTERED_KEYS = (
    "filtered_range_m",
    "filtered_pitch_deg",
    "filtered_yaw_deg",
    "filtered_sigma_range_m",
    "filtered_sigma_pitch_deg",
    "filtered_sigma_yaw_deg",
    "filtered_speed_m_per_s",
    "filtered_pitch_rate_deg_per_s",
    "filtered_yaw_rate_deg_per_s",
    "filtered_age_s",
    "filtered_accepted",
    "filtered_sigma_range_total_m",
    "filtered_sigma_pitch_total_deg",
    "filtered_sigma_yaw_total_deg",
)


def json_line(sample: LiveSample) -> bytes:
    """Return a sample as one line of JSON in UTF-8, with its line end."""
    text = json.dumps(json_fields(sample), ensure_ascii=False, separators=(",", ":"))
    return text.encode("utf-8") + b"\n"


def json_fields(sample: LiveSample) -> dict[str, Value]:
    """Return a sample as plain values: those of `posture.csv`, rounded alike, and what is live.

    None stands for what is not known, and for numbers that are not finite.
    """
    scan, posture = sample.scan, sample.scan.posture
    refusal = posture if isinstance(posture, Refusal) else None
    fields: dict[str, Value] = {
        "aqualvs_sample": FORMAT_VERSION,
        "frame": scan.index,
        "time_s": _fixed(scan.time_s, 6),
        "utc_ns": sample.utc_ns,
        "valid": refusal is None,
        "reason": None,
        "detail": None,
    }
    if refusal is not None:
        fields["reason"], fields["detail"] = refusal.reason.value, refusal.detail or None
    fields |= _posture_fields(posture if isinstance(posture, Posture) else None)
    fields["n_water"] = _fixed(scan.n_water, 6)
    fields |= _filtered_fields(sample.filtered)
    fields["rate_hz"] = _fixed(sample.health.rate_hz, 3)
    fields["delay_s"] = _delay_s(sample)
    fields["state"] = sample.health.state.value
    return fields


def _posture_fields(posture: Posture | None) -> dict[str, Value]:
    if posture is None:
        return dict.fromkeys(_POSTURE_KEYS)
    bent = (*(posture.curvature or ()), *(posture.sigma_curvature or ()))
    return dict(
        zip(
            _POSTURE_KEYS,
            (
                _fixed(posture.range, 6),
                _fixed(math.degrees(posture.pitch), 5),
                _fixed(math.degrees(posture.yaw), 5),
                *_sigmas(posture.covariance),
                _fixed(posture.slant_range, 6),
                _fixed(posture.nearest, 6),
                posture.n_points,
                *([_short(value) for value in bent] if len(bent) == 4 else [None] * 4),
                *_sigmas(posture.rig_covariance),
                *_sigmas(posture.total_covariance),
            ),
            strict=True,
        )
    )


def _filtered_fields(filtered: FilteredPosture | None) -> dict[str, Value]:
    if filtered is None:
        return dict.fromkeys(_FILTERED_KEYS)
    speed, pitch_rate, yaw_rate = filtered.rates.tolist()
    return dict(
        zip(
            _FILTERED_KEYS,
            (
                _fixed(filtered.range, 6),
                _fixed(math.degrees(filtered.pitch), 5),
                _fixed(math.degrees(filtered.yaw), 5),
                *_sigmas(filtered.covariance),
                _fixed(speed, 6),
                _fixed(math.degrees(pitch_rate), 5),
                _fixed(math.degrees(yaw_rate), 5),
                _fixed(filtered.age_s, 6),
                filtered.accepted,
                *_sigmas(filtered.total_covariance),
            ),
            strict=True,
        )
    )


def _delay_s(sample: LiveSample) -> Value:
    """Return the time from the decoded frame to its posture, None where there is no frame."""
    if sample.frame is None:
        return None
    return _fixed(1e-9 * (sample.instants.scanned_ns - sample.instants.arrived_ns), 6)


def _sigmas(cov: FloatArray) -> list[Value]:
    """Return the standard deviations of range (m), pitch and yaw (deg); None for what is none."""
    variances = np.diagonal(cov)[:3].tolist()
    sigma = [math.sqrt(value) if value >= 0.0 else math.nan for value in variances]
    return [_short(value) for value in (sigma[0], math.degrees(sigma[1]), math.degrees(sigma[2]))]


def _fixed(value: float, digits: int) -> Value:
    return round(float(value), digits) if math.isfinite(value) else None


def _short(value: float) -> Value:
    return float(f"{value:.4g}") if math.isfinite(value) else None
