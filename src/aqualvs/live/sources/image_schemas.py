"""From the messages of ROS and Foxglove to images."""

import base64
import json
from collections.abc import Callable
from typing import Any

from aqualvs.live.sources.image_messages import ImageMessage

_KINDS = {
    "sensor_msgs/Image": "Image",
    "sensor_msgs/CompressedImage": "CompressedImage",
    "foxglove.RawImage": "RawImage",
    "foxglove.CompressedImage": "CompressedImage",
    "foxglove.CompressedVideo": "CompressedImage",
    "foxglove_msgs/RawImage": "RawImage",
    "foxglove_msgs/CompressedImage": "CompressedImage",
    "foxglove_msgs/CompressedVideo": "CompressedImage",
}
"""Foxglove's compressed video and its compressed image have the same fields."""

_TIME, _FORMAT = 1, {"foxglove.CompressedImage": 3, "foxglove.CompressedVideo": 4}
_DATA = {"foxglove.CompressedImage": 2, "foxglove.CompressedVideo": 3}
"""Field numbers in Foxglove's Protobuf schemas."""


def kind_of_schema(name: str) -> str | None:
    """Return what kind of image a schema holds, or None.

    Parameters
    ----------
    name : str
        `sensor_msgs/msg/Image`, `foxglove.CompressedVideo` and the like.

    Returns
    -------
    kind : str or None
        "Image", "RawImage" or "CompressedImage".
    """
    return _KINDS.get(name.replace("/msg/", "/"))


def image_of_ros(message: Any) -> ImageMessage:
    """Return the image in a decoded ROS message of any kind known here.

    Parameters
    ----------
    message : object
        With the fields of `sensor_msgs` or `foxglove_msgs` as attributes.
    """
    stamp = message.header.stamp if hasattr(message, "header") else message.timestamp
    stamp_ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
    data = bytes(message.data)
    if hasattr(message, "format"):
        return ImageMessage(stamp_ns=stamp_ns, encoding=_still(message.format), data=data)
    return ImageMessage(
        stamp_ns=stamp_ns,
        encoding=str(message.encoding),
        data=data,
        size_px=(int(message.width), int(message.height)),
        step=int(message.step),
        is_big_endian=bool(getattr(message, "is_bigendian", False)),
    )


def image_of_json(content: bytes) -> ImageMessage:
    """Return the image in a Foxglove message written as JSON.

    Parameters
    ----------
    content : bytes

    Raises
    ------
    ValueError
        If fields are missing or wrong.
    """
    try:
        found = json.loads(content)
    except RecursionError as fault:
        raise ValueError("nested too deeply") from fault
    try:
        stamp = found["timestamp"]
        stamp_ns = int(stamp["sec"]) * 1_000_000_000 + int(stamp.get("nsec", 0))
        data = base64.b64decode(found["data"])
        if "format" in found:
            return ImageMessage(stamp_ns=stamp_ns, encoding=_still(found["format"]), data=data)
        return ImageMessage(
            stamp_ns=stamp_ns,
            encoding=found["encoding"],
            data=data,
            size_px=(int(found["width"]), int(found["height"])),
            step=int(found.get("step", 0)),
        )
    except (KeyError, TypeError, AttributeError) as fault:
        raise ValueError(f"no image: {fault}") from fault


def image_of_protobuf(schema: str) -> Callable[[bytes], ImageMessage]:
    """Return what reads a Foxglove message written as Protobuf.

    Parameters
    ----------
    schema : str
        `foxglove.RawImage`, `foxglove.CompressedImage` or `foxglove.CompressedVideo`.
    """

    def read(content: bytes) -> ImageMessage:
        fields = protobuf_fields(content)
        stamp_ns = _protobuf_time(_bytes(fields.get(_TIME, b"")))
        if schema == "foxglove.RawImage":
            return ImageMessage(
                stamp_ns=stamp_ns,
                encoding=_bytes(fields.get(4, b"")).decode("utf-8", "replace"),
                data=_bytes(fields.get(6, b"")),
                size_px=(_int(fields.get(2, 0)), _int(fields.get(3, 0))),
                step=_int(fields.get(5, 0)),
            )
        encoding = _bytes(fields.get(_FORMAT[schema], b"")).decode("utf-8", "replace")
        data = _bytes(fields.get(_DATA[schema], b""))
        return ImageMessage(stamp_ns=stamp_ns, encoding=_still(encoding), data=data)

    return read


def protobuf_fields(content: bytes) -> dict[int, int | bytes]:
    """Return the last value of each field of a Protobuf message, by its number.

    Parameters
    ----------
    content : bytes

    Raises
    ------
    ValueError
        If the message is cut short or uses groups.
    """
    fields: dict[int, int | bytes] = {}
    at = 0
    while at < len(content):
        key, at = _varint(content, at)
        wire = key & 7
        if wire == 0:
            fields[key >> 3], at = _varint(content, at)
            continue
        if wire == 2:
            size, at = _varint(content, at)
        elif wire in (1, 5):
            size = 8 if wire == 1 else 4
        else:
            raise ValueError(f"wire type {wire}")
        piece = content[at : at + size]
        if len(piece) < size:
            raise ValueError("cut short")
        fields[key >> 3] = piece if wire == 2 else int.from_bytes(piece, "little")
        at += size
    return fields


def _varint(content: bytes, at: int) -> tuple[int, int]:
    value = 0
    for i in range(10):
        if at + i >= len(content):
            break
        byte = content[at + i]
        value |= (byte & 0x7F) << (7 * i)
        if byte < 0x80:
            return value, at + i + 1
    raise ValueError("cut short")


def _protobuf_time(content: bytes) -> int:
    fields = protobuf_fields(content)
    return _int(fields.get(1, 0)) * 1_000_000_000 + _int(fields.get(2, 0))


def _int(value: int | bytes) -> int:
    return value if isinstance(value, int) else 0


def _bytes(value: int | bytes) -> bytes:
    return value if isinstance(value, bytes) else b""


def _still(text: str) -> str:
    """Return the file format of a compressed image: ROS writes `bgr8; jpeg compressed bgr8`."""
    words = text.replace(";", " ").split()
    return next((w for w in words if w in ("jpeg", "jpg", "png", "tiff")), text.strip())
