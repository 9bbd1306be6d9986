"""How messages pass between the process that writes and those that measure.

Points are laid down in memory that both see, and the pipe between them only tells of it: a pipe
holds less than the points of a few frames, so that both processes would be woken a dozen times for
a block of them.
"""

import mmap
import os
from multiprocessing import reduction
from multiprocessing.connection import Connection
from typing import Any, Self

import numpy as np

from aqualvs.app.crew_messages import Message, packed, room_for, unpacked

_N_SLOTS = 3
_SLOT_BYTES = 4 << 20
_TAKEN = -1
"""Said instead of a part's number: what was in a slot has been taken out of it."""


class SharedMemory:
    """Memory that this process shares with one that it begins, to which it is given.

    It lies in no folder: none has to have room for it, and nothing is left behind.

    Parameters
    ----------
    file : int
        Descriptor of a file in memory; stays open until `seal`.

    Attributes
    ----------
    slots : uint8 array, shape (n_slots, n_bytes)

    Raises
    ------
    OSError
        If the memory is not to be had.
    """

    def __init__(self, file: int) -> None:
        self._file = file
        os.ftruncate(file, _N_SLOTS * _SLOT_BYTES)
        memory = mmap.mmap(file, _N_SLOTS * _SLOT_BYTES)
        self.slots = np.frombuffer(memory, np.uint8).reshape(_N_SLOTS, _SLOT_BYTES)

    @classmethod
    def new(cls) -> Self | None:
        """Return new memory; None where the system has none to share."""
        if not hasattr(os, "memfd_create"):
            return None
        try:
            file = os.memfd_create("aqualvs")
        except OSError:
            return None
        try:
            return cls(file)
        except OSError:
            os.close(file)
            return None

    def seal(self) -> None:
        """Give it to no further process."""
        os.close(self._file)

    def __reduce__(self) -> tuple[Any, ...]:
        """Give it to a process that is about to begin."""
        return _received, (reduction.DupFd(self._file),)


def _received(file: Any) -> SharedMemory:
    memory = SharedMemory(file.detach())
    memory.seal()
    return memory


class Sender:
    """The end of a process that measures.

    Parameters
    ----------
    pipe : Connection
    memory : SharedMemory or None
        Without it all goes through the pipe.

    Raises
    ------
    EOFError, OSError
        From both methods, once the other end has gone.
    """

    def __init__(self, pipe: Connection, memory: SharedMemory | None) -> None:
        self._pipe, self._memory = pipe, memory
        self._next, self._n_free = 0, _N_SLOTS

    def next_part(self) -> int:
        """Wait for the number of a part."""
        while (number := int(self._pipe.recv())) == _TAKEN:
            self._n_free += 1
        return number

    def send(self, message: Message) -> None:
        """Send a message; waits while all slots are full."""
        n_bytes = room_for(message)
        if self._memory is None or n_bytes == 0 or n_bytes > _SLOT_BYTES:
            own = np.empty(n_bytes, np.uint8)
            self._pipe.send((packed(message, own), own, n_bytes))
            return
        while self._n_free == 0:
            # Only who has none is given a part: this can but be `_TAKEN`.
            self._pipe.recv()
            self._n_free += 1
        parcel = packed(message, self._memory.slots[self._next])
        self._pipe.send((parcel, self._next, n_bytes))
        self._next, self._n_free = (self._next + 1) % _N_SLOTS, self._n_free - 1


class Receiver:
    """The other end, of the process that writes; see `Sender`."""

    def __init__(self, pipe: Connection, memory: SharedMemory | None) -> None:
        self._pipe, self._memory = pipe, memory

    def give_part(self, number: int) -> None:
        """Have a part measured; the one before must have ended."""
        self._pipe.send(number)

    def receive(self) -> Message:
        """Wait for a message."""
        parcel, place, n_bytes = self._pipe.recv()
        if self._memory is None or not isinstance(place, int):
            return unpacked(parcel, place)
        points = self._memory.slots[place, :n_bytes].copy()
        self._pipe.send(_TAKEN)
        return unpacked(parcel, points)
