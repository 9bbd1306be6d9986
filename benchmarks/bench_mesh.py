"""The mesh filter on one stripe of 2000 points across a net."""

import time
from typing import Any

import numpy as np

from aqualvs.geometry import Plane
from aqualvs.scanning.mesh import laser_frame, mesh_filter

_TARGET_MS = 0.5


def run() -> list[dict[str, Any]]:
    """Median time of a call, on one core; the target stands where others publish nothing."""
    plane = Plane.from_normal([-0.02, -0.34, 0.94], -0.143)
    thread = np.arange(0.0, 10e-3, 0.5e-3)
    x = (np.arange(100)[:, None] * 25e-3 + thread[None, :]).ravel()
    in_laser = np.stack([x - x.mean(), np.full_like(x, 0.5), np.zeros_like(x)], axis=-1)
    points = laser_frame(plane).inverse().apply(in_laser)
    value = _median_ms(points, plane)
    return [
        {
            "name": f"mesh filter, {len(points)} points",
            "value": value,
            "unit": "ms",
            "reference": _TARGET_MS,
            "ratio": _TARGET_MS / value,
        }
    ]


def _median_ms(points: np.ndarray[Any, Any], plane: Plane) -> float:
    mesh_filter(points, plane)
    times = []
    for _ in range(200):
        start = time.perf_counter()
        mesh_filter(points, plane)
        times.append(time.perf_counter() - start)
    return float(np.median(times)) * 1e3
