"""Access to the pilot's page: rules for viewing and commanding, limits, and checked commands.

Messages of a page are checked by type and size (`MESSAGES`) and carried out (`Controls`).
`ConnectionLimits` bounds the connections that wait for a greeting; `TokenGate` checks one token at
a time.
"""

import asyncio
import contextlib
import heapq
import ipaddress
import math
import re
import secrets
import shutil
import time
from collections import Counter, OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal
from urllib.parse import urlsplit

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter
from uvicorn.protocols.http.h11_impl import H11Protocol

from aqualvs.control.vehicle import Setpoint, SetpointHolder
from aqualvs.errors import OptionError
from aqualvs.recording import RecorderSwitch
from aqualvs.sources.base import State

MAX_MESSAGE_BYTES = 2048
"""Longer messages close the connection."""


class _Message(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class Hello(_Message):
    """The first message of a page."""

    kind: Literal["hello"]
    token: Annotated[str, Field(max_length=200)] = ""


class PictureShown(_Message):
    """The page has shown a picture and can take the next."""

    kind: Literal["shown"]


class RecordCommand(_Message):
    """Begin or end a recording."""

    kind: Literal["record"]
    on: bool


class SetpointCommand(_Message):
    """Command that sets what to hold; without a range, the setpoint is taken back."""

    kind: Literal["setpoint"]
    range_m: float | None
    yaw_deg: float = 0.0


Message = Annotated[
    Hello | PictureShown | RecordCommand | SetpointCommand, Field(discriminator="kind")
]
Command = RecordCommand | SetpointCommand
MESSAGES: TypeAdapter[Message] = TypeAdapter(Message)
"""Parser of a page's messages."""


class RecordButton:
    """Record button of the page; without a switch the run can record nothing."""

    def __init__(self, switch: RecorderSwitch | None) -> None:
        self._switch = switch
        self._path: Path | None = None
        self._asked_s = -math.inf
        self._found: dict[str, Any] = {"on": False, "words": ""}

    def start(self) -> None:
        """Begin a recording; does nothing while one is under way."""
        if self._switch is None:
            raise OptionError("record: this run records nothing; start it with --record FOLDER")
        self._switch.start()

    def stop(self) -> None:
        """End it; does nothing where there is none."""
        if self._switch is not None:
            self._switch.stop()

    def to_dict(self) -> Mapping[str, Any]:
        """Return `on` (bool) and `words` (a file's name, or why it does not work).

        Also, as far as known, `seconds` of the recording, `free_bytes` of the disk and `left_s`.
        """
        disk_every_s = 1.0  # Between looks at the size of the recording and at the disk.
        if self._switch is None:
            return self._found
        now_s, path = time.monotonic(), self._switch.path
        if path is self._path and now_s - self._asked_s < disk_every_s:
            return self._found
        self._path, self._asked_s = path, now_s
        health = self._switch.health()
        words = health.detail if health.state is State.FAULT else path.name if path else ""
        self._found = {"on": path is not None, "words": words}
        if path is not None:
            # A disk that has been taken away is the recorder's fault to tell.
            with contextlib.suppress(OSError):
                free, seconds = shutil.disk_usage(path.parent).free, self._switch.seconds
                rate = path.stat().st_size / seconds if seconds > disk_every_s else 0.0
                left_s = free / rate if rate else None
                self._found |= {"seconds": seconds, "free_bytes": free, "left_s": left_s}
        return self._found


class Controls:
    """Controls of the page: setpoint and recorder."""

    def __init__(self, setpoint: SetpointHolder, recorder: RecordButton) -> None:
        self.setpoint, self.recorder = setpoint, recorder

    def carry_out(self, command: Command) -> None:
        """Carry out a command of a page that has the right to command.

        Raises `AqualvsError` if it cannot be done; nothing has changed then.
        """
        if isinstance(command, SetpointCommand):
            wanted = None
            if command.range_m is not None:
                wanted = Setpoint(command.range_m, math.radians(command.yaw_deg))
            self.setpoint.put(wanted)
        elif command.on:
            self.recorder.start()
        else:
            self.recorder.stop()


_HOST = re.compile(r"(?:\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9_.-]+)(?::([0-9]{1,5}))?", re.ASCII)
_SCHEME = re.compile(r"[a-z][a-z0-9+.-]*://", re.ASCII)
_LOCAL_NAMES = frozenset({"localhost", "127.0.0.1", "::1"})


@dataclass(frozen=True, slots=True)
class Access:
    """Access rules: this machine may watch; with the token, any client may watch and command."""

    host: str  # Address that the page is served at.
    token: str  # The password.
    # Origins whose pages may show this one inside themselves; none if empty.
    embedders: tuple[str, ...] = ()

    @property
    def is_local(self) -> bool:
        """Whether only this machine can reach the page."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    def may_command(self, token: str) -> bool:
        """Return whether this token gives the right to command."""
        return secrets.compare_digest(token.encode(), self.token.encode())

    def may_watch(self, token: str) -> bool:
        """Return whether this token gives the right to see the data."""
        return self.is_local or self.may_command(token)

    def is_own_page(self, origin: str | None, host: str) -> bool:
        """Return whether a connection comes from the page itself rather than from a foreign one.

        `origin`: the header that browsers send with the page's address; programs send none. `host`:
        the header with the address as the browser knows it. Served to this machine only, it must be
        a name of this machine: a foreign name that points here is an attack.
        """
        if self.is_local and urlsplit(f"//{host}").hostname not in _LOCAL_NAMES:
            return False
        return origin is None or urlsplit(origin).netloc == host


def are_addresses(hosts: Sequence[str], origins: Sequence[str]) -> bool:
    """Return whether the headers `Host` and `Origin` of a request are written as addresses are.

    `hosts`, `origins`: all values of these headers; a program may send none, and no client two.
    """
    if len(hosts) > 1 or len(origins) > 1:
        return False
    return all(map(_is_host, hosts)) and all(map(_is_origin, origins))


def _is_host(text: str) -> bool:
    """Return whether a text is a name or an IP address, with or without a port (RFC 9110, 7.2)."""
    max_port = 65535
    found = _HOST.fullmatch(text)
    if found is None or int(found[1] or 0) > max_port:
        return False
    try:
        # Brackets without an IPv6 address raise here.
        return urlsplit(f"//{text}").hostname is not None
    except ValueError:
        return False


def _is_origin(text: str) -> bool:
    """Return whether a text is an origin, as browsers write it (RFC 6454, 6.2)."""
    scheme = _SCHEME.match(text)
    return text == "null" or (scheme is not None and _is_host(text[scheme.end() :]))


def make_access(host: str, token: str | None, embedders: Sequence[str] = ()) -> Access:
    """Return the rules for an address; without a token a new one is made.

    Raises `OptionError` if a token is too short, or an embedder is no origin of web pages.
    """
    min_token = 8
    if token is not None and len(token) < min_token:
        raise OptionError(
            f"--token: {len(token)} characters; choose at least {min_token}, or leave it out"
        )
    for origin in embedders:
        # Anything else, such as a wildcard, would let strangers lay a page over the buttons.
        if not (origin.startswith(("http://", "https://")) and _is_origin(origin)):
            raise OptionError(
                f"--embed-from {origin}: not understood; write the address of the page without a "
                "path, such as http://blueos.local"
            )
    return Access(host, token or secrets.token_urlsafe(12), tuple(embedders))


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

    def release(self, peer: Peer) -> None:
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
        await self._await_turn(address)
        right = self._access.may_command(token)
        self._remember(address, right)
        if right:
            self._start_next()
        else:
            # The next turn waits even if this caller is cancelled: disconnecting saves no time.
            asyncio.get_running_loop().call_later(self.WRONG_S, self._start_next)
            await asyncio.sleep(self.WRONG_S)
        return right

    async def _await_turn(self, address: str) -> None:
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
                self._start_next()
            raise

    def _start_next(self) -> None:
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
