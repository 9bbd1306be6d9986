"""The mesh filter on one stripe of 2000 points across a net, next to OpenCV on the whole image.

Run `python -m benchmarks mesh` for a table. The reference is Algorithm 1 of the paper as one would
write it: the laser-plane image and three sums over it by `cv2.filter2D`. It must keep the same
points.
"""

import math
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from aqualvs.geometry import Plane
from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.scanning.paper.mesh_filter import (
    MeshFilterOptions,
    laser_frame,
    laser_plane_image,
    mesh_filter,
    structuring_elements,
)

_OPTIONS = MeshFilterOptions()


def run(quick: bool = False) -> list[dict[str, Any]]:
    """Median CPU time of a call, of both in turns."""
    plane = Plane.from_normal([-0.02, -0.34, 0.94], -0.143)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        return [_row(plane, whole, rounds=20 if quick else 100) for whole in (False, True)]
    finally:
        cv2.setNumThreads(threads)


def _row(plane: Plane, whole: bool, rounds: int) -> dict[str, Any]:
    points = stripe(plane, bent_by=0.2 if whole else 0.0)
    kept = mesh_filter(points, plane)
    if not np.array_equal(kept, plain_filter(points, plane)) or not kept.any():
        raise RuntimeError("the reference keeps other points")
    value, reference = _median_ms(
        lambda: mesh_filter(points, plane), lambda: plain_filter(points, plane), rounds=rounds
    )
    shape = "bent" if whole else "straight"
    return {
        "name": f"mesh filter, {len(points)} points on a {shape} net",
        "value": value,
        "unit": "ms CPU",
        "reference": reference,
        "ratio": reference / value,
    }


def stripe(plane: Plane, bent_by: float) -> FloatArray:
    """Points (2000, 3) of 100 threads, whose net bends away at its ends by so many metres."""
    thread = np.arange(0.0, 10e-3, 0.5e-3)
    x = (np.arange(100)[:, None] * 25e-3 + thread[None, :]).ravel()
    x -= x.mean()
    away = 0.5 + bent_by * (x / x.max()) ** 2
    in_laser = np.stack([x, away, np.zeros_like(x)], axis=-1)
    return laser_frame(plane).inverse().apply(in_laser)


def plain_filter(points: FloatArray, plane: Plane) -> BoolArray:
    image = laser_plane_image(laser_frame(plane).apply(points)[:, :2], _OPTIONS.dd)
    lit = image.lit.astype(np.float32)
    a, b, c = (
        np.rint(cv2.filter2D(lit, -1, element.astype(np.float32), borderType=cv2.BORDER_CONSTANT))
        for element in structuring_elements(_OPTIONS)
    )
    dg = _OPTIONS.dg_theta
    kept = (math.ceil(dg / 2) <= a) & (a <= dg) & (b <= dg - a)
    kept &= (math.ceil(3 * dg / 2) <= c) & (c <= 2 * dg)
    found: BoolArray = kept[image.cells[:, 0], image.cells[:, 1]]
    return found


def _median_ms(*calls: Callable[[], object], rounds: int) -> list[float]:
    times = []
    for _ in range(rounds):
        row = []
        for call in calls:
            start = time.process_time()
            call()
            row.append(time.process_time() - start)
        times.append(row)
    return [1e3 * float(value) for value in np.median(times, axis=0)]
