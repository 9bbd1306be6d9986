"""Images as ROS and Foxglove messages carry them."""

from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from aqualvs.live.sources.quiet import quiet_decoders
from aqualvs.scanning.scan import ImagePlane, Planes, planes_of_image

VIDEO_CODECS = {"h264": "h264", "h265": "hevc", "hevc": "hevc", "av1": "av1", "vp9": "vp9"}
"""FFmpeg's names of the codecs of `CompressedVideo`."""

_GREY = frozenset({"mono8", "8uc1"})
_GREY_16 = frozenset({"mono16", "16uc1"})
_TO_BGR = {
    "bgr8": (3, None),
    "8uc3": (3, None),
    "rgb8": (3, cv2.COLOR_RGB2BGR),
    "bgra8": (4, cv2.COLOR_BGRA2BGR),
    "8uc4": (4, cv2.COLOR_BGRA2BGR),
    "rgba8": (4, cv2.COLOR_RGBA2BGR),
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2BGR),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2BGR),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2BGR),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2BGR),
}
"""Channels and OpenCV's conversion; OpenCV names Bayer patterns by their second row."""

_PACKED_422 = {"yuv422_yuy2": 0, "yuyv": 0, "yuv422": 1, "uyvy": 1}
"""Where luma begins among the bytes of two pixels; ROS's `yuv422` is UYVY."""

ENCODINGS = tuple(sorted({*_GREY, *_GREY_16, *_TO_BGR, *_PACKED_422}))


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageMessage:
    """One picture, or one packet of a video.

    Attributes
    ----------
    stamp_ns : int
        Time of the picture, nanoseconds; 0 if the message tells none.
    encoding : str
        Of the pixels where `size_px` is given, else of the file or video: "jpeg", "png", "h264".
    data : bytes
    size_px : (int, int) or None
        Width and height of a picture that is not compressed.
    step : int
        Bytes from row to row.
    is_big_endian : bool
        Byte order of pixels of 16 bits.
    """

    stamp_ns: int
    encoding: str
    data: bytes
    size_px: tuple[int, int] | None = None
    step: int = 0
    is_big_endian: bool = False

    @property
    def codec(self) -> str | None:
        """FFmpeg's name of the codec, if the message is a packet of a video."""
        return None if self.size_px else VIDEO_CODECS.get(self.encoding.lower())


def planes_of_message(message: ImageMessage) -> Planes | None:
    """Return luma and chroma of a picture, or None if it cannot be decoded.

    Parameters
    ----------
    message : ImageMessage
        Not of a video.

    Returns
    -------
    luma, chroma
        As `planes_of_image`; luma and chroma of a packed 4:2:2 picture keep their values.
    """
    if message.size_px is None:
        return _decompressed(message.data)
    name = message.encoding.lower()
    if name in _GREY:
        rows = _rows(message, 1)
        return None if rows is None else planes_of_image(rows[..., 0].copy())
    if name in _GREY_16:
        return _high_bytes(message)
    if name in _PACKED_422:
        return _packed(message, _PACKED_422[name])
    n_channels, conversion = _TO_BGR.get(name, (0, None))
    rows = _rows(message, n_channels) if n_channels else None
    if rows is None:
        return None
    image = np.ascontiguousarray(rows)
    if conversion is not None:
        image = cast("NDArray[np.uint8]", cv2.cvtColor(image, conversion))
    return planes_of_image(image)


def _decompressed(data: bytes) -> Planes | None:
    try:
        with quiet_decoders():
            pixels = np.frombuffer(data, np.uint8)
            image = cv2.imdecode(pixels, cv2.IMREAD_ANYCOLOR) if data else None
    except cv2.error:
        image = None
    return None if image is None else planes_of_image(cast("ImagePlane", image))


def _rows(message: ImageMessage, n_bytes: int) -> NDArray[np.uint8] | None:
    """Return the pixels as (height, width, n_bytes), or None if there are too few."""
    width, height = message.size_px or (0, 0)
    step = message.step or width * n_bytes
    # The last row may come without its padding.
    if width <= 0 or height <= 0 or step < width * n_bytes:
        return None
    if len(message.data) < step * (height - 1) + width * n_bytes:
        return None
    flat = np.frombuffer(message.data, np.uint8)
    return np.lib.stride_tricks.as_strided(
        flat, (height, width, n_bytes), (step, n_bytes, 1), writeable=False
    )


def _high_bytes(message: ImageMessage) -> Planes | None:
    rows = _rows(message, 2)
    if rows is None:
        return None
    return planes_of_image(rows[..., 0 if message.is_big_endian else 1].copy())


def _packed(message: ImageMessage, first: int) -> Planes | None:
    """Take 4:2:2 apart; chroma of two rows is averaged."""
    pixels = _rows(message, 2)
    if pixels is None or pixels.shape[0] % 2 or pixels.shape[1] % 2:
        return None
    luma = np.ascontiguousarray(pixels[..., first])
    both = pixels[..., 1 - first].astype(np.uint16)
    mean = ((both[0::2] + both[1::2] + 1) >> 1).astype(np.uint8)
    chroma = np.ascontiguousarray(mean[:, 0::2]), np.ascontiguousarray(mean[:, 1::2])
    for plane in (luma, *chroma):
        plane.flags.writeable = False
    return luma, chroma
