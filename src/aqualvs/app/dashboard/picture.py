"""The camera's picture for the page: small, and cheap to make."""

import cv2
import numpy as np

from aqualvs.scanning.scan import Frame, ImagePlane

_MAX_WIDTH, _QUALITY = 960, 70


def page_picture(frame: Frame) -> bytes:
    """Return the frame as a JPEG of at most 960 px width."""
    height, width = frame.luma.shape
    scale = min(1.0, _MAX_WIDTH / width)
    # Even numbers: the colour planes have half the size.
    size = (2 * round(scale * width / 2), 2 * round(scale * height / 2))
    luma = _resized(frame.luma, size)
    if frame.chroma is None:
        image = luma
    else:
        half = (size[0] // 2, size[1] // 2)
        planes = [luma.ravel(), *(_resized(plane, half).ravel() for plane in frame.chroma)]
        stacked = np.concatenate(planes).reshape(size[1] * 3 // 2, size[0])
        image = np.asarray(cv2.cvtColor(stacked, cv2.COLOR_YUV2BGR_I420), np.uint8)
    done, code = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not done:
        raise RuntimeError("the picture could not be encoded")
    return bytes(code)


def _resized(plane: ImagePlane, size: tuple[int, int]) -> ImagePlane:
    if (plane.shape[1], plane.shape[0]) == size:
        return np.ascontiguousarray(plane)
    return np.asarray(cv2.resize(plane, size, interpolation=cv2.INTER_AREA), np.uint8)
