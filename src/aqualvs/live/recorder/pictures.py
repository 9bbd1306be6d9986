"""Pictures in a recording: JPEG, small; or PNG of the planes as they are, without loss."""

from enum import StrEnum
from typing import cast

import cv2
import numpy as np

from aqualvs.live.colour import bgr_of
from aqualvs.scanning.scan import Frame, ImagePlane, planes_of_image

# Noise leaves little to a search for what repeats: runs alone are smaller, and no slower.
_PNG = [
    *(cv2.IMWRITE_PNG_COMPRESSION, 1),
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE),
]


class PictureFormat(StrEnum):
    """How pictures are kept."""

    JPEG = "jpeg"
    PNG = "png"
    """Luma as one grey picture, U above V as another: bit for bit, and large."""


def jpeg_of(frame: Frame, quality: int) -> bytes:
    """Return a frame as JPEG, in colour where it has any.

    Parameters
    ----------
    frame : Frame
    quality : int
        1 to 100.
    """
    image = np.ascontiguousarray(frame.luma) if frame.chroma is None else bgr_of(frame)
    return _encoded(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])


def png_of(frame: Frame) -> tuple[bytes, bytes | None]:
    """Return luma and, where the frame has it, chroma as PNG."""
    luma = _encoded(".png", np.ascontiguousarray(frame.luma), _PNG)
    if frame.chroma is None:
        return luma, None
    return luma, _encoded(".png", np.concatenate(frame.chroma), _PNG)


def frame_of(index: int, time_s: float, kind: str, picture: bytes, chroma: bytes | None) -> Frame:
    """Return the frame that a recording's pictures show.

    Raises
    ------
    ValueError
        If they cannot be decoded.
    """
    image = _decoded(picture)
    if kind == PictureFormat.JPEG:
        return Frame(index, time_s, *planes_of_image(image))
    if chroma is None:
        return Frame(index, time_s, image)
    both = _decoded(chroma)
    rows = len(both) // 2
    return Frame(index, time_s, image, (both[:rows], both[rows:]))


def _encoded(suffix: str, image: ImagePlane, options: list[int]) -> bytes:
    _, found = cv2.imencode(suffix, image, options)
    return found.tobytes()


def _decoded(data: bytes) -> ImagePlane:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_ANYCOLOR)
    if image is None:
        raise ValueError("a picture that cannot be decoded")
    return cast(ImagePlane, image)
