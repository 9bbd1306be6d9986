"""Handing frames from the thread that decodes to the one that measures, without adding delay."""

import threading
import time
from dataclasses import dataclass

from aqualvs.scanning.scan import Frame


@dataclass(frozen=True, slots=True)
class Arrival:
    """A frame and when it came.

    Attributes
    ----------
    frame : Frame
    arrived_ns : int
        By `time.monotonic_ns`.
    utc_ns : int
        By the system clock.
    """

    frame: Frame
    arrived_ns: int
    utc_ns: int


class Mailbox:
    """Room for one frame: the latest.

    Parameters
    ----------
    keep_every : bool
        Let the writer wait until its frame has been taken, instead of replacing one that has not.

    Attributes
    ----------
    n_dropped : int
        Frames that were replaced by a newer one before anybody took them.
    """

    def __init__(self, *, keep_every: bool = False) -> None:
        self.n_dropped = 0
        self._keep_every = keep_every
        self._changed = threading.Condition()
        self._waiting: Arrival | None = None
        self._closed = False

    def put(self, frame: Frame) -> None:
        """Leave a frame; after `close` it is thrown away."""
        arrival = Arrival(frame, time.monotonic_ns(), time.time_ns())
        with self._changed:
            if self._keep_every:
                self._changed.wait_for(lambda: self._waiting is None or self._closed)
            if self._closed:
                return
            self.n_dropped += self._waiting is not None
            self._waiting = arrival
            self._changed.notify_all()

    def take(self, timeout_s: float) -> Arrival | None:
        """Take the frame that is there, or wait for one; None if there is none in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting is not None or self._closed, timeout_s)
            arrival, self._waiting = self._waiting, None
            self._changed.notify_all()
        return arrival

    def close(self) -> None:
        """No more frames come; one that waits can still be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    @property
    def exhausted(self) -> bool:
        """Whether no frame waits and none will come."""
        with self._changed:
            return self._closed and self._waiting is None
