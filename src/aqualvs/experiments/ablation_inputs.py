"""Ablations of the inputs: wrong rig parameters, the refracted sheet, and video coding.

They measure the errors by a wrong refractive index and by a wrong position of the lens; the gain of
the refracted-sheet model for lasers behind tilted windows; and the errors by H.264 at several
qualities against uncompressed pictures.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from aqualvs.experiments.experiment import (
    DataColumns,
    Experiment,
    ExperimentResult,
    ExperimentRow,
    drawn,
)
from aqualvs.experiments.growth_and_sun import scene
from aqualvs.experiments.laboratory import Laboratory, RenderedDive, Variant, compared
from aqualvs.experiments.tank import wall_dive
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.rig import Rig, Window
from aqualvs.optics.sheet import sheets_of
from aqualvs.report.figure_style import BLUE, GREEN, GREY, ORANGE
from aqualvs.simulation.lasers import default_sources
from aqualvs.simulation.scenario import Scenario, parse_scenario
from aqualvs.simulation.video import Compression


def _run_video(laboratory: Laboratory) -> ExperimentResult:
    # The growth experiment has rendered its clear net at the default quality already.
    course = scene("clear")
    raw = laboratory.dive(course, recording=Compression(codec="lossless"))
    variants = [_variant(laboratory, raw, "uncompressed")]
    crfs = (20, 26, 32, 38)
    default = 20
    for crf in crfs:
        dive = laboratory.dive(course, recording=Compression(crf=crf))
        variants.append(_variant(laboratory, dive, f"H.264 crf {crf}", ours=crf == default))
    first, last = variants[1].measured, variants[-1].measured
    at_last = f"it is {last.rms[0]:.3f} %" if last.valid_percent else "no frame has a posture"
    return compared(
        "ablation_video",
        "Root mean square errors on a clear net from the same pictures, uncompressed and at four "
        "qualities of H.264.",
        variants,
        sentence=f"Against uncompressed pictures H.264 of good quality changes the range error "
        f"from {variants[0].measured.rms[0]:.3f} to {first.rms[0]:.3f} %; at {variants[-1].name} "
        f"{at_last}.",
    )


def _variant(laboratory: Laboratory, dive: RenderedDive, name: str, ours: bool = False) -> Variant:
    frames = dive.scenario.n_frames
    rate = 8e-6 * dive.video.stat().st_size * dive.scenario.fps / frames
    return Variant(f"{name}, {rate:.1f} Mbit/s", laboratory.measure(dive), ours)


VIDEO = Experiment(
    title="What H.264 costs",
    about="The same pictures of a clear net, uncompressed and as H.264 at four qualities.",
    run=_run_video,
)


_TILTS_DEG = (-20.0, 12.0, 25.0)
"""Tilts of the windows of the three lasers from perpendicular to the beam, across the sheet."""


def before_wall() -> Scenario:
    """Return the dive: a wall from near to far, whose yaw swings by 8 degrees."""
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


def _run_sheets(laboratory: Laboratory) -> ExperimentResult:
    bent = _behind_windows(laboratory.rig)
    flat = _with_best_planes(bent)
    dive = laboratory.dive(before_wall(), bent)
    variants = [
        Variant("refracted sheets", laboratory.measure(dive), ours=True),
        Variant("planes that fit them best", laboratory.measure(dive, rig=flat)),
    ]
    off = _off_plane_mm(bent)
    return compared(
        "ablation_sheets",
        "Root mean square errors on a wall with lasers behind tilted windows.",
        variants,
        sentence=f"Behind windows tilted by 12 to 25 degrees the light deviates from its best "
        f"plane by up to {max(off):.1f} mm; with planes the range error is "
        f"{variants[1].measured.rms[0]:.2f} % instead of {variants[0].measured.rms[0]:.3f} %.",
        more_findings=[
            ExperimentRow(
                what=f"laser behind a window tilted by {tilt:g} degrees: farthest from its best "
                "plane in the working range (mm)",
                ours=f"{mm:.1f}",
            )
            for tilt, mm in zip(_TILTS_DEG, off, strict=True)
        ],
        notes=("The planes are the best that a calibration could find for such sheets.",),
    )


def _behind_windows(rig: Rig) -> Rig:
    # Distance of a window from its source, in metres.
    distance = 0.02
    lasers = []
    for laser, source, tilt in zip(rig.lasers, default_sources(rig), _TILTS_DEG, strict=True):
        normal = source.direction + np.tan(np.deg2rad(tilt)) * laser.plane.normal
        normal /= np.linalg.norm(normal)
        face = Plane(normal, float(normal @ source.position) + distance)
        lasers.append(replace(laser, window=Window(face, source.position)))
    return replace(rig, name="windows", lasers=tuple(lasers))


def _with_best_planes(rig: Rig) -> Rig:
    camera = rig.camera()
    lasers = tuple(
        replace(laser, plane=sheet.best_plane(camera, rig.working_range), window=None)
        for laser, sheet in zip(rig.lasers, sheets_of(rig), strict=True)
    )
    return replace(rig, lasers=lasers)


def _off_plane_mm(rig: Rig) -> list[float]:
    """Return the largest distance of the visible part of each laser's sheet from its best plane."""
    camera, (near, far) = rig.camera(), rig.working_range
    width, height = rig.size_px
    grid_px = 24
    x, y = np.meshgrid(np.arange(0.0, width, grid_px), np.arange(0.0, height, grid_px))
    rays = camera.rays(np.stack([x, y], axis=-1))
    found = []
    for sheet in sheets_of(rig):
        points, valid = sheet.intersect(rays)
        distance = np.linalg.norm(points, axis=-1)
        here = points[valid & (distance >= near) & (distance <= far)]
        plane = sheet.best_plane(camera, rig.working_range)
        found.append(1e3 * float(np.abs(plane.signed_distance(here)).max()))
    return found


SHEETS = Experiment(
    title="Why refracted laser sheets",
    about="Each laser of the rig is behind a flat window tilted relative to its beam; the wall is "
    "measured with the refracted-sheet model and with the planes of the paper's Eq. 19.",
    run=_run_sheets,
)


# Errors of the assumed index.
_INDEX_STEPS = (-0.010, -0.005, 0.0, 0.005, 0.010)
# Errors of the assumed position: with larger ones, the stripes of this strongly decentred lens no
# longer share a plane.
_LENS_STEPS_MM = (-0.5, -0.25, 0.0, 0.25, 0.5)
_AXES = ("right", "forward", "up")
_COLOURS = (ORANGE, BLUE, GREEN)
_WATERS = 0.007
"""Difference of the index between fresh and sea water (S = 35): the error without a measurement."""


def _run_beliefs(laboratory: Laboratory) -> ExperimentResult:
    dive = wall_dive(laboratory)
    waters = [dive.rig.in_water(dive.rig.n_water + step) for step in _INDEX_STEPS]
    index = np.array([_worst(laboratory, dive, rig) for rig in waters])
    lens = np.array(
        [
            [_worst(laboratory, dive, _with_lens(dive.rig, axis, mm)) for mm in _LENS_STEPS_MM]
            for axis in range(3)
        ]
    )
    per_index = _slope(_INDEX_STEPS, index) * _WATERS
    per_mm = np.array([_slope(_LENS_STEPS_MM, row) for row in lens])
    return ExperimentResult(
        sentence=f"With sea water assumed to be fresh the range error through this dome is "
        f"{per_index:.2f} %; with the lens assumed 1 mm off it is up to {per_mm.max():.1f} %.",
        findings=(
            ExperimentRow(
                what=f"range error for an index wrong by {_WATERS} (%)", ours=f"{per_index:.2f}"
            ),
            *(
                ExperimentRow(
                    what=f"range error for each mm that the lens is assumed too far {name} (%)",
                    ours=f"{cost:.2f}",
                )
                for name, cost in zip(_AXES, per_mm, strict=True)
            ),
        ),
        pictures=(
            drawn(
                "ablation_beliefs",
                "Largest range error before the wall at the paper's four distances if the scanner "
                "assumes another index of the water (left) or another position of the lens in the "
                "dome (right).",
                2.7,
                lambda figure: _draw_beliefs(figure, index, lens),
            ),
        ),
        series=(
            DataColumns(
                name="ablation_index",
                columns={"index_error": np.array(_INDEX_STEPS), "range_error_percent": index},
            ),
            DataColumns(
                name="ablation_lens",
                columns={"lens_error_mm": np.array(_LENS_STEPS_MM)}
                | dict(zip((f"{name}_range_error_percent" for name in _AXES), lens, strict=True)),
            ),
        ),
        notes=(
            "The laser planes are those of the true rig. Lasers calibrated with the wrong "
            "assumption would absorb a part of the error near the ranges of calibration.",
            "Where a point is missing, the lasers' points shared no plane, and the posture "
            "was refused.",
        ),
    )


def _with_lens(rig: Rig, axis: int, step_mm: float) -> Rig:
    position = rig.dome_from_cam.translation.copy()
    position[axis] += 1e-3 * step_mm
    return replace(rig, dome_from_cam=SE3(rig.dome_from_cam.rotation, position))


def _worst(laboratory: Laboratory, dive: RenderedDive, rig: Rig) -> float:
    """Return the range error of largest magnitude, in percent, with its sign; NaN if none."""
    percent = laboratory.measure(dive, rig=rig).errors[:, 0]
    found = percent[np.isfinite(percent)]
    return float(found[np.argmax(np.abs(found))]) if len(found) else np.nan


def _slope(steps: Sequence[float], percent: FloatArray) -> float:
    """Return the magnitude of the slope of the errors, without those that are NaN."""
    valid = np.isfinite(percent)
    return float(abs(np.polyfit(np.array(steps)[valid], percent[valid], 1)[0]))


def _draw_beliefs(figure: Figure, index: FloatArray, lens: FloatArray) -> None:
    left, right = figure.subplots(1, 2)
    left.plot(_INDEX_STEPS, index, ".-", color=BLUE)
    left.set(xlabel="error of the assumed index", ylabel="error of the range (%)")
    for row, name, colour in zip(lens, _AXES, _COLOURS, strict=True):
        right.plot(_LENS_STEPS_MM, row, ".-", color=colour, label=name)
    right.set_xlabel("error of the assumed lens position (mm)")
    right.legend(loc="best")
    for axes in (left, right):
        axes.axhline(0.0, color=GREY, linewidth=0.7)


BELIEFS = Experiment(
    title="What wrong assumptions cost",
    about="The wall at the paper's four distances, measured with the true rig except for one "
    "parameter: the index of the water, or the position of the lens in the dome.",
    run=_run_beliefs,
)
