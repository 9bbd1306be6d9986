"""To ROS 1: posture, range, cloud and diagnostics as topics of a node."""

import os
import re
from collections import Counter
from collections.abc import Mapping

from aqualvs.errors import OptionError
from aqualvs.live.health import PartHealth, State
from aqualvs.live.outputs.ros1_messages import ROS1_TYPES, to_ros1
from aqualvs.live.outputs.ros1_node import DEFAULT_MASTER, Ros1Node
from aqualvs.live.outputs.ros_messages import MessageMaker, RosOptions, Topic
from aqualvs.live.sample import LiveSample

_NODE_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*")


class Ros1Output:
    """Publishes as a ROS 1 node, whether ROS is installed on this machine or not.

    Parameters
    ----------
    options : RosOptions, optional
        Defaults if left out.
    master_uri : str or None
        Where roscore is. None for `ROS_MASTER_URI`, this machine where that is not set.
    node_name : str
        A node of the same name is ended by ROS.
    environment : mapping
        For `ROS_MASTER_URI`, `ROS_HOSTNAME` and `ROS_IP`.

    Raises
    ------
    OptionError
        If the address of roscore or the node's name is none.
    """

    name = "ros1"
    inline = False
    keeps_all = False

    def __init__(
        self,
        options: RosOptions | None = None,
        *,
        master_uri: str | None = None,
        node_name: str = "aqualvs",
        environment: Mapping[str, str] = os.environ,
    ) -> None:
        if not _NODE_NAME.fullmatch(node_name):
            raise OptionError(f"ROS node {node_name!r}: use letters, digits and _")
        options = options or RosOptions()
        master = master_uri or environment.get("ROS_MASTER_URI") or DEFAULT_MASTER
        self._names = {topic: options.topic_name(topic) for topic in Topic}
        self._topics = {name: topic for topic, name in self._names.items()}
        self._maker = MessageMaker(options)
        self._n_sent: Counter[Topic] = Counter()
        self._closed = False
        types = {self._names[topic]: kind for topic, kind in ROS1_TYPES.items()}
        self._node = Ros1Node(f"/{node_name}", types, master, environment)

    @property
    def uri(self) -> str:
        """Where ROS calls the node."""
        return self._node.uri

    def send(self, sample: LiveSample) -> None:
        """Hand a sample's messages to the subscribers that are connected; returns at once."""
        wanted = {self._topics[name] for name in self._node.links.listeners()}
        for topic, message in self._maker.messages(sample, wanted):
            self._node.links.publish(self._names[topic], to_ros1(message, self._n_sent[topic]))
            self._n_sent[topic] += 1

    def health(self) -> PartHealth:
        """Return how the link to roscore and the subscribers is."""
        links = self._node.links
        n = sum(links.listeners().values())
        told = f"{n or 'no'} subscriber{'s' * (n != 1)}"
        state = State.OK
        if self._closed:
            state, told = State.OFF, "closed"
        elif self._node.trouble:
            state, told = State.WARN if n else State.FAULT, f"{self._node.trouble}; {told}"
        return PartHealth(self.name, state, told, links.n_dropped)

    def close(self) -> None:
        """Say good-bye to roscore and the subscribers."""
        if not self._closed:
            self._closed = True
            self._node.close()
