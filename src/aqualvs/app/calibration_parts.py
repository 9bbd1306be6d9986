"""Parts of a calibration's page that all steps have."""

import math
import shlex
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime

import numpy as np

from aqualvs import __version__
from aqualvs.app.calibration_material import ExpectationRow, ParameterRow, ResidualMap, ViewRow
from aqualvs.calibration.view import View
from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.transforms import rotvec_from_rotation
from aqualvs.optics.assumed import completed_uncertainty
from aqualvs.optics.expected_error import expected_posture_errors
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL, Rig
from aqualvs.optics.uncertainty import RigUncertainty

_DEG = 180.0 / math.pi
_NAMES = {
    "lens_x": ("lens x", "mm", 1e3, 3),
    "lens_y": ("lens y", "mm", 1e3, 3),
    "lens_z": ("lens z", "mm", 1e3, 3),
    "rotation_x": ("camera rotation x", "°", _DEG, 3),
    "rotation_y": ("camera rotation y", "°", _DEG, 3),
    "rotation_z": ("camera rotation z", "°", _DEG, 3),
    "inner_radius": ("dome inner radius", "mm", 1e3, 3),
    "thickness": ("dome thickness", "mm", 1e3, 3),
    "n_air": ("index of the air inside", "", 1.0, 5),
    "n_acrylic": ("index of the dome", "", 1.0, 4),
    "n_water": ("index of the water", "", 1.0, 5),
    "fx": ("fx", "px", 1.0, 2),
    "fy": ("fy", "px", 1.0, 2),
    "cx": ("cx", "px", 1.0, 2),
    "cy": ("cy", "px", 1.0, 2),
}


def expectations(rig: Rig) -> tuple[ExpectationRow, ...]:
    """Return what a rig's calibration means on a wall at the usual ranges; none without lasers."""
    if not rig.lasers:
        return ()
    return tuple(
        ExpectationRow(
            range_m=found.wall_range,
            sigma_range_mm=1e3 * float(found.sigma_calibration[0]),
            sigma_pitch_deg=_DEG * float(found.sigma_calibration[1]),
            sigma_yaw_deg=_DEG * float(found.sigma_calibration[2]),
            noise_range_mm=1e3 * float(found.sigma_noise[0]),
            noise_pitch_deg=_DEG * float(found.sigma_noise[1]),
            noise_yaw_deg=_DEG * float(found.sigma_noise[2]),
        )
        for found in expected_posture_errors(rig, completed_uncertainty(rig))
    )


def parameter_rows(
    rig: Rig,
    uncertainty: RigUncertainty,
    names: Sequence[str],
    before: Rig | None = None,
    remarks: Mapping[str, str] | None = None,
) -> tuple[ParameterRow, ...]:
    """Return the named numbers of a rig's camera, with sigma and what they were before."""
    values, sigmas = camera_numbers(rig), uncertainty.sigmas
    old = {} if before is None else camera_numbers(before)
    rows = []
    for name in names:
        label, unit, factor, digits = _NAMES.get(name, (name, "", 1.0, 5))
        sigma = sigmas.get(name)
        rows.append(
            ParameterRow(
                name=label,
                value=factor * values[name],
                sigma=None if not sigma else factor * sigma,
                unit=unit,
                digits=digits,
                before=factor * old[name] if name in old else None,
                remark=(remarks or {}).get(name, ""),
            )
        )
    return tuple(rows)


def camera_numbers(rig: Rig) -> dict[str, float]:
    """Return the numbers of a rig's camera by name, SI units and radians.

    The rotation is the rig file's: a vector that is applied after the nominal mounting.
    """
    lens = rig.lens
    values = (lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion)
    numbers = dict(zip(lens.parameter_names, values, strict=True))
    turn = rotvec_from_rotation(rig.dome_from_cam.rotation @ DOME_FROM_CAM_NOMINAL.T)
    for axis, place, angle in zip("xyz", rig.dome_from_cam.translation, turn, strict=True):
        numbers[f"lens_{axis}"] = float(place)
        numbers[f"rotation_{axis}"] = float(angle)
    numbers["n_air"], numbers["n_water"] = rig.n_air, rig.n_water
    if rig.dome is not None:
        numbers["inner_radius"] = rig.dome.inner_radius
        numbers["thickness"] = rig.dome.thickness
        numbers["n_acrylic"] = rig.dome.n_acrylic
    return numbers


def residual_map(
    title: str,
    size_px: tuple[int, int],
    views: Sequence[View],
    residuals: Sequence[FloatArray],
    inliers: Sequence[BoolArray],
) -> ResidualMap:
    """Return the residuals (measured minus predicted, px) of several views as one map."""
    return ResidualMap(
        title=title,
        size_px=size_px,
        pixels=np.concatenate([view.pixels for view in views]),
        residuals=np.concatenate(list(residuals)),
        view_index=np.concatenate([np.full(len(view), i) for i, view in enumerate(views)]),
        inliers=np.concatenate(list(inliers)),
    )


def missed_rows(missed: Mapping[str, str]) -> tuple[ViewRow, ...]:
    """Return rows for the pictures in which the target was not found."""
    return tuple(
        ViewRow(name=name, n_points=0, rms_px=float("nan"), remark=why, used=False)
        for name, why in missed.items()
    )


def facts(*more: tuple[str, str]) -> tuple[tuple[str, str], ...]:
    """Return date, command and version, and what else is given."""
    command = shlex.join(["aqualvs", *sys.argv[1:]])
    # Hundreds of pictures say no more than the first and the last few.
    if len(command) > 600:
        command = f"{command[:300]} ... {command[-280:]}"
    return (
        ("date", datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")),
        ("command", command),
        ("aqualvs", __version__),
        *more,
    )
