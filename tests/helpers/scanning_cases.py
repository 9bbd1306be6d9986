"""Exact returns of laser stripes on made-up targets, to test what comes after detection."""

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Rig
from aqualvs.scanning.laser_bands import LaserBand, SearchAxis, plan_bands
from aqualvs.scanning.stripe import StripePeaks

Lit: TypeAlias = Callable[[FloatArray], BoolArray]


def everywhere(points: FloatArray) -> BoolArray:
    return np.ones(len(points), np.bool_)


def strands(points: FloatArray) -> BoolArray:
    """6 mm of light every 30 mm, along whichever way the stripe runs."""
    lit: BoolArray = (points[:, 0] + points[:, 2]) % 0.03 < 0.006
    return lit


def behind_strands(points: FloatArray) -> BoolArray:
    lit: BoolArray = (points[:, 0] + points[:, 2] + 0.002) % 0.04 > 0.012
    return lit


def lit_stripe(
    rig: Rig, search: LaserBand, laser: Plane, target: Plane, lit: Lit
) -> tuple[IntArray, FloatArray]:
    """Search lines and exact positions of one laser's stripe on a target, where it is lit."""
    along = np.cross(laser.normal, target.normal)
    along /= np.linalg.norm(along)
    foot = np.linalg.solve(
        np.array([laser.normal, target.normal, along]), [laser.offset, target.offset, 0.0]
    )
    points = foot + np.linspace(-0.8, 0.8, 8001)[:, None] * along
    camera = rig.camera()
    pixels, valid = camera.project(points)
    seen = valid & camera.inside_image(pixels)
    points, pixels = points[seen], pixels[seen]
    across, position = (1, 0) if search.axis is SearchAxis.ALONG_X else (0, 1)
    order = np.argsort(pixels[:, across])
    points, pixels = points[order], pixels[order]
    first, last = np.ceil(pixels[0, across]), np.floor(pixels[-1, across])
    line = np.arange(first, last + 1.0)
    at = np.searchsorted(pixels[:, across], line).clip(0, len(pixels) - 1)
    shown = lit(points[at])
    place = np.interp(line, pixels[:, across], pixels[:, position])
    return line[shown].astype(np.int64), place[shown]


def merged(*parts: StripePeaks) -> StripePeaks:
    """All peaks of one search direction, in order."""
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    order = np.lexsort((columns[1], columns[0]))
    return StripePeaks(*(column[order] for column in columns))


def peaks_of(
    rig: Rig, targets: Sequence[tuple[Plane, Lit]], noise_px: float = 0.0
) -> dict[SearchAxis, StripePeaks]:
    """Returns of every laser on every target, each in the search direction of its laser."""
    rng = np.random.default_rng(7)
    stripes: dict[SearchAxis, list[tuple[IntArray, FloatArray]]] = {}
    for laser, search in zip(rig.lasers, plan_bands(rig, rig.camera()), strict=True):
        for target, lit in targets:
            stripe = lit_stripe(rig, search, laser.plane, target, lit)
            stripes.setdefault(search.axis, []).append(stripe)
    found = {}
    for axis, parts in stripes.items():
        line = np.concatenate([part[0] for part in parts])
        position = np.concatenate([part[1] for part in parts])
        position = position + rng.normal(0.0, noise_px, len(line))
        order = np.lexsort((position, line))
        n = len(line)
        found[axis] = StripePeaks(
            line=line[order],
            position=position[order],
            height=np.full(n, 80.0),
            width=np.full(n, 5.0),
            likelihood=np.ones(n),
            pull=np.zeros(n),
        )
    return found
