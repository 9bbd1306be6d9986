"""The topics of a recording and the definitions of their messages, in ROS 2's language."""

from dataclasses import dataclass

_TIME = "builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n"
_HEADER = "std_msgs/Header", "builtin_interfaces/Time stamp\nstring frame_id\n"


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic.

    Attributes
    ----------
    number : int
        Of its channel and its schema in the file; from 1.
    name : str
    kind : str
        Full name of its messages.
    definition : str
        Of its messages and of all that they hold.
    """

    number: int
    name: str
    kind: str
    definition: str


def _definition(own: str, *parts: tuple[str, str]) -> str:
    """Return a definition with those of its parts, as ROS 2's recordings have them."""
    line = 80 * "=" + "\n"
    return "".join([own, *(f"{line}MSG: {name}\n{text}" for name, text in parts)])


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
"""

_RETURNS = """\
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

POSTURE = Topic(
    1, "/aqualvs/posture", "aqualvs_msgs/msg/Posture", _definition(_POSTURE, _HEADER, _TIME)
)
STRIPES = Topic(
    2,
    "/aqualvs/stripes",
    "aqualvs_msgs/msg/Stripes",
    _definition(_STRIPES, _HEADER, _TIME, ("aqualvs_msgs/Returns", _RETURNS)),
)
POINTS = Topic(
    3,
    "/aqualvs/points",
    "sensor_msgs/msg/PointCloud2",
    _definition(_POINTS, _HEADER, _TIME, ("sensor_msgs/PointField", _FIELD)),
)
HEALTH = Topic(
    4,
    "/aqualvs/health",
    "aqualvs_msgs/msg/Health",
    _definition(
        _HEALTH, _HEADER, _TIME, ("aqualvs_msgs/Part", _PART), ("aqualvs_msgs/Delay", _DELAY)
    ),
)
RIG = Topic(5, "/aqualvs/rig", "aqualvs_msgs/msg/Rig", _definition(_RIG, _HEADER, _TIME))
PICTURE = Topic(
    6,
    "/aqualvs/picture",
    "sensor_msgs/msg/CompressedImage",
    _definition(_IMAGE, _HEADER, _TIME),
)
CHROMA = Topic(
    7,
    "/aqualvs/picture/chroma",
    "sensor_msgs/msg/CompressedImage",
    _definition(_IMAGE, _HEADER, _TIME),
)
TOPICS = (POSTURE, STRIPES, POINTS, HEALTH, RIG, PICTURE, CHROMA)
"""All of them; a recording without pictures has no messages on the last two."""
