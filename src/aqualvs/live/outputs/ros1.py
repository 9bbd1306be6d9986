"""ROS 1 output: posture, range, cloud and diagnostics as topics of a node (extra `bags`).

The node registers with roscore and serves its subscribers itself. `rospy` would tie us to the
Python of a ROS release (3.8 on Noetic), waits for roscore without end when it starts, never
reconnects after roscore was restarted, and can be started once in a process. The protocol of a
publisher is small (http://wiki.ros.org/ROS/Slave_API, Master_API); messages are those of rosbags.
"""

import functools
import http.client
import logging
import os
import socket
import socketserver
import threading
import xmlrpc.client
import xmlrpc.server
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from aqualvs.errors import OptionError
from aqualvs.live.outputs.base import Output
from aqualvs.live.outputs.ros1_links import Ros1Links, Ros1Type
from aqualvs.live.outputs.ros_messages import (
    TYPE_NAMES,
    MessageMaker,
    PublishedTopic,
    RosOptions,
    RosTypes,
)
from aqualvs.recording.sample import LiveSample
from aqualvs.sources.base import PartHealth, State

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

DEFAULT_MASTER = "http://localhost:11311"
_TIMEOUT_S = 3.0
# No packet is ever sent there; the system is only asked for the route.
_REMOTE_ADDRESS = "198.51.100.1"
_MASTER_ERRORS = (OSError, xmlrpc.client.Error, http.client.HTTPException, ValueError)
_log = logging.getLogger(__name__)


class Ros1Node:
    """ROS 1 node that publishes topics; registers with roscore whenever that is there.

    `name`: full name, such as `/aqualvs`. `topics`: type of each topic by its full name.
    `master_uri`: where roscore is. `environment`: `ROS_HOSTNAME` or `ROS_IP`, the name that
    subscribers reach this machine by. Raises `OptionError` if `master_uri` is no address.
    """

    def __init__(
        self,
        name: str,
        topics: Mapping[str, Ros1Type],
        master_uri: str,
        environment: Mapping[str, str],
    ) -> None:
        self.name, self.topics, self.master_uri = name, dict(topics), master_uri
        self.host = advertised_host(master_host(master_uri), environment)
        self._stop = threading.Event()
        self._fault, self._ended = "not registered yet", ""
        at = "127.0.0.1" if _is_loopback(self.host) else "0.0.0.0"
        self.links = Ros1Links(at, name, topics)
        self._server = _Server(at, self)
        self.uri = f"http://{self.host}:{self._server.server_address[1]}/"
        self._thread = threading.Thread(target=self._stay_registered, name="ros1 node", daemon=True)
        self._thread.start()

    @property
    def fault(self) -> str:
        """Reason why roscore does not know the node; empty if it does."""
        return self._ended or self._fault

    def leave(self, reason: str) -> None:
        """End as ROS demands it: another node has taken the name, or `rosnode kill`."""
        self._ended = f"ended by ROS: {reason}"
        _log.warning("%s %s", self.name, self._ended)
        self._stop.set()
        self.links.close()

    def close(self) -> None:
        """Say good-bye to roscore and subscribers, within some seconds; once is enough."""
        self._stop.set()
        self._thread.join(_TIMEOUT_S)
        self._server.close()
        self.links.close()

    def _stay_registered(self) -> None:
        """See to it that roscore knows the node, also one that was restarted."""
        first_wait_s, longest_wait_s = 0.5, 8.0
        ask_every_s = 2.0
        wait_s, registered, next_wait_s = 0.0, False, first_wait_s
        while not self._stop.wait(wait_s):
            try:
                with _master(self.master_uri) as master:
                    self._register(master, is_known=registered)
            except _MASTER_ERRORS as fault:
                registered = False
                self._fault = f"no roscore at {self.master_uri} ({fault})"
                wait_s, next_wait_s = next_wait_s, min(2.0 * next_wait_s, longest_wait_s)
            else:
                registered, self._fault = True, ""
                wait_s, next_wait_s = ask_every_s, first_wait_s
        if registered:
            self._unregister()

    def _register(self, master: xmlrpc.client.ServerProxy, *, is_known: bool) -> None:
        if is_known:
            code, _, uri = _answer(master.lookupNode(self.name, self.name))
            if code == 1 and uri == self.uri:
                return
        for topic, kind in self.topics.items():
            code, text, _ = _answer(master.registerPublisher(self.name, topic, kind.name, self.uri))
            if code != 1:
                raise ValueError(f"{topic} refused: {text}")

    def _unregister(self) -> None:
        try:
            with _master(self.master_uri) as master:
                for topic in self.topics:
                    master.unregisterPublisher(self.name, topic, self.uri)
        except _MASTER_ERRORS as fault:
            _log.info("roscore went before %s: %s", self.name, fault)


class _QuietHandler(xmlrpc.server.SimpleXMLRPCRequestHandler):
    rpc_paths = ("/", "/RPC2")
    timeout = 5.0


class _Server(socketserver.ThreadingMixIn, xmlrpc.server.SimpleXMLRPCServer):
    """Slave API of a node for roscore and subscribers; each call is in a daemon thread.

    Answers are (code, message, value).
    """

    daemon_threads = True
    block_on_close = False

    def __init__(self, host: str, node: Ros1Node) -> None:
        super().__init__((host, 0), _QuietHandler, logRequests=False)
        self._node = node
        self._thread = threading.Thread(
            target=self.serve_forever, args=(0.1,), name="ros1 calls", daemon=True
        )
        self._thread.start()

    def _dispatch(self, method: str, params: Iterable[Any]) -> Any:
        """Answer a call."""
        node = self._node
        match method, *params:
            case "requestTopic", _, str(topic), list(protocols):
                return self._request(topic, protocols)
            case "getPid", _:
                return [1, "", os.getpid()]
            case "getMasterUri", _:
                return [1, "", node.master_uri]
            case "getPublications", _:
                return [1, "", [[topic, kind.name] for topic, kind in node.topics.items()]]
            case "getBusInfo", _:
                pairs = enumerate(node.links.connections())
                return [1, "", [[i, who, "o", "TCPROS", what, True] for i, (who, what) in pairs]]
            case "getSubscriptions", _:
                return [1, "", []]
            case "getBusStats", _:
                return [1, "", [[], [], []]]
            case (("publisherUpdate" | "paramUpdate"), *_):
                return [1, "", 0]
            case "shutdown", *said:
                node.leave(str(said[1]) if len(said) > 1 else "no reason given")
                return [1, "", 0]
        return [-1, f"{method}: not understood", 0]

    def _request(self, topic: str, protocols: list[Any]) -> list[Any]:
        if topic not in self._node.topics:
            return [-1, f"{topic} is not published by {self._node.name}", []]
        if not any(protocol and protocol[0] == "TCPROS" for protocol in protocols):
            return [0, "TCPROS only", []]
        return [1, "ready", ["TCPROS", self._node.host, self._node.links.port]]

    def handle_error(self, *_: object) -> None:
        """Take note of a caller that went away or talked nonsense, and no more."""
        _log.debug("a call failed", exc_info=True)

    def close(self) -> None:
        self.shutdown()
        self._thread.join(_TIMEOUT_S)
        self.server_close()


class _Transport(xmlrpc.client.Transport):
    """Transport with a timeout, for a roscore that does not answer."""

    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        master_s = 2.0
        connection = super().make_connection(host)
        connection.timeout = master_s
        return connection


def _master(uri: str) -> xmlrpc.client.ServerProxy:
    return xmlrpc.client.ServerProxy(uri, transport=_Transport())


def _answer(value: Any) -> tuple[int, str, Any]:
    """Return the three parts of roscore's answer.

    Raises `ValueError` if it is no such answer: something else listens at that port.
    """
    if not (isinstance(value, list) and len(value) == 3):
        raise ValueError("what answers there is not roscore")
    return value[0], value[1], value[2]


def master_host(uri: str) -> str:
    """Return the host in the address of roscore.

    Raises `OptionError` if it is no address.
    """
    parts = urlsplit(uri)
    try:
        sound = parts.scheme == "http" and bool(parts.hostname) and parts.port != 0
    except ValueError:
        sound = False
    if not sound:
        raise OptionError(f"ROS_MASTER_URI {uri!r}: write it as {DEFAULT_MASTER}")
    return str(parts.hostname)


def advertised_host(roscore: str, environment: Mapping[str, str]) -> str:
    """Return the name or number by which subscribers reach this machine.

    `ROS_HOSTNAME` or `ROS_IP`, as for every node; else the address that leads to roscore; else,
    with roscore on this machine, the one that leads out of it, so that others can listen too.
    """
    named = environment.get("ROS_HOSTNAME") or environment.get("ROS_IP")
    if named:
        return named
    own = _address_towards(roscore)
    if own is None or _is_loopback(own):
        own = _address_towards(_REMOTE_ADDRESS)
    return own or "127.0.0.1"


def _address_towards(host: str) -> str | None:
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect((host, 9))
            return str(probe.getsockname()[0])
    except OSError:
        return None


def _is_loopback(host: str) -> bool:
    return host == "localhost" or host.startswith("127.")


class Ros1Output(Output):
    """Publisher of ROS 1 topics, whether ROS is installed on this machine or not.

    Its node is `/aqualvs`; another of that name is ended by ROS. `environment`: for
    `ROS_MASTER_URI` (this machine where that is not set), `ROS_HOSTNAME` and `ROS_IP`. Raises
    `OptionError` if the address of roscore is none, or rosbags is not installed.
    """

    name = "ros1"

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        master = environment.get("ROS_MASTER_URI") or DEFAULT_MASTER
        self._store = ros1_store()
        self._maker = MessageMaker(RosOptions(), ros1_types(self._store))
        self._n_sent: Counter[PublishedTopic] = Counter()
        self._closed = False
        types = {topic.full_name: ros1_type(self._store, topic) for topic in PublishedTopic}
        self._node = Ros1Node("/aqualvs", types, master, environment)
        self.uri = self._node.uri  # Address of the node for calls by ROS.

    def send(self, sample: LiveSample) -> None:
        """Hand a sample's messages to the subscribers that are connected; returns at once."""
        listeners = self._node.links.listeners()
        wanted = {topic for topic in PublishedTopic if listeners[topic.full_name]}
        for topic, message in self._maker.messages(sample, wanted):
            message.header.seq = self._n_sent[topic] % 2**32
            body = self._store.serialize_ros1(message, TYPE_NAMES[topic])
            self._node.links.publish(topic.full_name, body)
            self._n_sent[topic] += 1

    def health(self) -> PartHealth:
        """Return how the link to roscore and the subscribers is."""
        links = self._node.links
        n = sum(links.listeners().values())
        text = f"{n or 'no'} subscriber{'s' * (n != 1)}"
        state = State.OK
        if self._closed:
            state, text = State.OFF, "closed"
        elif self._node.fault:
            state, text = State.WARN if n else State.FAULT, f"{self._node.fault}; {text}"
        return PartHealth(self.name, state, text, links.n_dropped)

    def close(self) -> None:
        """Say good-bye to roscore and the subscribers."""
        if not self._closed:
            self._closed = True
            self._node.close()


def ros1_store() -> "Typestore":
    """Return the messages of ROS 1.

    Raises `OptionError` if rosbags is not installed.
    """
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as fault:
        raise OptionError(
            "ROS 1 needs rosbags; install it with: pip install 'aqualvs[bags]'"
        ) from fault
    return get_typestore(Stores.ROS1_NOETIC)


def ros1_types(store: "Typestore") -> RosTypes:
    """Return the message classes; headers get the number of their message when it is sent."""
    header = functools.partial(store.types["std_msgs/msg/Header"], seq=0)
    return RosTypes(
        classes={**store.types, "std_msgs/msg/Header": header}, range_has_variance=False
    )


def ros1_type(store: "Typestore", topic: PublishedTopic) -> Ros1Type:
    """Return the type of a topic."""
    name = TYPE_NAMES[topic]
    definition, md5sum = store.generate_msgdef(name)
    return Ros1Type(name.replace("/msg/", "/"), md5sum, definition)
