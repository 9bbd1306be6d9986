"""What every source of frames offers."""

from collections.abc import Iterator
from types import TracebackType
from typing import Protocol, Self

from aqualvs.scanning.scan import Frame


class FrameSource(Protocol):
    """Frames in the order of their time; a context manager that can be iterated once.

    `Frame.index` rises strictly. A gap in it says that the frames in between existed but could
    not be decoded. A source that ends before its promise, or whose last frames are lost, delivers
    what it has and then raises `SourceError`.

    Attributes
    ----------
    name : str
        How messages call it: a path or an address.
    size_px : (int, int)
        Width and height, the same for every frame.
    fps : float or None
        Nominal frame rate; None where there is none.
    n_frames : int or None
        Frames that the container promises, perhaps estimated from its duration; None for a live
        stream.
    """

    @property
    def name(self) -> str:
        """How messages call it."""

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""

    @property
    def fps(self) -> float | None:
        """Nominal frame rate, if there is one."""

    @property
    def n_frames(self) -> int | None:
        """Promised frames, if known."""

    def __iter__(self) -> Iterator[Frame]: ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        fault: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...
