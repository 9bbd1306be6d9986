"""ROS 2's encoding of messages (CDR, little endian) as far as our messages need it.

Primitives lie at multiples of their size, counted from the end of the four bytes that every message
begins with. A sequence is its length as uint32, then its elements; an empty one has no gap after
its length.
"""

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

_HEAD = b"\x00\x01\x00\x00"
_NS = 1_000_000_000


class CdrWriter:
    """Puts values together, in the order of the message's fields."""

    def __init__(self) -> None:
        self._content = bytearray(_HEAD)

    def numbers(self, kind: str, *values: float) -> None:
        """Append numbers of one kind (of `struct`), such as the fields of a fixed array."""
        size = struct.calcsize("=" + kind)
        self._align(size)
        self._content += struct.pack(f"<{len(values)}{kind}", *values)

    def text(self, words: str) -> None:
        """Append a string."""
        content = words.encode("utf-8") + b"\0"
        self.numbers("I", len(content))
        self._content += content

    def array(self, values: NDArray[Any]) -> None:
        """Append a sequence of numbers, as the array holds them."""
        self.numbers("I", values.size)
        if values.size:
            self._align(values.itemsize)
            kind = values.dtype.newbyteorder("<")
            self._content += np.ascontiguousarray(values, kind).view(np.uint8).data

    def blob(self, content: bytes) -> None:
        """Append a sequence of bytes."""
        self.numbers("I", len(content))
        self._content += content

    def header(self, stamp_ns: int, frame_id: str) -> None:
        """Append a `std_msgs/Header`."""
        self.numbers("i", stamp_ns // _NS)
        self.numbers("I", stamp_ns % _NS)
        self.text(frame_id)

    def finish(self) -> bytes:
        """Return the message."""
        return bytes(self._content)

    def _align(self, size: int) -> None:
        self._content += bytes(-(len(self._content) - len(_HEAD)) % size)


class CdrReader:
    """Takes a message apart, in the order of its fields.

    Parameters
    ----------
    content : bytes

    Raises
    ------
    ValueError
        From every method, if the message is cut short or not little-endian CDR.
    """

    def __init__(self, content: bytes) -> None:
        if content[: len(_HEAD)] != _HEAD:
            raise ValueError("not little-endian CDR")
        self._content, self._at = content, len(_HEAD)

    def number(self, kind: str) -> Any:
        """Take one number of a kind (of `struct`)."""
        return self.numbers(kind, 1)[0]

    def numbers(self, kind: str, n: int) -> tuple[Any, ...]:
        """Take numbers of one kind."""
        size = struct.calcsize("=" + kind)
        self._align(size)
        return struct.unpack(f"<{n}{kind}", self._take(n * size))

    def text(self) -> str:
        """Take a string."""
        return self._take(self.number("I"))[:-1].decode("utf-8")

    def array(self, kind: str) -> NDArray[Any]:
        """Take a sequence of numbers of a NumPy kind; a copy."""
        n, dtype = self.number("I"), np.dtype(kind).newbyteorder("<")
        if n:
            self._align(dtype.itemsize)
        found = np.frombuffer(self._take(n * dtype.itemsize), dtype)
        return found.astype(np.dtype(kind))

    def blob(self) -> bytes:
        """Take a sequence of bytes."""
        return self._take(self.number("I"))

    def header(self) -> tuple[int, str]:
        """Take a `std_msgs/Header`: nanoseconds and the frame's name."""
        seconds, nanoseconds = self.number("i"), self.number("I")
        return seconds * _NS + nanoseconds, self.text()

    def _align(self, size: int) -> None:
        self._at += -(self._at - len(_HEAD)) % size

    def _take(self, n: int) -> bytes:
        end = self._at + n
        if end > len(self._content):
            raise ValueError(f"cut short: {len(self._content)} of {end} bytes")
        found = self._content[self._at : end]
        self._at = end
        return found
