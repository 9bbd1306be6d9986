"""Rigs whose lasers sit behind flat windows, for tests."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Laser, Rig, Window
from aqualvs.simulation.lasers import LaserSource, default_sources

# Windows of the three lasers of an example rig, tilted across the sheet and along it, degrees.
TILTS_DEG = ((-20.0, 5.0), (12.0, -6.0), (25.0, 10.0))
# Outer face before the source, in metres.
BEFORE_SOURCE = 0.02


def behind_window(
    laser: Laser, source: LaserSource, across_deg: float, along_deg: float = 0.0
) -> Laser:
    """The same laser in air, behind a window that is turned from square to the fan's middle."""
    side = np.cross(laser.plane.normal, source.direction)
    tilted = (
        source.direction
        + np.tan(np.deg2rad(across_deg)) * laser.plane.normal
        + np.tan(np.deg2rad(along_deg)) * side
    )
    normal = tilted / np.linalg.norm(tilted)
    offset = float(normal @ source.position) + BEFORE_SOURCE
    return replace(laser, window=Window(Plane(normal, offset), source.position))


def windowed(rig: Rig, tilts_deg: Sequence[tuple[float, float]] = TILTS_DEG) -> Rig:
    """The rig with all its lasers behind windows; its sheets in air stay where they are."""
    lasers = zip(rig.lasers, default_sources(rig), tilts_deg, strict=True)
    return replace(rig, lasers=tuple(behind_window(a, b, *tilt) for a, b, tilt in lasers))
