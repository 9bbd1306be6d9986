"""Content of a calibration's page, as plain values that the calibration commands fill in.

`CalibrationPage` is the whole page; the functions below it make the parts that all steps share.
Units are those of the page, as the suffixes of the names say. An unknown number is NaN, or None
where the type allows it; the page shows a dash for it. Every part of a page may be empty.
"""

import math
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal, TypeAlias

import numpy as np

from aqualvs import __version__
from aqualvs.calibration.targets.targets import View
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.optics.expected_error import ExpectedError, expected_posture_errors
from aqualvs.optics.rig import Rig, RigUncertainty
from aqualvs.optics.solved import completed_uncertainty, rig_numbers
from aqualvs.report.html import Card
from aqualvs.scanning.scan import ImagePlane

MarkKind: TypeAlias = Literal["cross", "dot", "circle"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualMap:
    """Reprojection residuals over the picture, for the points of all views together."""

    title: str
    size_px: tuple[int, int]  # Width and height of the pictures.
    # Shape (N, 2): measured points as (x, y); rows that are not finite are left out.
    pixels: FloatArray
    # Shape (N, 2): measured minus predicted, in pixels.
    residuals: FloatArray
    # Shape (N,): row of the view in `CalibrationPage.views`.
    view_index: IntArray
    # Shape (N,): False for points that the solution did not use.
    inliers: BoolArray

    @property
    def used_residuals(self) -> FloatArray:
        """Residuals of the points that the solution used."""
        return self.residuals[self.inliers]


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewRow:
    """One view: a picture in which the target was looked for."""

    name: str
    n_points: int
    rms_px: float  # Of the distances between measured and predicted points.
    remark: str = ""  # Why it was left out, say; may be empty.
    used: bool = True  # Whether the solution rests on it.


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterRow:
    """One calibrated parameter."""

    name: str
    value: float
    sigma: float | None  # Standard deviation; None for a parameter that was held.
    unit: str = ""
    digits: int = 2  # Decimals of the value.
    before: float | None = None  # What the rig said before the calibration.


@dataclass(frozen=True, slots=True, kw_only=True)
class LaserRow:
    """One calibrated laser plane, n·X = offset in `dome`."""

    name: str
    normal: FloatArray  # Shape (3,): unit normal in `dome`.
    offset_mm: float
    # Standard deviations of the normal's direction and of the offset.
    sigma_normal_deg: float
    sigma_offset_mm: float
    # Of the points' distances from the plane, in the picture and in space.
    rms_px: float
    rms_mm: float

    n_points: int
    surfaces: str = ""  # What its stripes were seen on: "floor, back wall".
    model: str = "plane"  # "plane" or "refracted sheet".
    moved: str = ""  # In words, against the rig before; may be empty.


@dataclass(frozen=True, slots=True, kw_only=True)
class Series:
    """A value over something, usually time."""

    title: str
    x_label: str
    y_label: str
    # Shape (N,): `x` ascending; the line is broken where `y` is NaN.
    x: FloatArray
    y: FloatArray
    # Shape (N,): standard deviations of `y`, drawn as a band.
    sigma: FloatArray | None = None
    # A named horizontal line.
    level: tuple[str, float] | None = None
    # Places on the x axis and what happened there.
    marks: tuple[tuple[float, str], ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Overlay:
    """Points drawn over a picture."""

    # Shape (N, 2): (x, y) in the full picture; rows that are not finite are left out.
    pixels: FloatArray
    # #RRGGBB.
    colour: str
    kind: MarkKind = "cross"
    # What they are, for the legend; without one the legend leaves them out.
    label: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureShot:
    """A picture with points drawn over it."""

    caption: str
    image: ImagePlane  # Shape (height, width) or (height, width, 3): grey, or blue, green, red.
    points: tuple[Overlay, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationPage:
    """The page of one calibration."""

    title: str
    subtitle: str = ""
    cards: tuple[Card, ...] = ()  # The headline's numbers.
    warnings: tuple[str, ...] = ()
    words: tuple[str, ...] = ()  # What was found, one plain sentence each.
    residual_maps: tuple[ResidualMap, ...] = ()
    views: tuple[ViewRow, ...] = ()
    parameters: tuple[ParameterRow, ...] = ()
    expectations: tuple[ExpectedError, ...] = ()  # On targets.
    lasers: tuple[LaserRow, ...] = ()  # In the rig's order, which gives them their colours.
    series: tuple[Series, ...] = ()
    pictures: tuple[PictureShot, ...] = ()
    facts: tuple[tuple[str, str], ...] = ()  # Date, command, versions, files.


_DEG = 180.0 / math.pi
_NAMES = {
    **{f"lens_{axis}": (f"lens {axis}", "mm", 1e3, 3) for axis in "xyz"},
    **{f"rotation_{axis}": (f"camera rotation {axis}", "°", _DEG, 3) for axis in "xyz"},
    **{f"port_tilt_{axis}": (f"tilt of the port about {axis}", "°", _DEG, 3) for axis in "xy"},
    **{name: (name, "px", 1.0, 2) for name in ("fx", "fy", "cx", "cy")},
    "inner_radius": ("dome inner radius", "mm", 1e3, 3),
    "thickness": ("thickness of the housing", "mm", 1e3, 3),
    "port_distance": ("distance of the port", "mm", 1e3, 3),
    "n_port": ("index of the port", "", 1.0, 4),
    "n_air": ("index of the air inside", "", 1.0, 5),
    "n_acrylic": ("index of the dome", "", 1.0, 4),
    "n_water": ("index of the water", "", 1.0, 5),
}


def expectations(rig: Rig) -> tuple[ExpectedError, ...]:
    """Return what a rig's calibration means on a wall at the usual ranges; none without lasers."""
    return expected_posture_errors(rig, completed_uncertainty(rig)) if rig.lasers else ()


def parameter_rows(
    rig: Rig, uncertainty: RigUncertainty, names: Sequence[str], before: Rig | None = None
) -> tuple[ParameterRow, ...]:
    """Return the named numbers of a rig's camera, with sigma and what they were before."""
    values, sigmas = rig_numbers(rig), uncertainty.sigmas
    old = {} if before is None else rig_numbers(before)
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
            )
        )
    return tuple(rows)


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
