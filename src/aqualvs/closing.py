"""Base class of context managers that close themselves."""

from types import TracebackType
from typing import Self


class Closing:
    """A context manager that closes itself; its classes say what there is to close."""

    def close(self) -> None:
        """Let go of what is held: nothing, unless a class says otherwise."""

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        fault: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close, however the statement ends."""
        self.close()
