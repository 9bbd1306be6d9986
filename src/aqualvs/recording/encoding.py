"""Topics and message definitions of a recording, and the encoding of its messages (CDR).

Definitions are in the message language of ROS 2. CDR, its encoding, is little-endian here, and
implemented as far as these messages need it: primitives are aligned to multiples of their size,
counted from the end of the four bytes at the start of every message. A sequence is its length as
uint32, then its elements; an empty one has no gap after its length.

Pictures are JPEG (small) or PNG of the unchanged planes (lossless). The rig is recorded as the text
of its file and its exact numbers; the scanner's options as JSON.
"""

import json
import struct
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from aqualvs.errors import RigError
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.camera import Housing
from aqualvs.optics.dome import Dome
from aqualvs.optics.flat_port import FlatPort
from aqualvs.optics.rig import Laser, Rig, Window
from aqualvs.optics.rigfile import rig_from_mapping
from aqualvs.scanner import ScannerOptions
from aqualvs.scanning.detection import DETECTORS, detector_word
from aqualvs.scanning.paper.mesh_filter import MeshFilterOptions
from aqualvs.scanning.posture_estimator import FitMethod
from aqualvs.scanning.scan import Frame, ImagePlane, planes_of_image
from aqualvs.scanning.target import TargetKind
from aqualvs.sources.base import bgr_of
from aqualvs.yamlfile import parse_yaml

# Noise contains few repetitions: run-length coding is smaller than a search for them, and as fast.
_PNG = [
    *(cv2.IMWRITE_PNG_COMPRESSION, 1),
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE),
]


class PictureFormat(StrEnum):
    """Format of recorded pictures."""

    JPEG = "jpeg"
    PNG = "png"
    """Luma as one grey picture, and U above V as another: lossless and large."""


def jpeg_of(frame: Frame, quality: int) -> bytes:
    """Return a frame as JPEG, in colour if it has chroma.

    `quality`: 1 to 100.
    """
    image = bgr_of(frame)
    if frame.chroma is None:
        image = np.ascontiguousarray(image[..., 0])
    return _encode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])


def png_of(frame: Frame) -> tuple[bytes, bytes | None]:
    """Return luma and chroma (None for a grey frame) as PNG."""
    luma = _encode(".png", np.ascontiguousarray(frame.luma), _PNG)
    if frame.chroma is None:
        return luma, None
    return luma, _encode(".png", np.concatenate(frame.chroma), _PNG)


def frame_of(index: int, time_s: float, kind: str, picture: bytes, chroma: bytes | None) -> Frame:
    """Return the frame of recorded pictures.

    `kind`: a `PictureFormat`; `chroma`: the second picture of PNG, None for a grey frame. Raises
    `ValueError` if a picture cannot be decoded.
    """
    image = _decode(picture)
    if kind == PictureFormat.JPEG:
        return Frame(index, time_s, *planes_of_image(image))
    if chroma is None:
        return Frame(index, time_s, image)
    both = _decode(chroma)
    rows = len(both) // 2
    return Frame(index, time_s, image, (both[:rows], both[rows:]))


def _encode(suffix: str, image: ImagePlane, options: list[int]) -> bytes:
    _, found = cv2.imencode(suffix, image, options)
    return found.tobytes()


def _decode(data: bytes) -> ImagePlane:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_ANYCOLOR)
    if image is None:
        raise ValueError("a picture that cannot be decoded")
    return cast(ImagePlane, image)


def rig_exact(rig: Rig) -> str:
    """Return the exact values of the numbers that a rig file rounds, as JSON."""
    pose, dome, port = rig.dome_from_cam, rig.dome, rig.flat_port
    found = {
        "rotation": pose.rotation.tolist(),
        "translation": pose.translation.tolist(),
        "dome": None if dome is None else [dome.inner_radius, dome.thickness, dome.n_acrylic],
        "n_air": rig.n_air,
        "n_water": rig.n_water,
        "lasers": [_laser_numbers(laser) for laser in rig.lasers],
        "working_range": list(rig.working_range),
    }
    if port is not None:
        found["flat"] = list(port.numbers().values())
    return json.dumps(found)


def rig_from_record(text: str, exact: str, source_name: str) -> Rig:
    """Return the rig of a recording, to the last bit.

    `text`, `exact`: text of the rig file, and that of `rig_exact`. `source_name`: name of the
    recording in messages. Raises `RigError` if the text is no rig file. Raises `ValueError` if the
    numbers do not match it.
    """
    content = parse_yaml(text, source_name, RigError)
    rig = rig_from_mapping(content, source_name=source_name, need_lasers=False)
    numbers = json.loads(exact)
    return replace(
        rig,
        dome_from_cam=SE3(np.array(numbers["rotation"]), np.array(numbers["translation"])),
        housing=_housing(numbers),
        n_air=numbers["n_air"],
        n_water=numbers["n_water"],
        lasers=tuple(
            _with_numbers(laser, own)
            for laser, own in zip(rig.lasers, numbers["lasers"], strict=True)
        ),
        working_range=tuple(numbers["working_range"]),
    )


def _housing(numbers: Mapping[str, Any]) -> Housing | None:
    if "flat" in numbers:
        return FlatPort(*numbers["flat"])
    return None if numbers["dome"] is None else Dome(*numbers["dome"])


def options_text(options: ScannerOptions) -> str:
    """Return the scanner's options as JSON."""
    found = asdict(options)
    found["detector"]["kind"] = detector_word(options.detector)
    return json.dumps(found)


def options_from_text(text: str) -> ScannerOptions:
    """Return the scanner's options that `options_text` wrote.

    Raises `ValueError`, `KeyError` or `TypeError` if this version does not know the text's content.
    """
    found = json.loads(text)
    detector = dict(found["detector"])
    kind = DETECTORS[detector.pop("kind")]
    # Recordings of 0.1.0 contain the option of a colour gate, since replaced by likelihoods.
    detector.pop("min_green_fall", None)
    mesh = found["mesh_filter"]
    return ScannerOptions(
        detector=kind(**detector),
        mesh_filter=None if mesh is None else MeshFilterOptions(**mesh),
        target=TargetKind(found["target"]),
        fit=FitMethod(found["fit"]),
    )


def _laser_numbers(laser: Laser) -> list[Any]:
    window = laser.window
    own = _plane_numbers(laser.plane)
    return own if window is None else [*own, *_plane_numbers(window.face), window.source.tolist()]


def _plane_numbers(plane: Plane) -> list[Any]:
    return [plane.normal.tolist(), float(plane.offset)]


def _with_numbers(laser: Laser, numbers: list[Any]) -> Laser:
    plane = Plane(np.array(numbers[0]), numbers[1])
    if len(numbers) == 2:
        return replace(laser, plane=plane, window=None)
    window = Window(Plane(np.array(numbers[2]), numbers[3]), np.array(numbers[4]))
    return replace(laser, plane=plane, window=window)


_HEAD = b"\x00\x01\x00\x00"
_NS = 1_000_000_000


class CdrWriter:
    """Writer of a CDR message, field by field in the order of its definition."""

    def __init__(self) -> None:
        self._content = bytearray(_HEAD)

    def numbers(self, kind: str, *values: float) -> None:
        """Append numbers of one `struct` format, such as the elements of a fixed array."""
        size = struct.calcsize("=" + kind)
        self._align(size)
        self._content += struct.pack(f"<{len(values)}{kind}", *values)

    def text(self, words: str) -> None:
        """Append a string."""
        content = words.encode("utf-8") + b"\0"
        self.numbers("I", len(content))
        self._content += content

    def array(self, values: NDArray[Any]) -> None:
        """Append a sequence of numbers of the array's type."""
        self.numbers("I", values.size)
        if values.size:
            self._align(values.itemsize)
            kind = values.dtype.newbyteorder("<")
            self._content += np.ascontiguousarray(values, kind).view(np.uint8).data

    def blob(self, content: bytes) -> None:
        """Append a sequence of bytes."""
        self.numbers("I", len(content))
        self._content += content

    def header(self, stamp_ns: int, frame_id: str) -> None:
        """Append a `std_msgs/Header`."""
        self.numbers("i", stamp_ns // _NS)
        self.numbers("I", stamp_ns % _NS)
        self.text(frame_id)

    def finish(self) -> bytes:
        """Return the message."""
        return bytes(self._content)

    def _align(self, size: int) -> None:
        self._content += bytes(-(len(self._content) - len(_HEAD)) % size)


class CdrReader:
    """Reader of a CDR message, field by field in the order of its definition.

    All methods raise `ValueError` if the message is truncated or not little-endian CDR.
    """

    def __init__(self, content: bytes) -> None:
        if content[: len(_HEAD)] != _HEAD:
            raise ValueError("not little-endian CDR")
        self._content, self._at = content, len(_HEAD)

    def number(self, kind: str) -> Any:
        """Read one number of a `struct` format."""
        return self.numbers(kind, 1)[0]

    def numbers(self, kind: str, n: int) -> tuple[Any, ...]:
        """Read n numbers of one `struct` format."""
        size = struct.calcsize("=" + kind)
        self._align(size)
        return struct.unpack(f"<{n}{kind}", self._take(n * size))

    def text(self) -> str:
        """Read a string."""
        return self._take(self.number("I"))[:-1].decode("utf-8")

    def array(self, kind: str) -> NDArray[Any]:
        """Read a sequence of numbers of a NumPy type, as a copy."""
        n, dtype = self.number("I"), np.dtype(kind).newbyteorder("<")
        if n:
            self._align(dtype.itemsize)
        found = np.frombuffer(self._take(n * dtype.itemsize), dtype)
        return found.astype(np.dtype(kind))

    @property
    def at_end(self) -> bool:
        """Whether the whole message has been read."""
        return self._at >= len(self._content)

    def blob(self) -> bytes:
        """Read a sequence of bytes."""
        return self._take(self.number("I"))

    def header(self) -> tuple[int, str]:
        """Read a `std_msgs/Header`: time in nanoseconds and frame id."""
        seconds, nanoseconds = self.number("i"), self.number("I")
        return seconds * _NS + nanoseconds, self.text()

    def _align(self, size: int) -> None:
        self._at += -(self._at - len(_HEAD)) % size

    def _take(self, n: int) -> bytes:
        end = self._at + n
        if end > len(self._content):
            raise ValueError(f"cut short: {len(self._content)} of {end} bytes")
        found = self._content[self._at : end]
        self._at = end
        return found


_TIME = "builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n"
_HEADER = "std_msgs/Header", "builtin_interfaces/Time stamp\nstring frame_id\n"


@dataclass(frozen=True, slots=True)
class RecordedTopic:
    """Topic of a recording."""

    number: int  # Id of its channel and its schema in the file, from 1.
    name: str
    kind: str  # Full name of its message type.
    definition: str  # Of the message type and of all types in it.


_POSTURE = """\
# Vehicle relative to the target; NaN where there is no value.
std_msgs/Header header
int64 frame
float64 time_s
bool valid
# Why there is no posture: one word, and in words.
string reason
string detail
float64 range_m
float64 pitch_deg
float64 yaw_deg
float64 sigma_range_m
float64 sigma_pitch_deg
float64 sigma_yaw_deg
float64 slant_range_m
float64 nearest_m
float64 rms_m
float64 n_water
# Unit normal of the target in the frame dome, pointing away from the vehicle.
float64[3] normal
# Of range, pitch and yaw by the noise of the frame, in m and rad, row by row.
float64[9] covariance
# Of a curved net, along the horizontal and the vertical.
float64[2] curvature_per_m
float64[2] sigma_curvature_per_m
int32 n_points
int32 n_all_points
# The time filter, where it is on.
bool filtered
bool filter_accepted
float64 filtered_range_m
float64 filtered_pitch_deg
float64 filtered_yaw_deg
float64 filtered_range_rate_m_per_s
float64 filtered_pitch_rate_deg_per_s
float64 filtered_yaw_rate_deg_per_s
float64 filter_age_s
# From the decoded picture to the measured one.
float64 delay_s
# By the uncertainty of the rig, which is common to all frames; and by both together.
float64 sigma_range_rig_m
float64 sigma_pitch_rig_deg
float64 sigma_yaw_rig_deg
float64 sigma_range_total_m
float64 sigma_pitch_total_deg
float64 sigma_yaw_total_deg
float64[9] rig_covariance
"""

_STRIPES = """\
# What the detector found in a picture, bit for bit.
std_msgs/Header header
int64 frame
float64 time_s
float64 n_water
# Why the picture was not measured: one word, and in words; empty where it was.
string refusal
string detail
aqualvs_msgs/Returns[] returns
# Pull of each peak by an uneven background in pixels: those of the first entry, then the next.
float64[] pull
# Angular velocity of the vehicle about x, y and z of the dome at the picture's middle, and the
# standard deviation of each, from its gyros; empty where they are not known or not of use.
float64[] turning_rad_per_s
"""

_PEAKS = """\
# Axis that the search lines run along: y (columns) or x (rows).
string axis
uint32[] line
float64[] position
float64[] height
float64[] width
float64[] likelihood
"""

_HEALTH = """\
# States: 0 off, 1 ok, 2 warn, 3 fault.
std_msgs/Header header
uint8 state
float64 rate_hz
float64 valid_share
float64 quality
float64 n_water
float64 sigma_n_water
int64 n_frames
int64 n_dropped
int64 n_lost
aqualvs_msgs/Part[] parts
aqualvs_msgs/Delay[] delays
"""

_PART = """\
# source, laser or output
string kind
string name
uint8 state
string detail
int64 n_dropped
"""

_DELAY = """\
string name
float64 median_s
float64 p99_s
"""

_RIG = """\
std_msgs/Header header
# The rig file.
string yaml
# Its numbers to the last bit, and the scanner's options, as JSON.
string exact
string options
"""

_POINTS = """\
std_msgs/Header header
uint32 height
uint32 width
sensor_msgs/PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense
"""

_FIELD = """\
uint8 INT8=1
uint8 UINT8=2
uint8 INT16=3
uint8 UINT16=4
uint8 INT32=5
uint8 UINT32=6
uint8 FLOAT32=7
uint8 FLOAT64=8
string name
uint32 offset
uint8 datatype
uint32 count
"""

_IMAGE = """\
std_msgs/Header header
string format
uint8[] data
"""


def _topic(number: int, name: str, kind: str, own: str, *parts: tuple[str, str]) -> RecordedTopic:
    """Return a topic with the definitions of its parts, in the format of ROS 2's recordings."""
    line = 80 * "=" + "\n"
    others = (f"{line}MSG: {part}\n{text}" for part, text in (_HEADER, _TIME, *parts))
    return RecordedTopic(number, f"/aqualvs/{name}", kind, "".join([own, *others]))


_RETURNS, _POINT_FIELD = ("aqualvs_msgs/Returns", _PEAKS), ("sensor_msgs/PointField", _FIELD)
_PARTS = ("aqualvs_msgs/Part", _PART), ("aqualvs_msgs/Delay", _DELAY)
POSTURE = _topic(1, "posture", "aqualvs_msgs/msg/Posture", _POSTURE)
STRIPES = _topic(2, "stripes", "aqualvs_msgs/msg/Stripes", _STRIPES, _RETURNS)
POINTS = _topic(3, "points", "sensor_msgs/msg/PointCloud2", _POINTS, _POINT_FIELD)
HEALTH = _topic(4, "health", "aqualvs_msgs/msg/Health", _HEALTH, *_PARTS)
RIG = _topic(5, "rig", "aqualvs_msgs/msg/Rig", _RIG)
PICTURE = _topic(6, "picture", "sensor_msgs/msg/CompressedImage", _IMAGE)
CHROMA = _topic(7, "picture/chroma", "sensor_msgs/msg/CompressedImage", _IMAGE)
TOPICS = (POSTURE, STRIPES, POINTS, HEALTH, RIG, PICTURE, CHROMA)
"""All topics of a recording; the last two have no messages without pictures."""
