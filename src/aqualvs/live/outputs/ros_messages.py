"""What ROS is told, before it takes the form of ROS 1, of ROS 2 or of DDS.

Frames and signs are those of `aqualvs.live.outputs.axes`: forward, left, up at the dome's centre.
"""

import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import TypeAlias

import numpy as np

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.live.outputs.axes import flu_from_dome, plane_pose
from aqualvs.live.outputs.ros_messages_diagnostics import DiagnosticsMessage, diagnostics_message
from aqualvs.live.sample import LiveSample
from aqualvs.optics.rig import Rig
from aqualvs.scanning.posture import Posture, Reason
from aqualvs.scanning.scan import Label, ScanPoints

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*")


@dataclass(frozen=True, slots=True)
class PointField:
    """As sensor_msgs/PointField, one value in each; `format` is NumPy's name of `datatype`."""

    name: str
    offset: int
    datatype: int
    format: str


_INT8, _UINT8, _FLOAT32 = 1, 2, 7

POINT_FIELDS = (
    PointField("x", 0, _FLOAT32, "<f4"),
    PointField("y", 4, _FLOAT32, "<f4"),
    PointField("z", 8, _FLOAT32, "<f4"),
    PointField("intensity", 12, _FLOAT32, "<f4"),
    PointField("sigma", 16, _FLOAT32, "<f4"),
    PointField("laser", 20, _INT8, "i1"),
    PointField("label", 21, _UINT8, "u1"),
    PointField("used", 22, _UINT8, "u1"),
)
"""What a point of the cloud consists of: metres, grey levels, indices, `Label` and 0 or 1."""

POINT_TYPE = np.dtype(
    {
        "names": [field.name for field in POINT_FIELDS],
        "formats": [field.format for field in POINT_FIELDS],
        "offsets": [field.offset for field in POINT_FIELDS],
        "itemsize": 24,
    }
)
"""One point of the cloud as it lies in `CloudMessage.data`."""


class Topic(StrEnum):
    """What is published; the value is the last part of its topic's name."""

    POSTURE = "posture"
    FILTERED = "posture_filtered"
    RANGE = "range"
    CLOUD = "cloud"
    DIAGNOSTICS = "diagnostics"


@dataclass(frozen=True, slots=True, kw_only=True)
class RosOptions:
    """Names, and how hard it is tried to deliver.

    Attributes
    ----------
    namespace : str
        What the topics' names start with; `diagnostics` stays at the root, where ROS looks for it.
    frame_id : str
        Name of the frame at the dome's centre, forward, left, up.
    reliable : bool
        ROS 2: offer to repeat what gets lost. Then every subscriber fits, whichever it asks for;
        without, only those that ask for best effort.
    diagnostics_period_s : float

    Raises
    ------
    OptionError
        If a name is none that ROS allows, or the period is not positive.
    """

    namespace: str = "aqualvs"
    frame_id: str = "aqualvs_dome"
    reliable: bool = True
    diagnostics_period_s: float = 1.0

    def __post_init__(self) -> None:
        for what, name in (("namespace", self.namespace), ("frame", self.frame_id)):
            if not _NAME.fullmatch(name):
                raise OptionError(
                    f"ROS {what} {name!r}: use letters, digits and _, starting with a letter; "
                    "parts are joined by /, without one in front"
                )
        if not self.diagnostics_period_s > 0.0:
            raise OptionError(f"period of diagnostics {self.diagnostics_period_s:g} s: not above 0")

    def topic_name(self, topic: Topic) -> str:
        """Return the full name of a topic."""
        return "/diagnostics" if topic is Topic.DIAGNOSTICS else f"/{self.namespace}/{topic}"


@dataclass(frozen=True, slots=True)
class PoseMessage:
    """As geometry_msgs/PoseWithCovarianceStamped; see `PlanePose`."""

    stamp_ns: int
    frame_id: str
    position: FloatArray
    quaternion: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class RangeMessage:
    """As sensor_msgs/Range: metres, radians; `variance` (m²) exists from ROS 2 Iron on."""

    stamp_ns: int
    frame_id: str
    field_of_view: float
    min_range: float
    max_range: float
    range: float
    variance: float


@dataclass(frozen=True, slots=True)
class CloudMessage:
    """As sensor_msgs/PointCloud2: `width` points of `POINT_TYPE` in one row."""

    stamp_ns: int
    frame_id: str
    width: int
    data: bytes
    is_dense: bool


Message: TypeAlias = PoseMessage | RangeMessage | CloudMessage | DiagnosticsMessage


class MessageMaker:
    """Turns samples into messages, the diagnostics once in a while.

    Parameters
    ----------
    options : RosOptions
    """

    def __init__(self, options: RosOptions) -> None:
        self._options = options
        self._rig: Rig | None = None
        self._field_of_view = 0.0
        self._next_diagnostics_ns: int | None = None

    def messages(
        self, sample: LiveSample, wanted: Collection[Topic]
    ) -> Iterator[tuple[Topic, Message]]:
        """Yield what there is to say about a sample, on the topics that somebody listens to.

        Without a posture there is no pose, and the range is not a number.
        """
        stamp, frame = sample.utc_ns, self._options.frame_id
        posture, filtered = sample.scan.posture, sample.filtered
        if Topic.POSTURE in wanted and posture:
            yield (
                Topic.POSTURE,
                _pose_message(
                    stamp,
                    frame,
                    posture.range,
                    posture.pitch,
                    posture.yaw,
                    posture.total_covariance,
                ),
            )
        if Topic.FILTERED in wanted and filtered is not None:
            cov = filtered.total_covariance
            yield (
                Topic.FILTERED,
                _pose_message(stamp, frame, filtered.range, filtered.pitch, filtered.yaw, cov),
            )
        if Topic.RANGE in wanted:
            yield Topic.RANGE, self._range_message(sample)
        if Topic.CLOUD in wanted:
            yield Topic.CLOUD, cloud_message(stamp, frame, sample.scan.points)
        if Topic.DIAGNOSTICS in wanted and self._diagnostics_are_due(sample):
            yield Topic.DIAGNOSTICS, diagnostics_message(sample)

    def _range_message(self, sample: LiveSample) -> RangeMessage:
        rig, posture = sample.rig, sample.scan.posture
        if rig is not self._rig:
            self._rig, self._field_of_view = rig, field_of_view(rig)
        near, far = rig.working_range
        value = posture.range if posture else _no_range(sample)
        if posture:
            # What the scanner believes just outside must not be thrown away by the receiver.
            near, far = min(near, value), max(far, value)
        return RangeMessage(
            stamp_ns=sample.utc_ns,
            frame_id=self._options.frame_id,
            field_of_view=self._field_of_view,
            min_range=near,
            max_range=far,
            range=value,
            variance=float(posture.total_covariance[0, 0]) if posture else 0.0,
        )

    def _diagnostics_are_due(self, sample: LiveSample) -> bool:
        now = sample.instants.scanned_ns
        if self._next_diagnostics_ns is not None and now < self._next_diagnostics_ns:
            return False
        self._next_diagnostics_ns = now + round(1e9 * self._options.diagnostics_period_s)
        return True


def cloud_message(stamp_ns: int, frame_id: str, points: ScanPoints) -> CloudMessage:
    """Return all stripe points of a frame, in forward, left, up."""
    packed = np.zeros(len(points), POINT_TYPE)
    xyz = flu_from_dome(points.points_in_dome)
    packed["x"], packed["y"], packed["z"] = xyz.T
    packed["intensity"], packed["sigma"] = points.intensity, points.sigma
    packed["laser"], packed["label"], packed["used"] = points.laser, points.label, points.used
    dense = bool(np.isfinite(xyz).all())
    return CloudMessage(stamp_ns, frame_id, len(points), packed.tobytes(), dense)


def field_of_view(rig: Rig) -> float:
    """Return the angle (rad) that the picture spans from left to right in the water."""
    width, height = rig.size_px
    middle = 0.5 * (height - 1)
    rays = rig.camera().rays([[0.0, middle], [width - 1.0, middle]])
    if not rays.valid.all():
        return float(2.0 * np.arctan(0.5 * width / rig.focal_px))
    left, right = rays.directions
    return float(np.arctan2(np.linalg.norm(np.cross(left, right)), left @ right))


def _pose_message(
    stamp_ns: int, frame_id: str, distance: float, pitch: float, yaw: float, cov: FloatArray
) -> PoseMessage:
    pose = plane_pose(distance, pitch, yaw, cov)
    return PoseMessage(
        stamp_ns, frame_id, pose.position, pose.quaternion, pose.covariance.reshape(36)
    )


def _no_range(sample: LiveSample) -> float:
    """Return what REP-117 says where there is no range.

    Minus infinity for a target that is too near, infinity for one that is too far, else not a
    number: a picture without stripes is no promise that the way is free.
    """
    posture, points = sample.scan.posture, sample.scan.points
    assert not isinstance(posture, Posture)
    # A wall behind a net that is too near may well give more points than the net.
    to_target = points.label != Label.BACKGROUND
    if posture.reason is not Reason.OUT_OF_RANGE or not to_target.any():
        return float("nan")
    near, far = sample.rig.working_range
    ahead = float(np.median(points.points_in_dome[to_target, 1]))
    return float("-inf") if ahead < 0.5 * (near + far) else float("inf")
