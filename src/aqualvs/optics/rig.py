"""The rig: one camera, its housing, the water and the lasers, in SI units."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.camera import BareCamera, Camera, Dome, DomeCamera
from aqualvs.optics.lens import Lens

DOME_FROM_CAM_NOMINAL: FloatArray = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotation of a camera mounted without error; columns are x, y and z of `cam` in `dome`.

The camera looks along the dome's y axis: x_cam -> +x, y_cam -> -z, z_cam -> +y.
"""
DOME_FROM_CAM_NOMINAL.flags.writeable = False


@dataclass(frozen=True, slots=True)
class Window:
    """A flat window that a laser's light leaves its housing by.

    Attributes
    ----------
    face : Plane
        The outer face in `dome`; the normal may point either way. The pane counts as thin; a thick
        one shifts the light as a source would that is nearer to the outer face by a third of the
        pane (glass of index 1.5), to 0.12 mm for 6 mm tilted by 25 degrees.
    source : array, shape (3,)
        Point in `dome` that the light fans out from, in metres. It lies in the laser's plane; what
        it is off is projected away.
    """

    face: Plane
    source: FloatArray


@dataclass(frozen=True, slots=True)
class Laser:
    """A line laser, a thin sheet of light.

    Attributes
    ----------
    name : str
        How reports call it.
    plane : Plane
        The sheet in `dome`: in the water, or, behind a window, in the air of the laser's housing.
    window : Window or None
        What bends the sheet; `aqualvs.optics.sheet` says where the light is then. None where the
        sheet in the water is the plane.
    wavelength_nm : float or None
        Of the light, in nanometres; None where nobody has said: green, 520 to 532.
    """

    name: str
    plane: Plane
    window: Window | None = None
    wavelength_nm: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Rig:
    """Everything that turns a pixel on a stripe into a point.

    Attributes
    ----------
    name : str
        How reports call it.
    size_px : (int, int)
        Image width and height.
    lens : Lens
        Intrinsics, calibrated in air without the dome.
    dome_from_cam : SE3
        Camera pose in `dome`; the translation is the lens position L.
    dome : Dome or None
        None for a bare lens in the outer medium.
    n_air, n_water : float
        Refractive indices (vacuum = 1) inside and outside the dome.
    lasers : tuple of Laser
        In the order in which `points.parquet` numbers them.
    working_range : (float, float)
        Nearest and farthest target range at which stripes are believed, in metres.
    solved_from : mapping
        What a calibration solved the rig from; kept and written back, never interpreted here.
    """

    name: str
    size_px: tuple[int, int]
    lens: Lens
    dome_from_cam: SE3
    dome: Dome | None
    n_air: float
    n_water: float
    lasers: tuple[Laser, ...]
    working_range: tuple[float, float]
    solved_from: Mapping[str, Any] = field(default_factory=dict)

    def camera(self) -> Camera:
        """Return the camera as it looks into the outer medium."""
        if self.dome is None:
            return self.bare_camera()
        return DomeCamera(
            size_px=self.size_px,
            lens=self.lens,
            dome_from_cam=self.dome_from_cam,
            dome=self.dome,
            n_air=self.n_air,
            n_water=self.n_water,
        )

    def bare_camera(self) -> BareCamera:
        """Return the same camera without the dome: what ignoring refraction means."""
        return BareCamera(size_px=self.size_px, lens=self.lens, dome_from_cam=self.dome_from_cam)

    @property
    def focal_px(self) -> float:
        """Pixels per radian near the image centre, in air: a scale for lengths in the image."""
        return max(self.lens.fx, self.lens.fy)

    def in_water(self, n_water: float) -> "Rig":
        """Return the same rig in a medium of another index."""
        return replace(self, n_water=n_water)
