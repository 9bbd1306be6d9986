"""What a live run needs of a source of frames."""

from collections.abc import Iterator
from typing import Protocol

from aqualvs.live.health import PartHealth
from aqualvs.scanning.scan import Frame


class Feed(Protocol):
    """Frames as they come, from a stream that may stall, change its size, go and return.

    Attributes
    ----------
    name : str
        How health and messages call it.
    """

    @property
    def name(self) -> str:
        """How health and messages call it."""

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames until the source ends (a file) or `close` is called (a stream).

        `Frame.index` rises strictly, `Frame.time_s` never falls, also over a reconnection; a gap
        in the index says that frames were lost. Frames may change their size.

        Raises
        ------
        SourceError
            If it can never work: no such file, no such camera. A stream that is merely not there
            is tried again.
        """

    def health(self) -> PartHealth:
        """Return how the source is; called from another thread."""

    def close(self) -> None:
        """End the iteration within a second; called from another thread."""
