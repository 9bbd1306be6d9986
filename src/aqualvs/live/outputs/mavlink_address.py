"""Where a MAVLink peer is, as pilots write it."""

import ipaddress
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

from aqualvs.errors import OptionError

DEFAULT_BAUD = 115_200
_FORMS = (
    "write udpout:HOST:PORT, udpin:HOST:PORT, udpbcast:HOST:PORT, tcp:HOST:PORT "
    "or /dev/ttyACM0,115200"
)
_NET_KINDS: dict[str, "NetKind"] = {
    "udpout": "udpout",
    "udpin": "udpin",
    "udp": "udpin",
    "udpbcast": "udpbcast",
    "tcp": "tcp",
    "udpclient": "udpout",
    "udpserver": "udpin",
    "tcpclient": "tcp",
}

NetKind: TypeAlias = Literal["udpout", "udpin", "udpbcast", "tcp"]


@dataclass(frozen=True, slots=True)
class NetAddress:
    """A peer in the network, or the port that peers send to.

    Attributes
    ----------
    kind : str
        `udpout` sends to the address; `udpin` listens there and answers whoever was heard;
        `udpbcast` sends to a broadcast address; `tcp` connects.
    host : str
        Name or number.
    port : int
        1 to 65535; 0, any free one, for `udpin`.
    """

    kind: NetKind
    host: str
    port: int

    def __str__(self) -> str:
        """Return the address as messages show it."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{host}:{self.port}"


@dataclass(frozen=True, slots=True)
class SerialAddress:
    """A serial device and its speed in baud."""

    device: str
    baud: int

    def __str__(self) -> str:
        """Return the device as messages show it."""
        return self.device


Address: TypeAlias = NetAddress | SerialAddress


def parse_address(url: str) -> Address:
    """Read a connection in the forms that pymavlink, MAVProxy and ground stations use.

    Parameters
    ----------
    url : str
        `udpout:HOST:PORT`, `udpin:HOST:PORT`, `udp:HOST:PORT` (the same as `udpin`, as in
        pymavlink), `udpbcast:HOST:PORT`, `tcp:HOST:PORT`; two slashes after the colon are allowed,
        and `udpclient`, `udpserver` and `tcpclient`, as BlueOS calls them.
        An empty host to listen at means every address of this computer.
        `/dev/ttyACM0`, `/dev/ttyACM0,57600`, `serial:/dev/ttyACM0:57600`; 115200 baud if left out.

    Raises
    ------
    OptionError
        If it is none of these.
    """
    scheme, colon, rest = url.partition(":")
    kind = _NET_KINDS.get(scheme.lower()) if colon else None
    if kind is not None:
        return _net_address(kind, rest.removeprefix("//"), url)
    if scheme.lower() == "serial" and colon:
        device = rest.removeprefix("//") if rest.startswith("///") else rest
        return _serial_address(device, url)
    if url.startswith("/dev/") or re.match(r"COM\d+\b", url):
        return _serial_address(url, url)
    raise OptionError(f"MAVLink connection {url!r}: not understood; {_FORMS}")


class AllowedPeers:
    """Addresses that are listened to.

    Parameters
    ----------
    rules : sequence of str
        Each `ADDRESS`, `ADDRESS:PORT` or `NETWORK/BITS`, in numbers; everybody if there is none.

    Raises
    ------
    OptionError
        If one is none of these.
    """

    def __init__(self, rules: Sequence[str] = ()) -> None:
        self._rules = [_peer_rule(text) for text in rules]

    def __contains__(self, peer: Sequence[object]) -> bool:
        """Return whether an address, as the system writes it, may speak."""
        if not self._rules or not peer:
            return True
        address = ipaddress.ip_address(str(peer[0]).partition("%")[0])
        return any(address in network and port in (None, peer[1]) for network, port in self._rules)


def _peer_rule(text: str) -> tuple[ipaddress.IPv4Network | ipaddress.IPv6Network, int | None]:
    host, port = parse_host_port(text) or (text, None)
    try:
        return ipaddress.ip_network(host, strict=False), port
    except ValueError:
        raise OptionError(
            f"MAVLink peer {text!r}: not understood; write numbers, such as 192.168.2.2, "
            "192.168.2.2:14550 or 192.168.2.0/24"
        ) from None


def parse_host_port(text: str) -> tuple[str, int] | None:
    """Return host and port of `HOST:PORT` or `[IPV6]:PORT`, None if it is neither."""
    match = re.fullmatch(r"(?:\[([0-9A-Fa-f:.%\w]+)\]|([^:\s\[\]/]*)):(\d{1,5})", text)
    if match is None or int(match[3]) > 65535:
        return None
    return match[1] or match[2], int(match[3])


def _net_address(kind: NetKind, rest: str, url: str) -> NetAddress:
    found = parse_host_port(rest)
    if found is None:
        raise OptionError(f"MAVLink connection {url!r}: no HOST:PORT after the scheme; {_FORMS}")
    host, port = found
    listens = kind == "udpin"
    if not listens and (not host or not port):
        raise OptionError(f"MAVLink connection {url!r}: whom to send to is missing; {_FORMS}")
    return NetAddress(kind, host or "0.0.0.0", port)


def _serial_address(text: str, url: str) -> SerialAddress:
    match = re.fullmatch(r"([^,]+?)(?:[,:](\d+))?", text)
    if match is None:
        raise OptionError(f"MAVLink connection {url!r}: no serial device; {_FORMS}")
    return SerialAddress(match[1], int(match[2] or DEFAULT_BAUD))
