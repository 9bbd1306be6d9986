"""Base class of context managers that close themselves."""

from typing import Self


class Closing:
    """A context manager that calls `close` at its end; subclasses override `close`."""

    def close(self) -> None:
        """Release resources; does nothing by default."""

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close, however the statement ends."""
        self.close()
