"""The thread that moves frames from a feed to the mailbox."""

import logging
import threading
from typing import Self

from aqualvs.errors import AqualvsError
from aqualvs.live.health import PartHealth, State
from aqualvs.live.mailbox import Mailbox
from aqualvs.live.sources.feed import Feed

# A feed promises to end within a second of being closed.
_PATIENCE_S = 3.0
# After a fault that nobody foresaw the feed is begun again.
_AGAIN_S = 1.0
_log = logging.getLogger(__name__)


class FrameReader:
    """Reads a feed in a thread of its own; a context manager.

    Parameters
    ----------
    feed : Feed
    mailbox : Mailbox
        Closed when the feed ends.

    Attributes
    ----------
    n_lost : int
        Frames that the feed could not decode, by the gaps in their numbers.
    fault : AqualvsError or None
        What ended the feed, if it did not end by itself.
    """

    def __init__(self, feed: Feed, mailbox: Mailbox) -> None:
        self.n_lost = 0
        self.fault: AqualvsError | None = None
        self._feed, self._mailbox = feed, mailbox
        self._trouble = ""
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._read, name="frames", daemon=True)

    def health(self) -> PartHealth:
        """Return how the feed is."""
        if self.fault is not None:
            return PartHealth(self._feed.name, State.FAULT, str(self.fault))
        if self._trouble:
            return PartHealth(self._feed.name, State.FAULT, self._trouble)
        return self._feed.health()

    def __enter__(self) -> Self:
        """Begin to read."""
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """End the feed and the thread."""
        self._closing.set()
        self._feed.close()
        self._mailbox.close()
        self._thread.join(_PATIENCE_S)
        if self._thread.is_alive():
            _log.warning("%s: did not end in time", self._feed.name)

    def _read(self) -> None:
        try:
            while not self._closing.is_set():
                try:
                    return self._move()
                except AqualvsError as fault:
                    self.fault = fault
                    return None
                except Exception as fault:
                    # The thread must not die without a word: the pilot would see an old picture.
                    _log.exception("%s: reading failed; trying again", self._feed.name)
                    self._trouble = f"{type(fault).__name__}: {fault}"
                    self._closing.wait(_AGAIN_S)
        finally:
            self._mailbox.close()

    def _move(self) -> None:
        expected = None
        for frame in self._feed:
            if expected is not None:
                self.n_lost += max(0, frame.index - expected)
            expected = frame.index + 1
            self._trouble = ""
            self._mailbox.put(frame)
