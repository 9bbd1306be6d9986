"""Pictures of a topic as the feed of a live run, and what `CameraInfo` says against the rig.

Nothing here needs rclpy: the node hands the messages over.
"""

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from aqualvs.optics.rig import Rig
from aqualvs.recording.sample import LiveSample
from aqualvs.scanning.scan import Frame
from aqualvs.sources.base import PartHealth, State
from aqualvs.sources.image_messages import image_of_ros, planes_of_message

StampOf = Callable[[int], int | None]
"""Takes the number of a frame, gives the time in its picture's header, or None."""

_REMEMBERED = 256
_INTRINSICS_SHARE = 0.01


class TopicFeed:
    """Frames of `sensor_msgs/Image` or `CompressedImage`, as they come.

    A picture that nobody took in time is replaced by the next one. Times are those of the headers;
    a header that goes back, as that of a bag which begins again does, counts as no time.

    Parameters
    ----------
    name : str
        Topic.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._changed = threading.Condition()
        self._waiting: tuple[int, Any] | None = None
        self._n_heard = self._n_replaced = self._n_lost = 0
        self._closed = False
        self._trouble = ""
        self._stamps: OrderedDict[int, int] = OrderedDict()
        self._first_ns: int | None = None
        self._time_s = 0.0

    def put(self, message: Any) -> None:
        """Take a message; called by the node's thread."""
        with self._changed:
            self._n_replaced += self._waiting is not None
            self._waiting = self._n_heard, message
            self._n_heard += 1
            self._changed.notify()

    def stamp_ns(self, index: int) -> int | None:
        """Return the time in the header of a recent frame; None if it has none."""
        return self._stamps.get(index) or None

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames until the feed is closed."""
        while (taken := self._next()) is not None:
            frame = self._frame(*taken)
            if frame is not None:
                yield frame

    def health(self) -> PartHealth:
        """Return whether pictures come and can be decoded."""
        if not self._n_heard:
            return PartHealth(self.name, State.WARN, "no picture yet")
        n = self._n_replaced
        if self._trouble:
            return PartHealth(self.name, State.FAULT, self._trouble, n)
        lost = f", {self._n_lost} not decoded" if self._n_lost else ""
        return PartHealth(self.name, State.OK, f"{self._n_heard} pictures{lost}", n)

    def close(self) -> None:
        """End the iteration."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def _next(self) -> tuple[int, Any] | None:
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._waiting is not None)
            taken, self._waiting = self._waiting, None
            return None if self._closed else taken

    def _frame(self, index: int, message: Any) -> Frame | None:
        image = image_of_ros(message)
        planes = planes_of_message(image)
        if planes is None:
            self._n_lost += 1
            self._trouble = f"pictures cannot be decoded (encoding {image.encoding!r})"
            return None
        self._trouble = ""
        self._stamps[index] = image.stamp_ns
        if len(self._stamps) > _REMEMBERED:
            self._stamps.popitem(last=False)
        if self._first_ns is None:
            self._first_ns = image.stamp_ns
        self._time_s = max(self._time_s, 1e-9 * (image.stamp_ns - self._first_ns))
        return Frame(index, self._time_s, *planes)


def stamped(sample: LiveSample, stamp_of: StampOf | None) -> LiveSample:
    """Return a sample with the time of its picture's header, where it has a picture and a time."""
    if stamp_of is None or sample.frame is None:
        return sample
    stamp_ns = stamp_of(sample.scan.index)
    return sample if stamp_ns is None else replace(sample, utc_ns=stamp_ns)


def camera_info_doubts(info: Any, rig: Rig) -> list[str]:
    """Return what in a `sensor_msgs/CameraInfo` speaks against the rig; the rig's numbers count.

    Parameters
    ----------
    info : object
        With the fields of the message; intrinsics that are all zero say that there are none.
    rig : Rig
    """
    doubts = []
    size = int(info.width), int(info.height)
    if all(size) and size != rig.size_px:
        have, need = (f"{width}x{height}" for width, height in (size, rig.size_px))
        doubts.append(f"pictures of {have} px, but the rig {rig.name!r} has {need} px")
    if max(int(info.binning_x), int(info.binning_y)) > 1:
        doubts.append("pictures are binned; the rig is that of whole pictures")
    if int(info.roi.width) or int(info.roi.height):
        doubts.append("pictures are cut out; the rig is that of whole pictures")
    k, lens = [float(value) for value in info.k], rig.lens
    if k[0] and not doubts:
        pairs = zip(("fx", "fy", "cx", "cy"), (k[0], k[4], k[2], k[5]), strict=True)
        for (name, theirs), ours in zip(pairs, (lens.fx, lens.fy, lens.cx, lens.cy), strict=True):
            if abs(theirs - ours) > _INTRINSICS_SHARE * lens.fx:
                doubts.append(f"{name} {theirs:.1f}, but the rig has {ours:.1f}")
    return doubts
