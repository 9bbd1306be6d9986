"""Frames as colour pictures, for overlays and people."""

from typing import cast

import cv2
import numpy as np

from aqualvs.scanning.scan import Frame, ImagePlane


def bgr_of(frame: Frame) -> ImagePlane:
    """Return a frame as a BGR picture.

    Parameters
    ----------
    frame : Frame

    Returns
    -------
    image : uint8 array, shape (height, width, 3)
        A new array; grey where the frame has no chroma.
    """
    if frame.chroma is None:
        return cast(ImagePlane, cv2.cvtColor(frame.luma, cv2.COLOR_GRAY2BGR))
    height, width = frame.luma.shape
    rows, columns = frame.chroma[0].shape
    i420 = np.empty((3 * rows, 2 * columns), np.uint8)
    # An odd height or width leaves a row or column of the even picture to be cut off again.
    i420[: 2 * rows] = 0
    i420[:height, :width] = frame.luma
    i420[2 * rows :] = np.stack(frame.chroma).reshape(rows, 2 * columns)
    image = cv2.cvtColor(i420, cv2.COLOR_YUV2BGR_I420)
    return np.ascontiguousarray(image[:height, :width], dtype=np.uint8)
