"""Samples as messages, for the recording and for Foxglove; definitions are in `schemas.py`.

All of them are in the frame `dome`, with angles in degrees as every border has them. Numbers that
do not exist are NaN.
"""

import math
from typing import Any

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.live.health import Health, PartHealth, State
from aqualvs.live.recorder.cdr import CdrReader, CdrWriter
from aqualvs.live.recorder.rig_record import options_text, rig_exact, rig_yaml
from aqualvs.live.sample import LiveSample
from aqualvs.live.time_filter import FilteredPosture
from aqualvs.optics.rig import Rig
from aqualvs.scanning.pipeline import ScannerOptions
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.scanning.scan import ScanPoints
from aqualvs.scanning.search import SearchAxis
from aqualvs.scanning.stripe import Returns

FRAME_ID = "dome"
_NAN = math.nan
_STATES = {State.OFF: 0, State.OK: 1, State.WARN: 2, State.FAULT: 3}
_FLOAT32, _UINT8 = 7, 2
_FLOATS = ("x", "y", "z", "quality")
_BYTES = ("intensity", "laser", "label", "used")
_POINT = np.dtype([*((name, "<f4") for name in _FLOATS), *((name, "u1") for name in _BYTES)])


def posture_message(sample: LiveSample, stamp_ns: int) -> bytes:
    """Return range, pitch and yaw, raw and filtered."""
    scan, posture, to = sample.scan, sample.scan.posture, CdrWriter()
    to.header(stamp_ns, FRAME_ID)
    to.numbers("q", scan.index)
    to.numbers("d", scan.time_s)
    to.numbers("?", bool(posture))
    to.text("" if isinstance(posture, Posture) else posture.reason.value)
    to.text("" if isinstance(posture, Posture) else posture.detail)
    values = _posture_values(posture)
    to.numbers("d", *values[:9], scan.n_water, *values[9:])
    to.numbers("i", posture.n_points if isinstance(posture, Posture) else 0, len(scan.points))
    filtered = sample.filtered
    to.numbers("?", filtered is not None, filtered is not None and filtered.accepted)
    to.numbers("d", *_filtered_values(filtered))
    instants = sample.instants
    to.numbers("d", 1e-9 * (instants.scanned_ns - instants.arrived_ns))
    to.numbers("d", *_rig_values(posture))
    return to.finish()


def stripes_message(sample: LiveSample, stamp_ns: int) -> bytes:
    """Return what was detected, bit for bit, or why nothing was measured."""
    scan, to = sample.scan, CdrWriter()
    refusal = scan.posture if not sample.returns and not scan.posture else None
    to.header(stamp_ns, FRAME_ID)
    to.numbers("q", scan.index)
    to.numbers("d", scan.time_s, scan.n_water)
    to.text("" if refusal is None else refusal.reason.value)
    to.text("" if refusal is None else refusal.detail)
    to.numbers("I", len(sample.returns))
    for axis, found in sample.returns.items():
        to.text(axis.value)
        to.array(found.line.astype(np.uint32))
        for column in (found.position, found.height, found.width, found.likelihood):
            to.array(column)
    return to.finish()


def stripes_of(
    message: bytes,
) -> tuple[int, float, float, dict[SearchAxis, Returns], Refusal | None]:
    """Return frame, time, index of the water, stripes and refusal of a message.

    Raises
    ------
    ValueError
        If it is none of `stripes_message`.
    """
    of = CdrReader(message)
    of.header()
    index = of.number("q")
    time_s, n_water = of.numbers("d", 2)
    reason, detail = of.text(), of.text()
    returns = {}
    for _ in range(of.number("I")):
        axis = SearchAxis(of.text())
        line = of.array("u4").astype(np.int64)
        position, height, width, likelihood = (of.array("f8") for _ in range(4))
        # Recordings of 0.1.0 hold levels here, of returns that had passed a gate; NaN if grey.
        likelihood = np.where(np.isnan(likelihood), 1.0, np.minimum(likelihood, 1.0))
        returns[axis] = Returns(line, position, height, width, likelihood)
    return index, time_s, n_water, returns, Refusal(Reason(reason), detail) if reason else None


def points_message(points: ScanPoints, stamp_ns: int) -> bytes:
    """Return a point cloud; `label` is a number of `Label`, `laser` that of the rig."""
    cloud = np.empty(len(points), _POINT)
    cloud["x"], cloud["y"], cloud["z"] = points.points_in_dome.T
    cloud["quality"] = points.quality
    cloud["intensity"] = np.clip(points.intensity, 0.0, 255.0)
    cloud["laser"], cloud["label"], cloud["used"] = points.laser, points.label, points.used
    to = CdrWriter()
    to.header(stamp_ns, FRAME_ID)
    to.numbers("I", 1, len(points), len(_FLOATS) + len(_BYTES))
    for i, name in enumerate(_FLOATS + _BYTES):
        is_float = i < len(_FLOATS)
        to.text(name)
        to.numbers("I", 4 * i if is_float else 3 * len(_FLOATS) + i)
        to.numbers("B", _FLOAT32 if is_float else _UINT8)
        to.numbers("I", 1)
    to.numbers("?", False)
    to.numbers("I", _POINT.itemsize, cloud.nbytes)
    to.blob(cloud.tobytes())
    to.numbers("?", True)
    return to.finish()


def health_message(health: Health, stamp_ns: int) -> bytes:
    """Return how the run goes."""
    to = CdrWriter()
    to.header(stamp_ns, "")
    to.numbers("B", _STATES[health.state])
    to.numbers("d", health.rate_hz, health.valid_share, health.quality)
    to.numbers("d", health.n_water, health.sigma_n_water)
    to.numbers("q", health.n_frames, health.n_dropped, health.n_lost)
    parts = [("source", health.source)]
    parts += [("laser", part) for part in health.lasers]
    parts += [("output", part) for part in health.outputs]
    to.numbers("I", len(parts))
    for kind, part in parts:
        _put_part(to, kind, part)
    to.numbers("I", len(health.delays))
    for delay in health.delays:
        to.text(delay.name)
        to.numbers("d", delay.median_s, delay.p99_s)
    return to.finish()


def rig_texts(rig: Rig, options: ScannerOptions) -> tuple[str, str, str]:
    """Return the rig file, its exact numbers and the scanner's options as a message has them."""
    return rig_yaml(rig), rig_exact(rig), options_text(options)


def rig_message(texts: tuple[str, str, str], stamp_ns: int) -> bytes:
    """Return what the run measures with, from `rig_texts`."""
    to = CdrWriter()
    to.header(stamp_ns, FRAME_ID)
    for words in texts:
        to.text(words)
    return to.finish()


def rig_texts_of(message: bytes) -> tuple[str, str, str]:
    """Return the rig file, its exact numbers and the scanner's options of a message.

    Raises
    ------
    ValueError
        If it is none of `rig_message`.
    """
    of = CdrReader(message)
    of.header()
    return of.text(), of.text(), of.text()


def image_message(kind: str, data: bytes, stamp_ns: int) -> bytes:
    """Return a picture; `kind` is jpeg or png."""
    to = CdrWriter()
    to.header(stamp_ns, "cam")
    to.text(kind)
    to.blob(data)
    return to.finish()


def image_of(message: bytes) -> tuple[str, bytes]:
    """Return kind and bytes of a picture's message.

    Raises
    ------
    ValueError
        If it is none of `image_message`.
    """
    of = CdrReader(message)
    of.header()
    return of.text(), of.blob()


def _posture_values(posture: Posture | Refusal) -> list[float]:
    """Return nine scalars, normal, covariance and curvatures."""
    if not isinstance(posture, Posture):
        return [_NAN] * 25
    curvature = posture.curvature or (_NAN, _NAN)
    sigma_curvature = posture.sigma_curvature or (_NAN, _NAN)
    return [
        *(posture.range, math.degrees(posture.pitch), math.degrees(posture.yaw)),
        *_sigmas(posture.covariance),
        *(posture.slant_range, posture.nearest, posture.rms),
        *posture.normal_in_dome,
        *np.ravel(posture.covariance),
        *curvature,
        *sigma_curvature,
    ]


def _rig_values(posture: Posture | Refusal) -> list[float]:
    """Return standard deviations by the rig and by both, and the covariance by the rig."""
    if not isinstance(posture, Posture):
        return [_NAN] * 15
    return [
        *_sigmas(posture.rig_covariance),
        *_sigmas(posture.total_covariance),
        *np.ravel(posture.rig_covariance),
    ]


def _sigmas(covariance: FloatArray) -> list[float]:
    sigma = np.sqrt(np.diagonal(covariance))
    return [sigma[0], math.degrees(sigma[1]), math.degrees(sigma[2])]


def _filtered_values(filtered: FilteredPosture | None) -> list[float]:
    if filtered is None:
        return [_NAN] * 7
    rates: Any = filtered.rates
    return [
        *(filtered.range, math.degrees(filtered.pitch), math.degrees(filtered.yaw)),
        *(float(rates[0]), math.degrees(rates[1]), math.degrees(rates[2])),
        filtered.age_s,
    ]


def _put_part(to: CdrWriter, kind: str, part: PartHealth) -> None:
    to.text(kind)
    to.text(part.name)
    to.numbers("B", _STATES[part.state])
    to.text(part.detail)
    to.numbers("q", part.n_dropped)
