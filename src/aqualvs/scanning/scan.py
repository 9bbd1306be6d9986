"""Data types at the scanner's interface: frames in, stripe points and scans out."""

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from aqualvs.errors import FrameError
from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.optics.shutter import Field
from aqualvs.scanning.posture import Posture, Refusal

ImagePlane: TypeAlias = NDArray[np.uint8]
Planes: TypeAlias = tuple[ImagePlane, tuple[ImagePlane, ImagePlane] | None]

# Shapes after height and width: of grey images, of BGR, and of BGR with transparency.
_CHANNELS = ((), (3,), (4,))

# U and V by blue, green, red and 1 (BT.601, limited range).
_UV_OF_BGR = np.array([[0.4392, -0.2910, -0.1482, 128.0], [-0.0714, -0.3678, 0.4392, 128.0]])


@dataclass(frozen=True, slots=True)
class Frame:
    """One picture as decoders deliver it, or one field of it: full-size luma, half-size chroma.

    Attributes
    ----------
    index : int
        Number of the frame in its source, from 0.
    time_s : float
        Time since the start of the source, from the stream's own clock.
    luma : uint8 array, shape (height, width)
        Rows may be padded in memory (any strides with unit step along x).
    chroma : (uint8 array, uint8 array) or None
        U and V planes, shape (ceil(height/2), ceil(width/2)); None for a grey source.
    field : {"top", "bottom"} or None
        The field whose rows these are, every other one of the picture; None for a whole picture.
    is_interlaced : bool
        Whether the stream declares that a whole picture consists of two fields. Rows of chroma then
        alternate between the fields, as rows of luma do.
    """

    index: int
    time_s: float
    luma: ImagePlane
    chroma: tuple[ImagePlane, ImagePlane] | None = None
    field: Field | None = None
    is_interlaced: bool = False


def without_neutral_chroma(frame: Frame) -> Frame:
    """Return a frame without its chroma if that is neutral in the whole picture.

    Pictures of a monochrome camera are often coded as colour. The chroma of a colour camera differs
    from neutral by more than rounding, at least by noise.
    """
    neutral, rounding = 128, 1
    # Checking a few rows first is enough for nearly every colour camera.
    row_step = 16
    for rows in (slice(None, None, row_step), slice(None)):
        for plane in frame.chroma or ():
            some = plane[rows]
            if some.min() < neutral - rounding or some.max() > neutral + rounding:
                return frame
    return replace(frame, chroma=None)


def planes_of_image(image: ImagePlane) -> Planes:
    """Return luma and chroma of an image, grey or BGR, as OpenCV reads it.

    Parameters
    ----------
    image : uint8 array, shape (height, width) or (height, width, 3)

    Returns
    -------
    luma, chroma
        As in `Frame`; BT.601 limited range, as in videos. Chroma is the mean over four pixels:
        OpenCV's conversion takes that of one of them, which shifts it by half a pixel.

    Raises
    ------
    FrameError
        If the image has another type or shape.
    """
    shape, dtype = getattr(image, "shape", ()), getattr(image, "dtype", None)
    if dtype != np.uint8 or 0 in shape or len(shape) not in (2, 3) or shape[2:] not in _CHANNELS:
        given = type(image).__name__ if dtype is None else f"{dtype} of shape {shape}"
        raise FrameError(
            f"image: is {given} but expected uint8 of shape (height, width), or (height, width, 3) "
            "in blue, green, red; scale it to 0 to 255 and convert it"
        )
    if image.ndim == 2:
        return image, None
    height, width = image.shape[:2]
    padded = cv2.copyMakeBorder(image, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
    i420: ImagePlane = np.asarray(cv2.cvtColor(padded, cv2.COLOR_BGR2YUV_I420), np.uint8)
    half_size = (padded.shape[1] // 2, padded.shape[0] // 2)
    half = cv2.resize(padded, half_size, interpolation=cv2.INTER_AREA)
    u, v = (np.asarray(one, np.uint8) for one in cv2.split(cv2.transform(half, _UV_OF_BGR)))
    return i420[:height, :width], (u, v)


class Label(IntEnum):
    """Label of a stripe point; `points.parquet` holds the lower-case name."""

    NET = 0
    """On a surface with the stripe pattern of a net."""
    SOLID = 1
    """On a surface with unbroken stripes: the wall that is the target, a box before the net."""
    FISH = 2
    """On a smoothly bent stripe, as on the flank of a fish."""
    BUBBLE = 3
    """An isolated bright spot, about as long as it is wide."""
    BACKGROUND = 4
    """On a surface behind the target: the tank's wall behind the net."""
    CLUTTER = 5
    """On no surface, and of no distinctive shape: marine snow, glare, fragments."""
    AMBIGUOUS = 6
    """Clutter that several lasers could have made; listed once for each of them."""
    OUT_OF_RANGE = 7
    """On no surface, and outside the working range."""


@dataclass(frozen=True, slots=True)
class ScanPoints:
    """Triangulated stripe points of one frame, N of them, ordered by laser.

    Attributes
    ----------
    laser : int8 array, shape (N,)
        Index into `Rig.lasers`.
    pixels : array, shape (N, 2)
        Sub-pixel position on the stripe in `image`.
    points_in_dome : array, shape (N, 3)
        Metres.
    sigma : array, shape (N,)
        Standard deviation along the ray, in metres.
    intensity, width, quality : array, shape (N,)
        Peak height above background (grey levels), full width at half height across the search
        line (px), and quality between 0 and 1.
    label : uint8 array, shape (N,)
        `Label` values.
    used : bool array, shape (N,)
        Inliers of the posture. Other points on the target lie where stripes cross, are fragments
        of a strand, or lie off the plane.
    """

    laser: NDArray[np.int8]
    pixels: FloatArray
    points_in_dome: FloatArray
    sigma: FloatArray
    intensity: FloatArray
    width: FloatArray
    quality: FloatArray
    label: NDArray[np.uint8]
    used: BoolArray

    @classmethod
    def none(cls) -> "ScanPoints":
        """Return no points."""
        nothing = np.empty(0)
        return cls(
            laser=np.empty(0, np.int8),
            pixels=np.empty((0, 2)),
            points_in_dome=np.empty((0, 3)),
            sigma=nothing,
            intensity=nothing,
            width=nothing,
            quality=nothing,
            label=np.empty(0, np.uint8),
            used=np.empty(0, np.bool_),
        )

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.laser)


@dataclass(frozen=True, slots=True)
class GyroRates:
    """Angular velocity of the vehicle at the middle of a picture's exposure, from its gyros."""

    rates: FloatArray  # Shape (3,): angular velocity about the axes of `dome`, in rad/s.
    # Standard deviation of each in rad/s, as rotation relative to a target at rest.
    sigma: float


@dataclass(frozen=True, slots=True)
class Scan:
    """The scanner's result for one frame.

    Attributes
    ----------
    index, time_s
        As in the `Frame`.
    posture : Posture or Refusal
        A refusal is falsy and has a reason.
    points : ScanPoints
        Every stripe point, labelled.
    n_water : float
        Refractive index used.
    turning : GyroRates or None
        None without gyros.
    """

    index: int
    time_s: float
    posture: Posture | Refusal
    points: ScanPoints
    n_water: float
    turning: GyroRates | None = None
