"""Limits on connections and on wrong tokens."""

import asyncio
import heapq
from collections import Counter, OrderedDict
from itertools import count
from typing import ClassVar

from uvicorn.protocols.http.h11_impl import H11Protocol

from aqualvs.app.dashboard.access import Access

Peer = tuple[str, int]
"""Address and port of the other end."""


class ConnectionLimits:
    """Bound on the connections that wait for a page's greeting; used from one event loop alone.

    A connection over a limit replaces the oldest one of the address that holds the most. Strangers
    so replace each other, and a page that greets at once always finds room.
    """

    PER_ADDRESS: ClassVar[int] = 12
    """A browser opens up to six connections to load a page, and one to follow it."""
    IN_ALL: ClassVar[int] = 48
    SILENCE_S: ClassVar[float] = 10.0
    """Time to load a file, or to greet, in seconds; then the connection is closed."""

    def __init__(self) -> None:
        self._waiting: dict[Peer, asyncio.Transport] = {}

    def open(self, peer: Peer, transport: asyncio.Transport) -> None:
        """Note a new connection."""
        self._waiting = {key: one for key, one in self._waiting.items() if not one.is_closing()} | {
            peer: transport
        }
        asyncio.get_running_loop().call_later(self.SILENCE_S, self._time_out, peer, transport)
        held = Counter(address for address, _ in self._waiting)
        if held[peer[0]] > self.PER_ADDRESS:
            self._close_oldest(peer[0])
        elif len(self._waiting) > self.IN_ALL:
            self._close_oldest(held.most_common(1)[0][0])

    def holds(self, peer: Peer) -> bool:
        """Return whether a connection that waits for its greeting is still open."""
        transport = self._waiting.get(peer)
        return transport is not None and not transport.is_closing()

    def welcome(self, peer: Peer) -> None:
        """Note that a page has greeted: its connection may stay."""
        self._waiting.pop(peer, None)

    def _close_oldest(self, address: str) -> None:
        oldest = next(peer for peer in self._waiting if peer[0] == address)
        self._waiting.pop(oldest).abort()

    def _time_out(self, peer: Peer, transport: asyncio.Transport) -> None:
        if self._waiting.get(peer) is transport:
            self._waiting.pop(peer).abort()

    def protocol(self) -> type[asyncio.Protocol]:
        """Return the HTTP protocol for uvicorn that observes these limits."""
        limits = self

        class Limited(H11Protocol):
            def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
                super().connection_made(transport)
                if self.client is not None:
                    limits.open(self.client, transport)

        return Limited


class TokenGate:
    """Check of one token at a time: parallel connections guess no faster than one.

    Addresses that have shown the right token come first, then those with the fewest wrong ones, so
    that guesses do not keep the pilot waiting. Used from one event loop alone.

    Parameters
    ----------
    access : Access
    """

    WRONG_S: ClassVar[float] = 1.0
    """Time that a wrong token costs, in seconds."""
    MAX_ADDRESSES: ClassVar[int] = 1024
    """Addresses that are remembered."""

    def __init__(self, access: Access) -> None:
        self._access = access
        self._n_wrong: OrderedDict[str, int] = OrderedDict()
        self._busy = False
        self._queue: list[tuple[int, int, asyncio.Future[None]]] = []
        self._numbers = count()

    async def check(self, address: str, token: str) -> bool:
        """Return whether a token is right, when its turn has come."""
        await self._turn(address)
        right = self._access.may_command(token)
        self._remember(address, right)
        if right:
            self._next()
        else:
            # The next turn waits even if this caller is cancelled: hanging up saves no time.
            asyncio.get_running_loop().call_later(self.WRONG_S, self._next)
            await asyncio.sleep(self.WRONG_S)
        return right

    async def _turn(self, address: str) -> None:
        if not self._busy:
            self._busy = True
            return
        turn: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        rank = self._n_wrong.get(address, 0)
        heapq.heappush(self._queue, (rank, next(self._numbers), turn))
        try:
            await turn
        except asyncio.CancelledError:
            if turn.done() and not turn.cancelled():
                self._next()
            raise

    def _next(self) -> None:
        while self._queue:
            turn = heapq.heappop(self._queue)[2]
            if not turn.done():
                turn.set_result(None)
                return
        self._busy = False

    def _remember(self, address: str, right: bool) -> None:
        self._n_wrong[address] = -1 if right else max(0, self._n_wrong.get(address, 0)) + 1
        self._n_wrong.move_to_end(address)
        if len(self._n_wrong) > self.MAX_ADDRESSES:
            self._n_wrong.popitem(last=False)
