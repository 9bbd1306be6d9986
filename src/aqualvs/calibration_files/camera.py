"""Cameras of other programs, their conversion to rigs, and strict access to values of their files.

`Entries` reads keys and values; its errors name the place in the file.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from aqualvs.errors import AqualvsError, RigError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.dome import Dome
from aqualvs.optics.flat_port import FlatPort
from aqualvs.optics.lens import Lens, LensModel
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL, Rig
from aqualvs.optics.rigfile import rig_from_mapping, rig_to_mapping
from aqualvs.optics.water import N_AIR
from aqualvs.schema import shown


@dataclass(frozen=True, slots=True)
class ForeignHousing:
    """Housing in the frame of the camera, with the media inside and outside."""

    housing: Dome | FlatPort
    # Refractive indices inside and outside.
    n_air: float
    n_water: float
    # Shape (3,): centre of the dome in `cam`, in metres; zero for a flat port, whose distance is
    # measured from the lens.
    centre: FloatArray = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, slots=True, kw_only=True)
class ForeignCamera:
    """Camera from the file of another program."""

    name: str
    size_px: tuple[int, int] | None  # Image width and height; None if the file does not state it.
    lens: Lens  # The centre of the top-left pixel is (0, 0).
    port: ForeignHousing | None = None  # None for a camera without a housing.


def opencv_lens(core: Sequence[float], distortion: Sequence[float], *, fisheye: bool) -> Lens:
    """Return the lens with OpenCV's coefficients.

    Parameters
    ----------
    core : sequence of float
        fx, fy, cx, cy.
    distortion : sequence of float
        In OpenCV's order. Zeros beyond k6, of a thin prism or a tilt, are dropped.
    fisheye : bool
        Whether they are those of `cv2.fisheye`.

    Raises
    ------
    RigError
        If there are coefficients that the lens model lacks, or a value is impossible.
    """
    values = tuple(map(float, distortion))
    n_opencv = 8
    if not fisheye and len(values) in (12, 14):
        if any(values[n_opencv:]):
            raise RigError(
                "has thin prism or tilt coefficients (s1 to s4, tx, ty), which the lens of aqualvs "
                "lacks; calibrate with k1 k2 p1 p2 k3 k4 k5 k6 at most"
            )
        values = values[:n_opencv]
    fx, fy, cx, cy = core
    model = LensModel.FISHEYE if fisheye else LensModel.OPENCV
    return Lens(model=model, fx=fx, fy=fy, cx=cx, cy=cy, distortion=values)


def padded(lens: Lens, n: int) -> tuple[float, ...]:
    """Return the first n distortion coefficients of a lens, padded with zeros.

    Raises `RigError` if a further one is not zero.
    """
    values = (*lens.distortion, *(0.0,) * n)
    if any(values[n:]):
        names = ", ".join(lens.parameter_names[4 + n :])
        raise RigError(f"the lens has {names}, which this format lacks; choose another format")
    return values[:n]


def rig_of_camera(
    camera: ForeignCamera, source: str, *, solved_from: dict[str, Any] | None = None
) -> Rig:
    """Return the rig of a camera, without lasers: behind its housing, or bare in air.

    The camera looks along the dome's y axis: other programs have no frame of the vehicle.

    Parameters
    ----------
    camera : ForeignCamera
        Camera with the size of its pictures.
    source : str
        Name of the file in messages.
    solved_from : dict, optional
        As `Rig.solved_from`.

    Raises
    ------
    RigError
        If the size is missing, or values do not fulfil the conditions on rig files.
    """
    if camera.size_px is None:
        raise RigError(
            f"{source}: does not say the size of the pictures; add --image, such as "
            "--image 1920x1080"
        )
    port, rotation = camera.port, DOME_FROM_CAM_NOMINAL
    lens_in_dome = np.zeros(3) if port is None else -(rotation @ port.centre) + 0.0
    # As of a nominal rig.
    working_range_m = (0.25, 1.3)
    rig = Rig(
        name=camera.name,
        size_px=camera.size_px,
        lens=camera.lens,
        dome_from_cam=SE3(rotation.copy(), lens_in_dome),
        housing=None if port is None else port.housing,
        n_air=N_AIR if port is None else port.n_air,
        n_water=N_AIR if port is None else port.n_water,
        lasers=(),
        working_range=working_range_m,
        solved_from=solved_from or {},
    )
    try:
        # Apply the conditions on rig files.
        return rig_from_mapping(rig_to_mapping(rig), source_name=source, need_lasers=False)
    except AqualvsError:
        raise
    except (ArithmeticError, ValueError):
        raise RigError(f"{source}: its numbers do not describe a camera; correct them") from None


def camera_of_rig(rig: Rig) -> ForeignCamera:
    """Return the camera of a rig, with its housing in the frame of the camera."""
    port = None
    if rig.housing is not None:
        port = ForeignHousing(rig.housing, rig.n_air, rig.n_water)
    if port is not None and rig.dome is not None:
        pose = rig.dome_from_cam
        port = replace(port, centre=-(pose.rotation.T @ pose.translation) + 0.0)
    return ForeignCamera(name=rig.name, size_px=rig.size_px, lens=rig.lens, port=port)


# C++ programs write numbers such as 1e-05, which YAML 1.1 reads as text; XML has text only.
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


@dataclass(frozen=True, slots=True)
class Entries:
    """Mapping in a file, with access to checked values."""

    content: Mapping[Any, Any]
    place: str = ""  # Prefix of keys in messages, such as "cam0."; empty at the top.

    @classmethod
    def top(cls, content: object) -> "Entries":
        """Return the top-level mapping of a file.

        Raises `RigError` if the content is no mapping.
        """
        if not isinstance(content, Mapping):
            raise RigError("holds no keys and values; give the whole file")
        return cls(content)

    def first(self, keys: Sequence[str]) -> str:
        """Return the first of some keys that has a value.

        Raises `RigError` if none has.
        """
        for key in keys:
            if self.content.get(key) is not None:
                return key
        raise RigError(f"{self.place}{keys[0]} is missing; add it")

    def has(self, *keys: str) -> bool:
        """Return whether any of some keys has a value."""
        return any(self.content.get(key) is not None for key in keys)

    def part(self, key: str) -> "Entries":
        """Return the mapping at a key.

        Raises `RigError` if there is no mapping.
        """
        value = self.content.get(key)
        if not isinstance(value, Mapping):
            raise RigError(f"{self.place}{key} is {shown(value)}; write keys and values")
        return Entries(value, f"{self.place}{key}.")

    def word(self, *keys: str) -> str:
        """Return the text at the first key with a value."""
        key = self.first(keys)
        value = self.content[key]
        if not isinstance(value, str):
            raise RigError(f"{self.place}{key} is {shown(value)}; write a word")
        return value.strip()

    def name(self, key: str, default: str) -> str:
        """Return the name at a key, which may be a serial number; the default if there is none."""
        value = self.content.get(key)
        named = isinstance(value, str | int) and not isinstance(value, bool)
        return (str(value).strip() if named else "") or default

    def number(self, *keys: str) -> float:
        """Return the number at the first key with a value."""
        key = self.first(keys)
        return number(self.content[key], self.place + key)

    def whole(self, *keys: str) -> int:
        """Return the whole number at the first key with a value."""
        key = self.first(keys)
        return whole(self.number(key), self.place + key)

    def numbers(self, *keys: str) -> list[float]:
        """Return the numbers of a list, matrix or vector at the first key with a value.

        Raises `RigError` for anything else, or if the number of values is not that of `rows` times
        `cols`.
        """
        key = self.first(keys)
        value, place = self.content[key], self.place + key
        n_stated = None
        if isinstance(value, Mapping):
            matrix = Entries(value, f"{place}.")
            if matrix.has("rows", "cols"):
                n_stated = matrix.whole("rows") * matrix.whole("cols")
            value, place = value.get("data"), f"{place}.data"
        if isinstance(value, str):
            value = value.split()
        if not isinstance(value, list | tuple):
            raise RigError(f"{place} is {shown(value)}; write a list of numbers")
        flat: list[Any] = []
        for one in value:
            flat += one if isinstance(one, list | tuple) else [one]
        if n_stated not in (None, len(flat)):
            raise RigError(f"{place} has {len(flat)} values, but rows times cols is {n_stated}")
        return [number(one, f"{place}[{i}]") for i, one in enumerate(flat)]

    def listed(self, n: int, *keys: str) -> list[float]:
        """Return the numbers at the first key with a value, which must be n.

        Raises `RigError` for anything else.
        """
        values = self.numbers(*keys)
        if len(values) != n:
            key = self.place + self.first(keys)
            raise RigError(f"{key} has {len(values)} values; write {n}")
        return values

    def size(self, *keys: str) -> tuple[int, int]:
        """Return the width and height in a list at the first key with a value."""
        key = self.place + self.first(keys)
        width, height = self.listed(2, *keys)
        return whole(width, key), whole(height, key)

    def core(self, *keys: str) -> tuple[float, float, float, float]:
        """Return fx, fy, cx, cy of the camera matrix at the first key with a value.

        Raises `RigError` if it is no camera matrix, or has a skew.
        """
        key = self.place + self.first(keys)
        fx, skew, cx, zero, fy, cy, *last = self.listed(9, *keys)
        if skew != 0.0:
            raise RigError(f"{key} has a skew of {skew:g}, which the lens of aqualvs lacks")
        if (zero, *last) != (0.0, 0.0, 0.0, 1.0):
            raise RigError(f"{key} is not a camera matrix; write [fx, 0, cx, 0, fy, cy, 0, 0, 1]")
        return fx, fy, cx, cy


def number(value: object, place: str) -> float:
    """Return a value as a finite number.

    Raises `RigError` for any other value.
    """
    # A longer text is no number.
    max_length = 40
    if isinstance(value, str) and len(value) < max_length and _NUMBER.fullmatch(value.strip()):
        value = float(value)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise RigError(f"{place} is {shown(value)}; write a finite number")
    return float(value)


def whole(value: float, place: str) -> int:
    """Return a number as an integer.

    Raises `RigError` if it is not a whole number between 0 and 1e9, beyond any size of a picture.
    """
    largest = 1e9
    if value != math.floor(value) or not 0 <= value <= largest:
        raise RigError(f"{place} is {value:g}; write a whole number of 0 or more")
    return int(value)
