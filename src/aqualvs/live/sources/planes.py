"""Luma and chroma of a decoded picture, without copying where its layout allows."""

import numpy as np
from av.video.frame import VideoFrame
from av.video.plane import VideoPlane
from av.video.reformatter import ColorRange

from aqualvs.scanning.scan import ImagePlane, Planes

_PLANAR = frozenset({"yuv420p", "yuvj420p"})
_SEMI_PLANAR = frozenset({"nv12"})
_GREY = frozenset({"gray"})
_FULL_RANGE = int(ColorRange.JPEG)


def planes_of(picture: VideoFrame) -> Planes:
    """Return luma and chroma of a decoded picture.

    Parameters
    ----------
    picture : VideoFrame
        Any pixel format; 4:2:0 with 8 bits and 8-bit grey are viewed in place, others converted.

    Returns
    -------
    luma : uint8 array, shape (height, width)
    chroma : (uint8 array, uint8 array) or None
        U and V, shape (ceil(height/2), ceil(width/2)); None for a grey picture.

    Notes
    -----
    The arrays keep the decoder's buffer alive. They are read-only, because the decoder still
    predicts later pictures from it.
    """
    kind = picture.format.name
    if kind in _PLANAR:
        y, u, v = picture.planes
        return _view(y), (_view(u), _view(v))
    if kind in _SEMI_PLANAR:
        y, uv = picture.planes
        return _view(y), (_view(uv, first=0, step=2), _view(uv, first=1, step=2))
    if kind in _GREY:
        return _view(picture.planes[0]), None
    return planes_of(_as_420(picture))


def _view(plane: VideoPlane, *, first: int = 0, step: int = 1) -> ImagePlane:
    """Return a read-only view on every `step`-th byte of a plane's rows."""
    strides = (plane.line_size, step)
    shape = (plane.height, plane.width)
    view: ImagePlane = np.ndarray(shape, np.uint8, memoryview(plane), first, strides)
    return _read_only(view)


def _read_only(array: ImagePlane) -> ImagePlane:
    array.flags.writeable = False
    return array


def _as_420(picture: VideoFrame) -> VideoFrame:
    """Convert to 8-bit 4:2:0 in the same range, so that luma keeps its values."""
    full = picture.format.name.startswith("yuvj") or picture.color_range == _FULL_RANGE
    return picture.reformat(format="yuvj420p" if full else "yuv420p")
