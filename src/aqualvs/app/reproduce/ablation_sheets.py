"""What the refracted-sheet model is worth where a laser sits behind a tilted window."""

from dataclasses import replace

import numpy as np

from aqualvs.app.reproduce.experiment import Experiment, Finding, Outcome, Picture
from aqualvs.app.reproduce.laboratory import Laboratory
from aqualvs.app.reproduce.variants import Variant, drawn, findings, series
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Laser, Rig, Window
from aqualvs.optics.sheet import sheets_of
from aqualvs.simulation.lasers import LaserSource, default_sources
from aqualvs.simulation.scenario import Scenario
from aqualvs.simulation.scenario_file import parse_scenario

_TILTS_DEG = (-20.0, 12.0, 25.0)
"""Of the windows of the three lasers, against square to the beam, across the sheet."""

_BEFORE_SOURCE = 0.02
_GRID_PX = 24


def before_wall() -> Scenario:
    """Return the dive: a wall from near to far, turned a little to and fro."""
    facts = {
        "duration_s": 0.8,
        "motion": {
            "range_mm": [380, 800],
            "pitch_deg": [-6, 6],
            "yaw_deg": {"values": [0], "sway": 8, "period_s": 0.6},
        },
        "walls": [{}],
    }
    return parse_scenario(facts, "sheets", "sheets")


def _run(laboratory: Laboratory) -> Outcome:
    bent = _behind_windows(laboratory.rig)
    flat = _with_best_planes(bent)
    dive = laboratory.dive(before_wall(), bent)
    variants = [
        Variant("refracted sheets", (laboratory.measure(dive),), ours=True),
        Variant("planes that fit them best", (laboratory.measure(dive, rig=flat),)),
    ]
    off = _off_plane_mm(bent)
    return Outcome(
        sentence=f"Behind windows tilted by 12 to 25 degrees the light leaves its best plane by up "
        f"to {max(off):.1f} mm; taking it for planes costs {variants[1].rms[0]:.2f} % of the "
        f"range instead of {variants[0].rms[0]:.3f} %.",
        findings=(
            *findings(variants),
            *(
                Finding(
                    what=f"laser behind a window tilted by {tilt:g} degrees: farthest from its "
                    "best plane in the working range (mm)",
                    paper="",
                    ours=f"{mm:.1f}",
                )
                for tilt, mm in zip(_TILTS_DEG, off, strict=True)
            ),
        ),
        pictures=(
            Picture(
                name="ablation_sheets",
                caption="Root mean square errors before a wall with lasers behind tilted windows.",
                figure=drawn(variants),
            ),
        ),
        series=(series("ablation_sheets", variants),),
        notes=("The planes are the best that any calibration could find for such sheets.",),
    )


def _behind_windows(rig: Rig) -> Rig:
    sources = default_sources(rig)
    lasers = tuple(
        _behind_window(laser, source, np.deg2rad(tilt))
        for laser, source, tilt in zip(rig.lasers, sources, _TILTS_DEG, strict=True)
    )
    return replace(rig, name="windows", lasers=lasers)


def _behind_window(laser: Laser, source: LaserSource, tilt: float) -> Laser:
    normal = source.direction + np.tan(tilt) * laser.plane.normal
    normal /= np.linalg.norm(normal)
    face = Plane(normal, float(normal @ source.position) + _BEFORE_SOURCE)
    return replace(laser, window=Window(face, source.position))


def _with_best_planes(rig: Rig) -> Rig:
    camera = rig.camera()
    lasers = tuple(
        replace(laser, plane=sheet.best_plane(camera, rig.working_range), window=None)
        for laser, sheet in zip(rig.lasers, sheets_of(rig), strict=True)
    )
    return replace(rig, lasers=lasers)


def _off_plane_mm(rig: Rig) -> list[float]:
    """Return for each laser how far what the camera sees of its sheet leaves its best plane."""
    camera, (near, far) = rig.camera(), rig.working_range
    width, height = rig.size_px
    x, y = np.meshgrid(np.arange(0.0, width, _GRID_PX), np.arange(0.0, height, _GRID_PX))
    rays = camera.rays(np.stack([x, y], axis=-1))
    found = []
    for sheet in sheets_of(rig):
        points, valid = sheet.intersect(rays)
        distance = np.linalg.norm(points, axis=-1)
        here = points[valid & (distance >= near) & (distance <= far)]
        plane = sheet.best_plane(camera, rig.working_range)
        found.append(1e3 * float(np.abs(plane.signed_distance(here)).max()))
    return found


EXPERIMENT = Experiment(
    name="sheets",
    title="Why refracted laser sheets",
    paper="",
    about="The rig with each laser behind a flat window that is tilted against its beam; the wall "
    "measured with the refracted-sheet model and with the planes of the paper's Eq. 19.",
    run=_run,
)
