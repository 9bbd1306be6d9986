"""Senders on a MAVLink connection: identification of the vehicle, and message signing.

Anybody in the network may send to an open port. So `PeerTable` keeps senders apart by their
address: each has a parser of its own, and each system id belongs to the address where it was heard
first, until that address has been silent for a while. Nobody else can speak as the vehicle, or
receive its messages.

`Signer` signs messages by MAVLink 2 with pymavlink, and ignores senders without the key
(https://mavlink.io/en/guide/message_signing.html).
"""

import hashlib
import logging
import os
import re
import struct
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from aqualvs.errors import OptionError

_HEX_KEY = re.compile(r"[0-9A-Fa-f]{64}")
# Signatures count units of 10 us since 2015-01-01 00:00 UTC.
_EPOCH_S, _UNITS_PER_S = 1_420_070_400, 100_000
_READABLE_BY_OTHERS = 0o077
_log = logging.getLogger(__name__)


def load_key(path: Path) -> bytes:
    """Return the key of a file: 64 hexadecimal digits, or a passphrase.

    The key of a passphrase is its SHA-256, as in MAVProxy, Mission Planner and QGroundControl.

    Raises `OptionError` if there is no such file, or it holds neither.
    """
    longest_key = 1000
    try:
        if not path.is_file():
            raise FileNotFoundError(0, "no such file")
        with path.open("rb") as file:
            data = file.read(longest_key + 1)
        readable = os.name == "posix" and bool(path.stat().st_mode & _READABLE_BY_OTHERS)
        text = data.decode().strip()
    except OSError as fault:
        raise OptionError(f"MAVLink key {path}: cannot be read ({fault.strerror})") from None
    except UnicodeDecodeError:
        text = ""
    if not text or len(data) > longest_key or not text.isprintable():
        raise OptionError(
            f"MAVLink key {path}: write one line, a passphrase or 64 hexadecimal digits"
        )
    if readable:
        _log.warning("MAVLink key %s: others can read it; chmod 600 %s", path, path)
    return (
        bytes.fromhex(text) if _HEX_KEY.fullmatch(text) else hashlib.sha256(text.encode()).digest()
    )


class Signer:
    """Signer of what one connection sends; checks the signatures of what it receives.

    `dialect`: pymavlink's messages. `key`: 32 bytes.
    """

    def __init__(self, dialect: Any, key: bytes) -> None:
        self._outgoing, self._incoming = dialect.MAVLinkSigning(), dialect.MAVLinkSigning()
        for state in (self._outgoing, self._incoming):
            state.secret_key, state.timestamp = key, _now()
        self._outgoing.sign_outgoing = True
        # A callback that always returns False, so that pymavlink counts refused messages.
        self._incoming.allow_unsigned_callback = lambda *_: False

    @property
    def n_refused(self) -> int:
        """Messages that were not signed with the key, or were old."""
        return int(self._incoming.reject_count)

    def sign(self, packer: Any) -> None:
        """Let a packer sign."""
        packer.signing = self._outgoing

    def check(self, parser: Any) -> None:
        """Let a parser take signed messages only."""
        parser.signing = self._incoming
        is_signed = parser.check_signature

        def check_signature(frame: bytearray, system: int, component: int) -> bool:
            # pymavlink notes the time of a message before it looks at the signature: a forged one
            # from the future would lock the true sender out.
            stamps = self._incoming.stream_timestamps
            before = dict(stamps)
            if is_signed(frame, system, component):
                return True
            stamps.clear()
            stamps.update(before)
            return False

        parser.check_signature = check_signature

    def advance(self) -> None:
        """Bring the time of the next signature up to the clock, and to that of the others."""
        self._outgoing.timestamp = max(self._outgoing.timestamp, self._incoming.timestamp, _now())


def _now() -> int:
    return round(_UNITS_PER_S * (time.time() - _EPOCH_S))


Peer: TypeAlias = tuple[object, ...]
"""Address of a sender, as the system writes it; empty where a connection has only one."""

SILENT_AFTER_S = 5.0
"""A system id silent for this time counts as gone, and may be heard from another address."""

SAFETY_ARMED = 128
"""Flag of `MAV_MODE_FLAG` in the base mode of a heartbeat: the vehicle is armed."""

# Messages are sent to the vehicle and at most so many others, heard within so many seconds.
_HEARD_S, _MAX_OTHERS = 10.0, 8
# Lifetime of a statement about the vehicle's mode: two and a half heartbeats, and the delay of a
# busy machine.
_CLAIM_LIFETIME_S = 3.0
_MAX_CLAIMS = 32
_NO_AUTOPILOT = 8
_MAGIC = (0xFD, 0xFE)


class _Claim(NamedTuple):
    """Statement of a heartbeat about the vehicle."""

    component: int
    kind: int
    autopilot: int
    mode: int
    armed: bool


class PeerTable:
    """Table of the senders on a connection, kept apart by address.

    `make_parser`: returns a new parser of pymavlink. `errors`: those that a parser raises for bad
    data. `system`: system id of the vehicle.
    """

    def __init__(
        self, make_parser: Callable[[], Any], errors: tuple[type[Exception], ...], system: int
    ) -> None:
        self._make_parser, self._system = make_parser, system
        self._errors: tuple[type[Exception], ...] = (*errors, struct.error, IndexError, ValueError)
        # Threads that send ask for addresses while another takes messages in.
        self._lock = threading.Lock()
        # Addresses from which valid messages have come: their parser, and when they were heard.
        self._senders: dict[Peer, tuple[Any, float]] = {}
        # The address that each system id belongs to, and when it was heard there.
        self._homes: dict[int, tuple[Peer, float]] = {}
        # Recent statements of the vehicle's heartbeats: by component, when one was left, and those
        # of other addresses.
        self._claims: dict[int, _Claim] = {}
        self._left_s: dict[_Claim, float] = {}
        self._rivals: dict[Peer, tuple[_Claim, float]] = {}
        self._conflict, self._conflict_until_s = "", float("-inf")

    @property
    def vehicle(self) -> Peer | None:
        """Address of the vehicle; None before its first heartbeat."""
        with self._lock:
            return self._homes.get(self._system, (None, 0.0))[0]

    @property
    def conflict(self) -> str:
        """Contradiction between heartbeats of the vehicle; empty if there is none."""
        with self._lock:
            return self._conflict if time.monotonic() < self._conflict_until_s else ""

    @property
    def rival(self) -> str:
        """Other address that speaks as the vehicle; empty if there is none."""
        since_s = time.monotonic() - _CLAIM_LIFETIME_S
        with self._lock:
            vehicle = self._homes.get(self._system, (None, 0.0))[0]
            found = [peer for peer, (_, at_s) in self._rivals.items() if at_s > since_s]
        if vehicle is None or not found:
            return ""
        return f"{_shown(vehicle)} and {_shown(found[-1])} both speak as sysid {self._system}"

    def receivers(self) -> list[Peer]:
        """Return the addresses that were heard lately: the vehicle's, then the others'."""
        since_s = time.monotonic() - _HEARD_S
        vehicle = self.vehicle
        with self._lock:
            found = [peer for peer, (_, heard_s) in self._senders.items() if heard_s > since_s]
        return sorted(found, key=lambda peer: peer != vehicle)

    def restart(self) -> None:
        """Forget half messages and receivers, after the connection was made anew."""
        with self._lock:
            self._senders.clear()

    def decode(self, peer: Peer, data: bytes, *, whole: bool) -> list[Any]:
        """Return the valid messages that have come from an address.

        `whole`: whether it is a datagram: one that begins like a message begins one, and what was
        left of the one before belongs to none.
        """
        known = self._senders.get(peer)
        parser = self._make_parser() if known is None else known[0]
        if whole and data[:1] and data[0] in _MAGIC:
            _reset(parser)
        try:
            found = parser.parse_buffer(data) or []
        except self._errors:
            _reset(parser)
            return []
        invalid = ("BAD_DATA", "UNKNOWN")
        messages = [message for message in found if not message.get_type().startswith(invalid)]
        if messages or not whole:
            self._remember(peer, parser)
        return messages

    def admit(self, peer: Peer, message: Any) -> bool:
        """Return whether a message comes from where its system id belongs.

        The pilot's sticks count wherever they come from: they can only stop us.
        """
        system: int = message.get_srcSystem()
        kind = message.get_type()
        with self._lock:
            # Of the vehicle's parts, the autopilot alone says where it is.
            is_other = system != self._system
            if kind == "HEARTBEAT" and (is_other or message.autopilot != _NO_AUTOPILOT):
                self._bind(peer, system, message)
            home = self._homes.get(system)
        if kind == "MANUAL_CONTROL" and is_other:
            return True
        return is_other if home is None else home[0] == peer

    def _bind(self, peer: Peer, system: int, message: Any) -> None:
        now_s = time.monotonic()
        home, heard_s = self._homes.get(system, (peer, now_s))
        if home == peer or now_s - heard_s > SILENT_AFTER_S:
            home = peer
            self._homes[system] = peer, now_s
        if system == self._system:
            self._compare(peer, home, _claim(message), now_s)

    def _compare(self, peer: Peer, home: Peer, claim: _Claim, now_s: float) -> None:
        """Notice where heartbeats of the vehicle contradict each other."""
        if peer == home:
            self._rivals.pop(peer, None)
            before = self._claims.get(claim.component)
            self._claims[claim.component] = claim
            if before is not None and before != claim:
                # A mode that returns so soon was not left: two systems speak from one address.
                if now_s - self._left_s.pop(claim, float("-inf")) < _CLAIM_LIFETIME_S:
                    self._note_conflict(now_s, f"from {_shown(peer)}")
                _put_last(self._left_s, before, now_s)
        else:
            _put_last(self._rivals, peer, (claim, now_s))
        for rival, (said, at_s) in self._rivals.items():
            ours = self._claims.get(said.component)
            if now_s - at_s < _CLAIM_LIFETIME_S and ours is not None and said != ours:
                self._note_conflict(at_s, f"from {_shown(home)} and {_shown(rival)}")

    def _note_conflict(self, at_s: float, where: str) -> None:
        self._conflict_until_s = max(self._conflict_until_s, at_s + _CLAIM_LIFETIME_S)
        self._conflict = f"heartbeats of sysid {self._system} {where} contradict each other"

    def _remember(self, peer: Peer, parser: Any) -> None:
        """Store the parser of an address, and send to it; strangers never replace known senders."""
        now_s = time.monotonic()
        if peer in self._senders:
            self._senders[peer] = parser, now_s
            return
        vehicle = self.vehicle
        with self._lock:
            for other in [p for p, (_, s) in self._senders.items() if now_s - s > _HEARD_S]:
                del self._senders[other]
            others = len(self._senders) - (vehicle in self._senders)
            if peer == vehicle or others < _MAX_OTHERS:
                self._senders[peer] = parser, now_s


def _reset(parser: Any) -> None:
    """Let a parser begin a new message."""
    # The parser computes the length of a message again as soon as it has three bytes.
    parser.buf, parser.buf_index = bytearray(), 0


def _claim(message: Any) -> _Claim:
    return _Claim(
        message.get_srcComponent(),
        message.type,
        message.autopilot,
        message.custom_mode,
        bool(message.base_mode & SAFETY_ARMED),
    )


def _put_last(kept: dict[Any, Any], key: object, value: object) -> None:
    """Put a value last into a dictionary that stays small."""
    kept.pop(key, None)
    kept[key] = value
    if len(kept) > _MAX_CLAIMS:
        del kept[next(iter(kept))]


def _shown(peer: Peer) -> str:
    return f"{peer[0]}:{peer[1]}" if len(peer) > 1 else "one connection"
