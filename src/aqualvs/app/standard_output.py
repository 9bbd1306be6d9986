"""Standard output and standard error, whose loss costs no result."""

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import Any, TextIO


class LenientStream:
    """A text stream that remembers a fault instead of raising it.

    Whoever reads the output may go before the end, as `head` does, and a terminal may be closed. A
    dive under way is measured to its end all the same.

    Parameters
    ----------
    stream : TextIO

    Attributes
    ----------
    fault : OSError or None
        Why nothing is written any more.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.fault: OSError | None = None

    def write(self, text: str) -> int:
        """Write a text, or drop it after a fault."""
        if self.fault is None:
            with self._noting():
                return self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Hand over what was written."""
        if self.fault is None:
            with self._noting():
                self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        """Return whatever else the stream has."""
        return getattr(self._stream, name)

    @contextlib.contextmanager
    def _noting(self) -> Iterator[None]:
        try:
            yield
        except OSError as fault:
            self.fault = fault


@contextlib.contextmanager
def lenient_output() -> Iterator[LenientStream | None]:
    """Make standard output and error lenient inside, and let them take every character.

    Yields
    ------
    output : LenientStream or None
        Standard output; None where it is closed.
    """
    before = sys.stdout, sys.stderr
    output = None if sys.stdout is None else _lenient(sys.stdout)
    errors = None if sys.stderr is None else _lenient(sys.stderr)
    sys.stdout, sys.stderr = output, errors
    try:
        yield output
    finally:
        for stream in (output, errors):
            if stream is not None:
                stream.flush()
        sys.stdout, sys.stderr = before


def drop_output() -> None:
    """Lead standard output nowhere, so that the interpreter's last flush does not fail."""
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


def _lenient(stream: TextIO) -> LenientStream:
    # A name that the terminal's encoding lacks is no reason to fail.
    reconfigure = getattr(stream, "reconfigure", None)
    if reconfigure is not None:
        reconfigure(errors="backslashreplace")
    return LenientStream(stream)
