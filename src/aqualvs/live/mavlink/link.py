"""A persistent MAVLink connection, shared by everything that talks to the autopilot."""

import contextlib
import importlib
import selectors
import threading
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from aqualvs.errors import OptionError
from aqualvs.live.mavlink.peers import SILENT_AFTER_S, Peer, PeerTable, Signer
from aqualvs.live.mavlink.ports import (
    Address,
    AllowedPeers,
    Port,
    SerialAddress,
    check_address,
    open_port,
    parse_address,
    why,
)
from aqualvs.sources.base import PartHealth, State

MAV_COMP_ID_ONBOARD_COMPUTER = 191
HEARTBEAT_EVERY_S = 1.0

_LOOK_EVERY_S = 0.1
_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.25, 4.0
# A peer that was heard and falls silent may have moved to another address.
_REOPEN_AFTER_S = 10.0
_REFUSED_FOR_S = 3.0
# Greatest delay of a message by data in the serial driver's buffer; beyond it, it is dropped.
_TIMEOUT_S, _URGENT_TIMEOUT_S = 0.02, 0.1
_ARDUPILOT, _NO_AUTOPILOT = 3, 8
_AUTOPILOT_COMPONENT = 1
# ArduPilot queues 20 requests at most (GCS_Param.cpp), and a lost datagram loses some.
_ASKED_AT_ONCE, _ASK_AGAIN_S, _ANSWER_POLL_S = 10, 0.3, 0.01
_ARDUPILOT_NAMES = {1: "ArduPlane", 2: "ArduCopter", 10: "ArduRover", 11: "ArduBoat", 12: "ArduSub"}
_AUTOPILOT_NAMES = {_ARDUPILOT: "ArduPilot", 12: "PX4"}


@dataclass(frozen=True, slots=True)
class Received:
    """A message that came in."""

    message: Any  # As pymavlink decodes it.
    received_ns: int  # By `time.monotonic_ns`.
    # Who sent it.
    system: int
    component: int

    @property
    def age_s(self) -> float:
        """Seconds since it came."""
        return 1e-9 * (time.monotonic_ns() - self.received_ns)


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkOptions:
    """Own identity on a connection, and the peers that are heard."""

    # Own ids, 1 to 255; the system is that of the vehicle, whose part this computer is.
    system: int = 1
    component: int = MAV_COMP_ID_ONBOARD_COMPUTER
    # Where a port listens, the only addresses that are heard, as `AllowedPeers` takes them;
    # everybody if empty. Other connections hear one peer only.
    peers: tuple[str, ...] = ()
    # Of MAVLink 2 signing, see `load_key`: what is sent is signed, and what is not signed with it
    # is not heard. None: nothing is signed, and nothing checked.
    key: bytes | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        """Check every value.

        Raises `OptionError` if one makes no sense.
        """
        for name, value in (("system", self.system), ("component", self.component)):
            if not 1 <= value <= 255:
                raise OptionError(f"MAVLink {name} id {value}: must lie between 1 and 255")
        AllowedPeers(self.peers)


class MavlinkLink:
    """MAVLink 2 connection of an onboard computer.

    The constructor returns at once. A thread opens the connection, sends a heartbeat every second,
    takes in what comes, and opens the connection again whenever it breaks, a little later each time
    up to four seconds. `send` never waits and never raises for the state of the connection.

    A system id belongs to the address where it was heard first, until it has been silent there for
    five seconds; what others send in its name is left out (see `PeerTable`).

    `address`: from `parse_address`, or as it takes it. Raises `OptionError` if the address makes no
    sense, or pymavlink is not installed.
    """

    def __init__(self, address: Address | str, options: LinkOptions | None = None) -> None:
        options = options or LinkOptions()
        self._address = parse_address(address) if isinstance(address, str) else address
        self.url = self._address.url
        self.system = system = options.system  # Of the vehicle, and our own.
        self._autopilot_ids = (system, _AUTOPILOT_COMPONENT)
        # Messages and constants of ardupilotmega, which holds all common ones.
        self.dialect: Any = _dialect()
        check_address(self._address)
        self._signer = None if options.key is None else Signer(self.dialect, options.key)
        self._packer = self.make_packer(system, options.component)
        self._heartbeat = self.dialect.MAVLink_heartbeat_message(
            self.dialect.MAV_TYPE_ONBOARD_CONTROLLER,
            self.dialect.MAV_AUTOPILOT_INVALID,
            0,
            0,
            self.dialect.MAV_STATE_ACTIVE,
            3,
        )
        # Guards the port and the packer; held only for calls that never wait.
        self._sending = threading.Lock()
        self._port: Port | None = None
        self._broken: OSError | None = None
        self._fault = "not open yet"
        self._n_unsent = 0
        self._receiving = threading.Lock()
        self._queue: dict[str, dict[tuple[int, int, Peer], Received]] = {}
        self._parameters: dict[str, float] = {}
        self._n_received: Counter[str] = Counter()
        self._closing = threading.Event()
        self._allowed, self._n_foreign, self._foreign = AllowedPeers(options.peers), 0, ""
        self._peers = PeerTable(self._make_parser, (self.dialect.MAVError,), system)
        self._thread = threading.Thread(target=self._run, name=f"mavlink {self.url}", daemon=True)
        self._thread.start()

    def make_packer(self, system: int, component: int) -> Any:
        """Return a packer of pymavlink for another sender's name on this connection."""
        packer = self.dialect.MAVLink(None, system, component)
        if self._signer is not None:
            self._signer.sign(packer)
        return packer

    def send(
        self, *messages: Any, urgent: bool = False, to_vehicle: bool = False, packer: Any = None
    ) -> bool:
        """Send messages together, in one datagram where there are datagrams; never waits.

        `messages`: pymavlink's message objects, made from `dialect`; may be changed and sent again.
        `urgent`: on a serial line, may be delayed a little where others are dropped. `to_vehicle`:
        to the vehicle alone, also where others are heard. `packer`: from `make_packer`, to send in
        another name than the own.

        Returns False if there is no connection, nobody to send to, or no room; they are dropped
        then. Raises `struct.error` if a field does not fit into its type.
        """
        timeout_s = _URGENT_TIMEOUT_S if urgent else _TIMEOUT_S
        with self._sending:
            sent = self._send(messages, timeout_s, to_vehicle, packer or self._packer)
            self._n_unsent += not sent
        return sent

    def latest(
        self, kind: str, *, system: int | None = None, component: int | None = None
    ) -> Received | None:
        """Return the last message of a kind (such as `ATTITUDE`), None if none has come.

        `system`, `component`: only from these; from any if None.
        """
        return _newest(
            entry
            for entry in self.every(kind)
            if system in (None, entry.system) and component in (None, entry.component)
        )

    def every(self, kind: str) -> list[Received]:
        """Return the last message of a kind of each sender."""
        with self._receiving:
            return list(self._queue.get(kind, {}).values())

    @property
    def conflict(self) -> str:
        """Contradiction between heartbeats of the vehicle; empty if there is none."""
        return self._peers.conflict

    @property
    def rival(self) -> str:
        """Other address that speaks as the vehicle; empty if there is none."""
        return self._peers.rival

    def read_parameters(self, names: Iterable[str], *, timeout_s: float = 3.0) -> dict[str, float]:
        """Ask the autopilot for parameters and wait for the answers.

        `names`: as ArduPilot calls them, such as `RC4_DZ`. The result is in the autopilot's units;
        parameters that it does not have, or did not answer in time, are left out.
        """
        wanted = list(dict.fromkeys(names))
        with self._receiving:
            for name in wanted:
                self._parameters.pop(name, None)
        end_s = time.monotonic() + timeout_s
        missing = wanted
        while missing and time.monotonic() < end_s and not self._closing.is_set():
            asked = missing[:_ASKED_AT_ONCE]
            self.ask_parameters(asked)
            again_s = min(time.monotonic() + _ASK_AGAIN_S, end_s)
            while time.monotonic() < again_s and not all(map(self._parameters.__contains__, asked)):
                time.sleep(_ANSWER_POLL_S)
            # Unanswered parameters go to the end, so that the others are requested.
            rotated = [*missing[_ASKED_AT_ONCE:], *asked]
            missing = [name for name in rotated if name not in self._parameters]
        known = self.parameters()
        return {name: known[name] for name in wanted if name in known}

    def ask_parameters(self, names: Iterable[str]) -> None:
        """Ask the autopilot for parameters, ten at once at most; returns at once."""
        request = self.dialect.MAVLink_param_request_read_message
        for name in names:
            asked = request(self.system, _AUTOPILOT_COMPONENT, name.encode("ascii"), -1)
            self.send(asked, to_vehicle=True)

    def parameters(self) -> dict[str, float]:
        """Return the parameters that the autopilot has sent, also for other requesters."""
        with self._receiving:
            return dict(self._parameters)

    def n_received(self, kind: str) -> int:
        """Return how many messages of a kind have come from the vehicle's autopilot."""
        with self._receiving:
            return self._n_received[kind]

    def autopilot(self) -> Received | None:
        """Return the last heartbeat of the own vehicle's autopilot, None if none has come."""
        return _newest(beat for beat in self._autopilots() if beat.system == self.system)

    def health(self) -> PartHealth:
        """Return how the connection is."""
        state, detail = self._state()
        return PartHealth(f"mavlink {self.url}", state, detail, self._n_unsent)

    def close(self) -> None:
        """End the thread and free the port; further calls do nothing."""
        self._closing.set()
        if self._thread is not threading.current_thread():
            self._thread.join(2.0)

    def _state(self) -> tuple[State, str]:
        port = self._port
        if self._closing.is_set():
            return State.OFF, "closed"
        if port is None:
            return State.FAULT, self._fault
        refused_s = port.refused_s
        beat = self.autopilot()
        age_s = beat.age_s if beat else float("inf")
        if refused_s is not None and time.monotonic() - refused_s < min(_REFUSED_FOR_S, age_s):
            return State.FAULT, f"nobody listens at {self._address}"
        if beat is None:
            return State.WARN, self._waiting_for()
        if age_s > SILENT_AFTER_S:
            return State.WARN, f"no heartbeat for {age_s:.0f} s"
        if doubt := self._peers.conflict or self._peers.rival:
            return State.WARN, doubt
        return State.OK, f"autopilot {_name(beat)} seen {age_s:.1f} s ago"

    def _waiting_for(self) -> str:
        others = [beat for beat in self._autopilots() if beat.age_s < SILENT_AFTER_S]
        if others:
            return f"no heartbeat of sysid {self.system}, but of {_name(others[-1])}"
        text = f"no heartbeat of sysid {self.system} yet"
        if self._signer is not None and self._signer.n_refused:
            text += f"; {self._signer.n_refused} messages are not signed with our key, or are old"
        if self._n_foreign:
            text += f"; {self._foreign} is not an allowed peer"
        return text

    def _autopilots(self) -> list[Received]:
        beats = self.every("HEARTBEAT")
        return [beat for beat in beats if beat.message.autopilot != _NO_AUTOPILOT]

    def _send(
        self, messages: tuple[Any, ...], timeout_s: float, to_vehicle: bool, packer: Any
    ) -> bool:
        port = self._port
        if port is None or self._broken is not None:
            return False
        try:
            vehicle = self._peers.vehicle if port.many else ()
            if port.lag_s > timeout_s or (to_vehicle and vehicle is None):
                return False
            if self._signer is not None:
                self._signer.advance()
            frames = b"".join([packed(message, packer) for message in messages])
            if to_vehicle and vehicle is not None:
                return port.write(frames, vehicle)
            return port.write_all(frames, self._peers.receivers())
        except OSError as fault:
            self._broken = fault
            return False

    def _run(self) -> None:
        # After a connection that lasted this long, the next attempt follows quickly again.
        lasting_s = 2.0
        wait_s = _FIRST_WAIT_S
        while not self._closing.is_set():
            began_s = time.monotonic()
            try:
                self._serve(open_port(self._address))
            except (OSError, ValueError) as fault:
                # A name that cannot be one is a ValueError.
                if time.monotonic() - began_s > lasting_s:
                    wait_s = _FIRST_WAIT_S
                again = f"tried again every {wait_s:.2g} s"
                self._fault = f"{self._address}: {why(fault)}; {again}"
                self._closing.wait(wait_s)
                wait_s = min(2 * wait_s, _LONGEST_WAIT_S)

    def _serve(self, port: Port) -> None:
        """Use an open port until it breaks or `close` is called."""
        with contextlib.closing(port), selectors.DefaultSelector() as selector:
            selector.register(port, selectors.EVENT_READ)
            self._peers.restart()
            with self._sending:
                self._port, self._broken = port, None
            try:
                self._pump(port, selector)
            finally:
                with self._sending:
                    self._port = None

    def _pump(self, port: Port, selector: selectors.BaseSelector) -> None:
        opened_s = beat_s = time.monotonic()
        while not self._closing.is_set():
            now_s = time.monotonic()
            if now_s >= beat_s:
                beat_s = now_s + HEARTBEAT_EVERY_S
                with self._sending:
                    self._send((self._heartbeat,), _URGENT_TIMEOUT_S, False, self._packer)
            events = selectors.EVENT_READ | (selectors.EVENT_WRITE if port.unsent else 0)
            selector.modify(port, events)
            for _, ready in selector.select(min(_LOOK_EVERY_S, max(0.0, beat_s - now_s))):
                if ready & selectors.EVENT_READ:
                    self._read(port)
            with self._sending:
                port.flush()
                if self._broken is not None:
                    raise self._broken
            self._check_silence(opened_s)

    def _check_silence(self, opened_s: float) -> None:
        """Raise if the peer was heard once and has been silent long, to look it up anew."""
        beat, address = self.autopilot(), self._address
        if beat is None or isinstance(address, SerialAddress) or address.kind == "udpin":
            return
        if min(beat.age_s, time.monotonic() - opened_s) > _REOPEN_AFTER_S:
            raise TimeoutError(0, f"no heartbeat for {beat.age_s:.0f} s")

    def _make_parser(self) -> Any:
        parser = self.dialect.MAVLink(None)
        parser.robust_parsing = True
        if self._signer is not None:
            self._signer.check(parser)
        return parser

    def _read(self, port: Port) -> None:
        """Read incoming data, but not for so long that sending has to wait."""
        read_at_once = 64  # Datagrams received before sending is checked again.
        for _ in range(read_at_once):
            data, peer = port.read()
            if not data:
                return
            if peer not in self._allowed:
                self._n_foreign, self._foreign = self._n_foreign + 1, str(peer[0])
                continue
            for message in self._peers.decode(peer, data, whole=port.whole):
                if self._peers.admit(peer, message):
                    self._keep(peer, message)

    def _keep(self, peer: Peer, message: Any) -> None:
        """Store a message as the latest of its kind and sender."""
        # Number of senders, besides the vehicle, whose latest message of each kind is kept.
        max_senders = 64
        kind, received_ns = message.get_type(), time.monotonic_ns()
        sender = (message.get_srcSystem(), message.get_srcComponent())
        with self._receiving:
            latest = self._queue.setdefault(kind, {})
            latest.pop((*sender, peer), None)
            latest[*sender, peer] = Received(message, received_ns, *sender)
            if len(latest) > max_senders:
                others = [key for key in latest if key[0] != self.system]
                del latest[(others or list(latest))[0]]
            self._n_received[kind] += sender == self._autopilot_ids
            if kind == "PARAM_VALUE" and sender == self._autopilot_ids:
                # ArduPilot casts integers to float; it does not copy their bits.
                self._parameters[message.param_id] = float(message.param_value)


def _newest(entries: Iterable[Received]) -> Received | None:
    return max(entries, key=lambda entry: entry.received_ns, default=None)


def packed(message: Any, packer: Any) -> bytes:
    """Return the frame of a message, numbered by its packer."""
    frame: bytes = message.pack(packer)
    packer.seq = (packer.seq + 1) % 256
    return frame


def _dialect() -> Any:
    """Import pymavlink's messages in version 2, regardless of the environment."""
    try:
        return importlib.import_module("pymavlink.dialects.v20.ardupilotmega")
    except ImportError as fault:
        raise OptionError("MAVLink needs pymavlink: pip install 'aqualvs[mavlink]'") from fault


def _name(beat: Received) -> str:
    kind, autopilot = beat.message.type, beat.message.autopilot
    name = _AUTOPILOT_NAMES.get(autopilot, f"of type {autopilot}")
    if autopilot == _ARDUPILOT:
        name = _ARDUPILOT_NAMES.get(kind, name)
    return f"sysid {beat.system} {name}"
