"""Image messages of ROS and Foxglove: their decoding, and the frames of a recording.

Messages may be ROS messages, Foxglove messages in JSON or Foxglove messages in Protobuf; each
becomes an `ImageMessage`, and `planes_of_message` decodes it to luma and chroma. A `MessageSource`
has the frames of one topic.
"""

import base64
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeAlias, cast

import av
import cv2
import numpy as np
from av.video.codeccontext import VideoCodecContext
from numpy.typing import NDArray

from aqualvs.closing import Closing
from aqualvs.errors import OptionError, SourceError
from aqualvs.scanning.scan import Frame, ImagePlane, Planes, planes_of_image
from aqualvs.sources.base import frame_of, packet_with
from aqualvs.sources.images import quiet_decoders
from aqualvs.sources.live_frames import LiveDecoder

VIDEO_CODECS = {"h264": "h264", "h265": "hevc", "hevc": "hevc", "av1": "av1", "vp9": "vp9"}
"""FFmpeg's names of the codecs of `CompressedVideo`."""

_GREY = {"mono8": 1, "8uc1": 1, "mono16": 2, "16uc1": 2}
"""Bytes of a grey pixel."""

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
"""Position of luma among the bytes of two pixels; ROS's `yuv422` is UYVY."""

_FORMATS = {
    **_TO_BGR,
    **{name: (n_bytes, None) for name, n_bytes in _GREY.items()},
    **dict.fromkeys(_PACKED_422, (2, None)),
}
ENCODINGS = tuple(sorted(_FORMATS))


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageMessage:
    """One picture, or one packet of a video."""

    stamp_ns: int  # Time of the picture, nanoseconds; 0 if the message has none.
    # Of the pixels where `size_px` is given, else of the file or video: "jpeg", "png", "h264".
    encoding: str

    data: bytes
    size_px: tuple[int, int] | None = None  # Width and height of a picture that is not compressed.
    step: int = 0  # Bytes from row to row.
    is_big_endian: bool = False  # Byte order of pixels of 16 bits.

    @property
    def codec(self) -> str | None:
        """FFmpeg's name of the codec, if the message is a packet of a video."""
        return None if self.size_px else VIDEO_CODECS.get(self.encoding.lower())


def planes_of_message(message: ImageMessage) -> Planes | None:
    """Return luma and chroma of a picture, not of a video, or None if it cannot be decoded.

    They are as from `planes_of_image`; those of a packed 4:2:2 picture keep their values.
    """
    if message.size_px is None:
        return _decompressed(message.data)
    name = message.encoding.lower()
    n_bytes, conversion = _FORMATS.get(name, (0, None))
    rows = _rows(message, n_bytes) if n_bytes else None
    if rows is None:
        return None
    if name in _PACKED_422:
        return _unpacked(rows, _PACKED_422[name])
    if name in _GREY:
        # Of 16 bits, the high ones.
        at = int(n_bytes == 2 and not message.is_big_endian)
        return planes_of_image(rows[..., at].copy())
    image = np.ascontiguousarray(rows)
    if conversion is not None:
        image = cast("NDArray[np.uint8]", cv2.cvtColor(image, conversion))
    return planes_of_image(image)


def _decompressed(data: bytes) -> Planes | None:
    try:
        with quiet_decoders():
            pixels = np.frombuffer(data, np.uint8)
            flags = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
            image = cv2.imdecode(pixels, flags) if data else None
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


def _unpacked(pixels: NDArray[np.uint8], first: int) -> Planes | None:
    """Take 4:2:2 apart; chroma of two rows is averaged."""
    if pixels.shape[0] % 2 or pixels.shape[1] % 2:
        return None
    luma = np.ascontiguousarray(pixels[..., first])
    both = pixels[..., 1 - first].astype(np.uint16)
    mean = ((both[0::2] + both[1::2] + 1) >> 1).astype(np.uint8)
    chroma = np.ascontiguousarray(mean[:, 0::2]), np.ascontiguousarray(mean[:, 1::2])
    for plane in (luma, *chroma):
        plane.flags.writeable = False
    return luma, chroma


_SCHEMAS = frozenset(
    {"sensor_msgs/Image", "sensor_msgs/CompressedImage"}.union(
        f"{package}{kind}"
        for package in ("foxglove.", "foxglove_msgs/")
        for kind in ("RawImage", "CompressedImage", "CompressedVideo")
    )
)
# Field numbers in Foxglove's Protobuf schemas: of the encoding or format, and of the data.
_PROTOBUF_FIELDS = {
    "foxglove.RawImage": (4, 6),
    "foxglove.CompressedImage": (3, 2),
    "foxglove.CompressedVideo": (4, 3),
}


def holds_images(schema: str) -> bool:
    """Return whether messages of a schema, such as `sensor_msgs/msg/Image`, are read here."""
    return schema.replace("/msg/", "/") in _SCHEMAS


def image_of_ros(message: Any) -> ImageMessage:
    """Return the image in a decoded ROS message of any kind known here.

    `message`: with the fields of `sensor_msgs` or `foxglove_msgs` as attributes.
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

    Raises `ValueError` if fields are missing or wrong.
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
    """Return the function that decodes a Foxglove message written as Protobuf.

    `schema`: `foxglove.RawImage`, `foxglove.CompressedImage` or `foxglove.CompressedVideo`.
    """

    def read(content: bytes) -> ImageMessage:
        fields = protobuf_fields(content)
        stamp = protobuf_fields(_bytes(fields, 1))
        encoding_at, data_at = _PROTOBUF_FIELDS[schema]
        encoding = _bytes(fields, encoding_at).decode("utf-8", "replace")
        is_raw = schema == "foxglove.RawImage"
        return ImageMessage(
            stamp_ns=_int(stamp, 1) * 1_000_000_000 + _int(stamp, 2),
            encoding=encoding if is_raw else _still(encoding),
            data=_bytes(fields, data_at),
            size_px=(_int(fields, 2), _int(fields, 3)) if is_raw else None,
            step=_int(fields, 5) if is_raw else 0,
        )

    return read


def protobuf_fields(content: bytes) -> dict[int, int | bytes]:
    """Return the last value of each field of a Protobuf message, by its number.

    Raises `ValueError` if the message is cut short or uses groups.
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


def _int(fields: dict[int, int | bytes], number: int) -> int:
    value = fields.get(number)
    return value if isinstance(value, int) else 0


def _bytes(fields: dict[int, int | bytes], number: int) -> bytes:
    value = fields.get(number)
    return value if isinstance(value, bytes) else b""


def _still(text: str) -> str:
    """Return the file format of a compressed image: ROS writes `bgr8; jpeg compressed bgr8`."""
    words = text.replace(";", " ").split()
    return next((w for w in words if w in ("jpeg", "jpg", "png", "tiff")), text.strip())


MAX_BYTES = 1 << 27
"""Size of a chunk or message when unpacked; an RGB picture of 40 megapixels takes 120 MB."""

_MAX_UNREADABLE = 20_000
"""Messages in a row without a picture after which a recording is given up: 13 minutes at 25 Hz."""

Logged: TypeAlias = tuple[int, ImageMessage | None]
"""Time of the log in nanoseconds, and the image; None for a message that cannot be read."""


class ImageTopic(NamedTuple):
    """A topic with images."""

    name: str
    n_messages: int | None  # None where the recording does not state it.


def choose_topic(where: str, topics: list[ImageTopic], wanted: str | None) -> ImageTopic:
    """Return the topic wanted, or the only one that is not known to be empty.

    `where`: for messages. Raises `SourceError` if there are no images at all. Raises `OptionError`
    if several topics have images and none is named, or the one named has none.
    """
    if wanted is None:
        topics = [topic for topic in topics if topic.n_messages != 0]
    listed = ", ".join(sorted(topic.name for topic in topics))
    if not topics:
        raise SourceError(f"{where}: holds no images; record a camera's topic too")
    if wanted is None and len(topics) > 1:
        raise OptionError(
            f"{where}: images on several topics ({listed}); "
            f"name one, as in {where}#{topics[0].name}"
        )
    for topic in topics:
        if wanted is None or topic.name.strip("/") == wanted.strip("/"):
            return topic
    raise OptionError(f"{where}: no images on topic {wanted}; there is {listed}")


class MessageSource(Closing):
    """Source of the images of one topic; satisfies `FrameSource`.

    `name`: path and topic. `messages`: begins to read, from the first message on; ends early where
    the recording is cut short, by raising `SourceError`. `n_frames`: messages that the recording
    promises. Raises `SourceError` if no picture can be decoded at the start, or its encoding is
    unknown.

    Times are those of the pictures where the messages have them, else those of the log. Pictures of
    a video that are predicted from a lost one are not delivered (see `LiveDecoder`).
    """

    def __init__(
        self, name: str, messages: Callable[[], Iterator[Logged]], n_frames: int | None
    ) -> None:
        self.name = name
        self.n_frames = n_frames
        self._messages = messages
        self.size_px, self.fps = self._survey()

    def __iter__(self) -> Iterator[Frame]:
        """Yield the readable images; others leave a gap in the index.

        Raises `SourceError` when the size changes, and at the end if the recording is cut short or
        its last images cannot be decoded.
        """
        last = -1
        for frame in self._frames():
            height, width = frame.luma.shape
            if (width, height) != self.size_px:
                raise SourceError(
                    f"{self.name}: the picture size changes from {self.size_px[0]}x"
                    f"{self.size_px[1]} to {width}x{height} px at frame {frame.index}; "
                    "cut the recording there"
                )
            last = frame.index
            yield frame
        if self.n_frames is not None and last + 1 < self.n_frames:
            raise SourceError(
                f"{self.name}: the last {self.n_frames - last - 1} of {self.n_frames} images "
                "cannot be decoded; the recording is damaged"
            )

    def _survey(self) -> tuple[tuple[int, int], float | None]:
        """Return the size of the first picture, and the rate of the first ones."""
        size, times = None, []
        try:
            for frame in self._frames():
                size = size or (frame.luma.shape[1], frame.luma.shape[0])
                times.append((frame.index, frame.time_s))
                if len(times) == 10:
                    break
        except SourceError:
            # Messages before the damage count; the damage is reported when it is reached again.
            if size is None:
                raise
        if size is None:
            raise SourceError(f"{self.name}: no image can be decoded")
        (first, began), (last, ended) = times[0], times[-1]
        return size, (last - first) / (ended - began) if ended > began else None

    def _frames(self) -> Iterator[Frame]:
        decoder, shown = _Decoder(self._planes), -1
        # Times since the first image, which never fall, of the last images by their index.
        first_ns, time_s, times_s = None, 0.0, {}
        for index, (log_ns, message) in enumerate(self._messages()):
            if message is not None:
                time_ns = message.stamp_ns or log_ns
                first_ns = time_ns if first_ns is None else first_ns
                time_s = times_s[index] = max(time_s, 1e-9 * (time_ns - first_ns))
                times_s.pop(index - 64, None)
                for frame in decoder.decode(index, message):
                    shown = index
                    yield replace(frame, time_s=times_s.get(frame.index, time_s))
            if index - shown > _MAX_UNREADABLE:
                raise SourceError(
                    f"{self.name}: {index - shown} messages in a row hold no image that can be "
                    "read; cut the recording before them, or record it again"
                )

    def _planes(self, message: ImageMessage) -> Planes | None:
        raw = message.size_px is not None
        if raw and message.encoding.lower() not in ENCODINGS:
            raise SourceError(
                f"{self.name}: images of encoding {message.encoding!r} cannot be read; "
                f"known are {', '.join(ENCODINGS)}"
            )
        return planes_of_message(message)


class _Decoder:
    """Decoder of pictures, and of the packets of a video, which are numbered by their messages."""

    def __init__(self, planes_of_picture: Callable[[ImageMessage], Planes | None]) -> None:
        self._planes_of_picture = planes_of_picture
        self._video: LiveDecoder | None = None

    def decode(self, index: int, message: ImageMessage) -> Iterator[Frame]:
        """Yield frames at time 0."""
        if message.codec is None:
            planes = self._planes_of_picture(message)
            if planes is not None:
                yield Frame(index, 0.0, *planes)
            return
        if self._video is None:
            context = cast("VideoCodecContext", av.CodecContext.create(message.codec, "r"))
            self._video = LiveDecoder(context, reports_losses=False)
        packet = packet_with(message.data)
        packet.pts = index
        for picture in self._video.decode(packet):
            yield frame_of(index if picture.pts is None else picture.pts, 0.0, picture)
