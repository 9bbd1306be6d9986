"""Foxglove live: a WebSocket server that Foxglove connects to (extra `foxglove`).

Topics and messages are those of a recording (`recorder/schemas.py`), so that one layout shows
both; frames and scene come in addition. Nothing is made that nobody watches.
"""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aqualvs.errors import OptionError, OutputError
from aqualvs.live.health import PartHealth, State
from aqualvs.live.outputs import foxglove_scene
from aqualvs.live.recorder import messages, pictures, schemas
from aqualvs.live.recorder.sample_encoder import RecordClock
from aqualvs.live.recorder.schemas import Topic
from aqualvs.live.sample import LiveSample
from aqualvs.scanning.pipeline import ScannerOptions

if TYPE_CHECKING:
    from foxglove import Channel
    from foxglove.websocket import ChannelView, Client

LAYOUT = Path(__file__).with_name("foxglove_layout.json")
"""A layout that shows everything; import it in Foxglove."""

_TRANSFORMS, _SCENE = "/aqualvs/transforms", "/aqualvs/scene"
_JPEG_QUALITY = 75
_SELDOM_HZ = 1.0


class FoxgloveOutput:
    """Serves posture, points, picture, scene and health to any number of viewers.

    Parameters
    ----------
    host : str
        Address to listen on. Whoever reaches it can watch, and can do nothing else; "0.0.0.0"
        opens it to the network.
    port : int
        0 takes any that is free.
    picture_hz, points_hz : float
        Most pictures, and point clouds, per second; 0 for none.
    scanner : ScannerOptions, optional
        Shown with the rig.

    Attributes
    ----------
    name, inline, keeps_all
        As in `Output`.
    port : int
        That it listens on.

    Raises
    ------
    OptionError
        If foxglove-sdk is not installed.
    OutputError
        If the address cannot be used.
    """

    name = "foxglove"
    inline = False
    keeps_all = False

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 8765,
        *,
        picture_hz: float = 5.0,
        points_hz: float = 10.0,
        scanner: ScannerOptions | None = None,
    ) -> None:
        foxglove = _sdk()
        self._scanner = scanner or ScannerOptions()
        self._viewers = _Viewers()
        self._clock = RecordClock()
        # Channels do not keep it alive.
        self._context = context = foxglove.Context()
        shown = [schemas.POSTURE, schemas.POINTS, schemas.PICTURE, schemas.HEALTH, schemas.RIG]
        self._channels = {topic: _channel(foxglove, topic, context) for topic in shown}
        self._transforms = foxglove.channels.FrameTransformsChannel(_TRANSFORMS, context=context)
        self._scene = foxglove.channels.SceneUpdateChannel(_SCENE, context=context)
        self._picture_due, self._points_due = _Rate(picture_hz), _Rate(points_hz)
        self._seldom_due = _Rate(_SELDOM_HZ)
        try:
            self._server = foxglove.start_server(
                name="aqualvs",
                host=host,
                port=port,
                context=context,
                server_listener=self._viewers,
            )
        except (OSError, RuntimeError) as fault:
            raise OutputError(
                f"foxglove: cannot listen on {host}:{port} ({fault}); "
                "choose another port, or end the program that has it"
            ) from fault
        self.port: int = self._server.port
        self._where = f"{host}:{self.port}"
        self._closed = False

    def send(self, sample: LiveSample) -> None:
        """Send a sample to those who watch."""
        if self._closed:
            return
        at_ns = self._clock.stamp_ns(sample)
        scan, frame = sample.scan, sample.frame
        self._log(schemas.POSTURE, at_ns, lambda: messages.posture_message(sample, at_ns))
        if self._scene.has_sinks():
            self._scene.log(foxglove_scene.scene(sample.rig, scan, at_ns), log_time=at_ns)
        if len(scan.points):
            self._log(
                schemas.POINTS,
                at_ns,
                lambda: messages.points_message(scan.points, at_ns),
                self._points_due,
            )
        if frame is not None:
            self._log(
                schemas.PICTURE,
                at_ns,
                lambda: messages.image_message(
                    "jpeg", pictures.jpeg_of(frame, _JPEG_QUALITY), at_ns
                ),
                self._picture_due,
            )
        if self._seldom_due.at(at_ns) or self._viewers.take_news():
            self._log_seldom(sample, at_ns)

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

    def _log_seldom(self, sample: LiveSample, at_ns: int) -> None:
        """Send what changes seldom, also for those who have just come."""
        rig, health, options = sample.rig, sample.health, self._scanner
        if self._transforms.has_sinks():
            self._transforms.log(foxglove_scene.transforms(rig, at_ns), log_time=at_ns)
        self._log(schemas.HEALTH, at_ns, lambda: messages.health_message(health, at_ns))
        self._log(
            schemas.RIG,
            at_ns,
            lambda: messages.rig_message(messages.rig_texts(rig, options), at_ns),
        )

    def _log(
        self, topic: Topic, at_ns: int, content: Callable[[], bytes], due: "_Rate | None" = None
    ) -> None:
        """Send a message if somebody watches its topic and it is due."""
        channel = self._channels[topic]
        if channel.has_sinks() and (due is None or due.at(at_ns)):
            channel.log(content(), log_time=at_ns)


class _Viewers:
    """Counts who watches; called by the server's threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._watched: dict[int, int] = {}
        self._news = False

    @property
    def n_watching(self) -> int:
        """Viewers with at least one topic."""
        with self._lock:
            return len(self._watched)

    def take_news(self) -> bool:
        """Return whether somebody has asked for a topic since the last call."""
        with self._lock:
            news, self._news = self._news, False
            return news

    def on_subscribe(self, client: "Client", _channel: "ChannelView") -> None:
        """Note a viewer's interest in a topic."""
        with self._lock:
            self._watched[client.id] = self._watched.get(client.id, 0) + 1
            self._news = True

    def on_unsubscribe(self, client: "Client", _channel: "ChannelView") -> None:
        """Note that it has gone."""
        with self._lock:
            left = self._watched.pop(client.id, 1) - 1
            if left > 0:
                self._watched[client.id] = left


class _Rate:
    """Says when something may be sent again."""

    def __init__(self, hz: float) -> None:
        # A tenth of a period early rather than a whole frame late.
        self._every_ns = round(0.9e9 / hz) if hz else None
        self._from_ns = 0

    def at(self, stamp_ns: int) -> bool:
        """Return whether it is time, and begin to wait anew if so."""
        if self._every_ns is None or stamp_ns < self._from_ns:
            return False
        self._from_ns = stamp_ns + self._every_ns
        return True


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


def _channel(foxglove: Any, topic: Topic, context: Any) -> "Channel":
    schema = foxglove.Schema(
        name=topic.kind, encoding="ros2msg", data=topic.definition.encode("utf-8")
    )
    found: Channel = foxglove.Channel(
        topic.name, schema=schema, message_encoding="cdr", context=context
    )
    return found
