"""Foxglove live: a WebSocket server that Foxglove connects to (extra `foxglove`).

Topics and messages are those of a recording (`aqualvs.recording.encoding`), so that one layout
shows both. In addition there are coordinate frames and a scene for the 3D panel: target plane and
laser lines beside the points. Messages that nobody watches are not made.
"""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from aqualvs.errors import OptionError, OutputError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import upright_axes
from aqualvs.geometry.transforms import quaternion_from_rotation
from aqualvs.live.outputs.base import Output
from aqualvs.live.outputs.ros_messages import FLU_FROM_DOME
from aqualvs.optics.rig import Laser, Rig
from aqualvs.recording import messages
from aqualvs.recording.encoding import HEALTH, PICTURE, POINTS, POSTURE, RIG, RecordedTopic, jpeg_of
from aqualvs.recording.messages import FRAME_ID, RateLimit, RecordClock
from aqualvs.recording.sample import LiveSample
from aqualvs.scanner import ScannerOptions
from aqualvs.scanning.posture import Posture
from aqualvs.scanning.scan import Scan, ScanPoints
from aqualvs.sources.base import PartHealth, State

if TYPE_CHECKING:
    from foxglove import Channel
    from foxglove import messages as sdk
    from foxglove.websocket import ChannelView, Client


VEHICLE = "vehicle"
"""Axes of REP-103: x forward, y left, z up, as 3D views expect them; origin as `dome`."""

_GREEN = {"r": 0.1, "g": 1.0, "b": 0.3, "a": 1.0}
_BLUE = {"r": 0.2, "g": 0.6, "b": 1.0, "a": 0.25}
_LINE_PX = 2.0


def transforms(rig: Rig, stamp_ns: int) -> "sdk.FrameTransforms":
    """Return where dome and camera are on the vehicle."""
    from foxglove.messages import FrameTransform, FrameTransforms

    camera = rig.dome_from_cam
    frames = [
        (VEHICLE, FRAME_ID, FLU_FROM_DOME, np.zeros(3)),
        (FRAME_ID, "cam", camera.rotation, camera.translation),
    ]
    return FrameTransforms(
        transforms=[
            FrameTransform(
                timestamp=_stamp(stamp_ns),
                parent_frame_id=parent,
                child_frame_id=child,
                translation=_vector(origin),
                rotation=_quaternion(rotation),
            )
            for parent, child, rotation, origin in frames
        ]
    )


def scene(rig: Rig, scan: Scan, stamp_ns: int) -> "sdk.SceneUpdate":
    """Return the target's plane with the lasers' lines on it; nothing without a posture.

    What was drawn before vanishes by itself after half a second.
    """
    lifetime_s = 0.5
    from foxglove import messages as sdk

    posture = scan.posture
    if not isinstance(posture, Posture):
        return sdk.SceneUpdate()
    side, normal = posture.range, posture.normal_in_dome
    foot = side * normal
    # A thin square, as wide as its range, about the perpendicular's foot.
    square = sdk.CubePrimitive(
        pose=_pose(upright_axes(normal), foot),
        size=sdk.Vector3(x=side, y=1e-3, z=side),
        color=sdk.Color(**_BLUE),
    )
    caption = sdk.TextPrimitive(
        pose=_pose(np.eye(3), foot),
        billboard=True,
        font_size=14.0,
        scale_invariant=True,
        color=sdk.Color(r=1.0, g=1.0, b=1.0, a=1.0),
        text=f"{posture.range:.3f} m",
    )
    lines = [
        sdk.LinePrimitive(
            type=sdk.LinePrimitiveLineType.LineStrip,
            pose=_pose(np.eye(3), np.zeros(3)),
            thickness=_LINE_PX,
            scale_invariant=True,
            points=[sdk.Point3(x=float(x), y=float(y), z=float(z)) for x, y, z in ends],
            color=sdk.Color(**_GREEN),
        )
        for ends in laser_lines(rig.lasers, normal, scan.points)
    ]
    entity = sdk.SceneEntity(
        timestamp=_stamp(stamp_ns),
        frame_id=FRAME_ID,
        id="target",
        lifetime=sdk.Duration.from_secs(lifetime_s),
        cubes=[square],
        lines=lines,
        texts=[caption],
    )
    return sdk.SceneUpdate(entities=[entity])


def laser_lines(
    lasers: tuple[Laser, ...], normal: FloatArray, points: ScanPoints
) -> list[FloatArray]:
    """Return the ends, shape (2, 3), of the line that each laser was seen to draw on the target.

    `normal`, shape (3,): of the target. `points`: only the posture's inliers count.
    """
    found = []
    for i, laser in enumerate(lasers):
        mine = points.points_in_dome[points.used & (points.laser == i)]
        if len(mine) < 2:
            continue
        along = mine @ np.cross(normal, laser.plane.normal)
        found.append(mine[[np.argmin(along), np.argmax(along)]])
    return found


def _pose(rotation: FloatArray, origin: FloatArray) -> "sdk.Pose":
    from foxglove.messages import Pose

    return Pose(position=_vector(origin), orientation=_quaternion(rotation))


def _vector(values: FloatArray) -> "sdk.Vector3":
    from foxglove.messages import Vector3

    x, y, z = values.tolist()
    return Vector3(x=x, y=y, z=z)


def _quaternion(rotation: FloatArray) -> "sdk.Quaternion":
    from foxglove.messages import Quaternion

    x, y, z, w = quaternion_from_rotation(rotation)
    return Quaternion(x=x, y=y, z=z, w=w)


def _stamp(stamp_ns: int) -> "sdk.Timestamp":
    from foxglove.messages import Timestamp

    return Timestamp(*divmod(stamp_ns, 10**9))


LAYOUT = Path(__file__).with_name("foxglove_layout.json")
"""A layout that shows everything; import it in Foxglove."""

_TRANSFORMS, _SCENE = "/aqualvs/transforms", "/aqualvs/scene"


class FoxgloveOutput(Output):
    """Server of posture, points, picture, scene and health to any number of viewers.

    `host`: address to listen on. Whoever reaches it can watch, and can do nothing else; "0.0.0.0"
    opens it to the network. `port`: 0 takes any that is free. `scanner`: options that the postures
    are measured with; shown beside the rig. `picture_hz`, `points_hz`: most pictures, and point
    clouds, per second; 0 for none.

    Raises `OptionError` if foxglove-sdk is not installed. Raises `OutputError` if the address
    cannot be used.
    """

    name = "foxglove"

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 8765,
        *,
        scanner: ScannerOptions | None = None,
        picture_hz: float = 5.0,
        points_hz: float = 10.0,
    ) -> None:
        seldom_hz = 1.0
        foxglove = _sdk()
        self._options = scanner or ScannerOptions()
        self._viewers = _Viewers()
        self._clock = RecordClock()
        # Channels do not keep it alive.
        self._context = context = foxglove.Context()
        self._channels: dict[RecordedTopic, Channel] = {}
        for topic in (POSTURE, POINTS, PICTURE, HEALTH, RIG):
            schema = foxglove.Schema(
                name=topic.kind, encoding="ros2msg", data=topic.definition.encode("utf-8")
            )
            self._channels[topic] = foxglove.Channel(
                topic.name, schema=schema, message_encoding="cdr", context=context
            )
        self._transforms = foxglove.channels.FrameTransformsChannel(_TRANSFORMS, context=context)
        self._scene = foxglove.channels.SceneUpdateChannel(_SCENE, context=context)
        self._picture_due, self._points_due = RateLimit(picture_hz), RateLimit(points_hz)
        self._seldom_due = RateLimit(seldom_hz)
        try:
            self._server = foxglove.start_server(
                name="aqualvs", host=host, port=port, context=context, server_listener=self._viewers
            )
        except (OSError, RuntimeError) as fault:
            raise OutputError(
                f"foxglove: cannot listen on {host}:{port} ({fault}); "
                "choose another port, or end the program that has it"
            ) from fault
        self.port: int = self._server.port  # That it listens on.
        self._where = f"{host}:{self.port}"
        self._closed = False

    def send(self, sample: LiveSample) -> None:
        """Send a sample to those who watch."""
        jpeg_quality = 75
        if self._closed:
            return
        at_ns = self._clock.stamp_ns(sample)
        scan, frame = sample.scan, sample.frame
        self._log(POSTURE, at_ns, lambda: messages.posture_message(sample, at_ns))
        if self._scene.has_sinks():
            self._scene.log(scene(sample.rig, scan, at_ns), log_time=at_ns)
        if len(scan.points):
            self._log(
                POINTS, at_ns, lambda: messages.points_message(scan.points, at_ns), self._points_due
            )
        if frame is not None:
            self._log(
                PICTURE,
                at_ns,
                lambda: messages.image_message("jpeg", jpeg_of(frame, jpeg_quality), at_ns),
                self._picture_due,
            )
        if self._seldom_due.at(at_ns) or self._viewers.take_subscribed():
            self._log_rarely_changing(sample, at_ns)

    def health(self) -> PartHealth:
        """Return how many watch."""
        if self._closed:
            return PartHealth(self.name, State.OFF)
        n = self._viewers.n_watching
        watched = f"{n} watching" if n else "nobody watches"
        return PartHealth(self.name, State.OK, f"{watched} on {self._where}")

    def close(self) -> None:
        """Say good-bye to the viewers and free the port; further calls do nothing."""
        if not self._closed:
            self._closed = True
            self._server.stop()

    def _log_rarely_changing(self, sample: LiveSample, at_ns: int) -> None:
        """Send data that rarely change, also to new viewers."""
        rig, health, options = sample.rig, sample.health, self._options
        if self._transforms.has_sinks():
            self._transforms.log(transforms(rig, at_ns), log_time=at_ns)
        self._log(HEALTH, at_ns, lambda: messages.health_message(health, at_ns))
        self._log(RIG, at_ns, lambda: messages.rig_message(messages.rig_texts(rig, options), at_ns))

    def _log(
        self,
        topic: RecordedTopic,
        at_ns: int,
        content: Callable[[], bytes],
        due: RateLimit | None = None,
    ) -> None:
        """Send a message if its topic has viewers and it is due."""
        channel = self._channels[topic]
        if channel.has_sinks() and (due is None or due.at(at_ns)):
            channel.log(content(), log_time=at_ns)


class _Viewers:
    """Counter of viewers; called by the server's threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._n_topics: dict[int, int] = {}
        self._subscribed = False

    @property
    def n_watching(self) -> int:
        """Viewers with at least one topic."""
        with self._lock:
            return len(self._n_topics)

    def take_subscribed(self) -> bool:
        """Return whether a viewer has subscribed to a topic since the last call."""
        with self._lock:
            subscribed, self._subscribed = self._subscribed, False
            return subscribed

    def on_subscribe(self, client: "Client", _channel: "ChannelView") -> None:
        """Note a viewer's interest in a topic."""
        with self._lock:
            self._n_topics[client.id] = self._n_topics.get(client.id, 0) + 1
            self._subscribed = True

    def on_unsubscribe(self, client: "Client", _channel: "ChannelView") -> None:
        """Note that it has gone."""
        with self._lock:
            left = self._n_topics.pop(client.id, 1) - 1
            if left > 0:
                self._n_topics[client.id] = left


def _sdk() -> Any:
    try:
        import foxglove
        import foxglove.channels
        import foxglove.messages
    except ImportError:
        raise OptionError(
            "foxglove: needs foxglove-sdk; install it by pip install 'aqualvs[foxglove]'"
        ) from None
    return foxglove
