"""How messages pass between the process that writes and those that measure.

Points are laid down in memory that both see, and the pipe between them only tells of it: a pipe
holds less than the points of a few frames, so that both processes would be woken a dozen times for
a block of them.
"""

import ctypes
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from aqualvs.app.crew_messages import Message, packed, room_for, unpacked

if TYPE_CHECKING:
    from multiprocessing.context import ForkServerContext, SpawnContext

    Context: TypeAlias = ForkServerContext | SpawnContext

_N_SLOTS = 3
_SLOT_BYTES = 4 << 20
_TAKEN = -1
"""Said instead of a part's number: what was in a slot has been taken out of it."""


def shared_memory(context: "Context") -> Any:
    """Return memory for a process that measures, to be given to it when it begins."""
    return context.RawArray(ctypes.c_uint8, _N_SLOTS * _SLOT_BYTES)


class Sender:
    """The end of a process that measures.

    Parameters
    ----------
    pipe : Connection
    memory
        From `shared_memory`.

    Raises
    ------
    EOFError, OSError
        From both methods, once the other end has gone.
    """

    def __init__(self, pipe: Connection, memory: Any) -> None:
        self._pipe, self._slots = pipe, _slots(memory)
        self._next, self._n_free = 0, _N_SLOTS

    def next_part(self) -> int:
        """Wait for the number of a part."""
        while (number := int(self._pipe.recv())) == _TAKEN:
            self._n_free += 1
        return number

    def send(self, message: Message) -> None:
        """Send a message; waits while all slots are full."""
        n_bytes = room_for(message)
        if n_bytes == 0 or n_bytes > _SLOT_BYTES:
            own = np.empty(n_bytes, np.uint8)
            self._pipe.send((packed(message, own), own, n_bytes))
            return
        while self._n_free == 0:
            # Only who has none is given a part: this can but be `_TAKEN`.
            self._pipe.recv()
            self._n_free += 1
        parcel = packed(message, self._slots[self._next])
        self._pipe.send((parcel, self._next, n_bytes))
        self._next, self._n_free = (self._next + 1) % _N_SLOTS, self._n_free - 1


class Receiver:
    """The other end, of the process that writes; see `Sender`."""

    def __init__(self, pipe: Connection, memory: Any) -> None:
        self._pipe, self._slots = pipe, _slots(memory)

    def give_part(self, number: int) -> None:
        """Have a part measured; the one before must have ended."""
        self._pipe.send(number)

    def receive(self) -> Message:
        """Wait for a message."""
        parcel, place, n_bytes = self._pipe.recv()
        if not isinstance(place, int):
            return unpacked(parcel, place)
        points = self._slots[place, :n_bytes].copy()
        self._pipe.send(_TAKEN)
        return unpacked(parcel, points)


def _slots(memory: Any) -> NDArray[np.uint8]:
    return np.frombuffer(memory, np.uint8).reshape(_N_SLOTS, _SLOT_BYTES)
