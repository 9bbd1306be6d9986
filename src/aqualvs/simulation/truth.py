"""One row of truth for every frame."""

from typing import TypeAlias

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Rig
from aqualvs.simulation.lit_points import LitPoints
from aqualvs.simulation.scene import Label, Scene, Target

Cell: TypeAlias = int | float | str

TRUTH_COLUMNS = (
    *("frame", "time_s", "range_mm", "pitch_deg", "yaw_deg", "medium", "n_outside", "target"),
    *("lasers_on", "nx", "ny", "nz", "d_mm"),
    *("visible_fit_range_mm", "visible_fit_pitch_deg", "visible_fit_yaw_deg"),
    *("visible_fit_max_resid_mm", "pts_net", "pts_wall", "pts_fish", "pts_bubble", "pts_solid"),
)
"""Columns of `truth.csv`.

Range, pitch, yaw, normal and d are those of the target plane; empty without a target. The
`visible_fit` columns hold the plane through all visible lit points of the target (for a net they
lie on the front of the twine, up to a twine radius before the net plane); empty where the points
do not span a plane. The `pts` columns count visible lit points by what they lie on.
"""

# Lit points whose second spread is below this fraction of their first lie on one line.
_FLAT = 0.02
_AIR = 1.1
_LABELS: dict[Target, Label] = {"net": Label.NET, "wall": Label.WALL}


def truth_row(frame: int, t: float, scene: Scene, rig: Rig, lit: LitPoints) -> list[Cell]:
    """Return the cells of one frame, in the order of `TRUTH_COLUMNS`."""
    medium = "water" if rig.n_water > _AIR else "air"
    counts: list[Cell] = [int(np.sum(lit.label == label)) for label in list(Label)[1:]]
    head: list[Cell] = [frame, f"{t:.4f}"]
    middle: list[Cell] = [medium, rig.n_water, scene.target, int(scene.lasers_on)]
    if scene.target == "none":
        return [*head, "", "", "", *middle, *([""] * 8), *counts]
    plane = scene.target_plane()
    fit = visible_fit(lit, _LABELS[scene.target])
    seen: list[Cell] = [""] * 4
    if fit is not None:
        seen = [*_posture(fit[0]), 1e3 * fit[1]]
    row = [*head, *_posture(plane), *middle, *plane.normal.tolist(), 1e3 * plane.offset]
    return [*row, *seen, *counts]


def _posture(plane: Plane) -> list[Cell]:
    """Range in mm, pitch and yaw in degrees (docs/conventions.md)."""
    nx, ny, nz = plane.normal.tolist()
    pitch, yaw = np.arctan2(nz, ny), np.arctan2(nx, ny)
    return [1e3 * plane.offset, float(np.rad2deg(pitch)), float(np.rad2deg(yaw))]


def visible_fit(lit: LitPoints, label: Label) -> tuple[Plane, float] | None:
    """Return the least-squares plane through the lit points of a label and its largest residual.

    None where the points are fewer than three or on one line. The residual is in metres.
    """
    points: FloatArray = lit.points_in_dome[lit.label == label]
    if len(points) < 3:
        return None
    centre = points.mean(axis=0)
    _, spread, axes = np.linalg.svd(points - centre, full_matrices=False)
    if spread[1] < _FLAT * spread[0]:
        return None
    plane = Plane(axes[2], float(axes[2] @ centre)).facing_origin()
    return plane, float(np.abs(plane.signed_distance(points)).max())
