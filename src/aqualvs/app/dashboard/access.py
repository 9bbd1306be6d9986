"""Who may see the pilot's page, and who may command from it."""

import ipaddress
import re
import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import urlsplit

_LEAST_TOKEN = 8
_HOST = re.compile(r"(?:\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9_.-]+)(?::([0-9]{1,5}))?", re.ASCII)
_SCHEME = re.compile(r"[a-z][a-z0-9+.-]*://", re.ASCII)
_MAX_PORT = 65535
_LOCAL_NAMES = frozenset({"localhost", "127.0.0.1", "::1"})


@dataclass(frozen=True, slots=True)
class Access:
    """The rules: this machine may watch, whoever has the token may watch and command.

    Attributes
    ----------
    host : str
        Address that the page is served at.
    token : str
        The password.
    """

    host: str
    token: str

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
        """Return whether somebody with this token may command."""
        return secrets.compare_digest(token.encode(), self.token.encode())

    def may_watch(self, token: str) -> bool:
        """Return whether somebody with this token may see the data."""
        return self.is_local or self.may_command(token)

    def is_own_page(self, origin: str | None, host: str) -> bool:
        """Return whether a connection comes from the page itself rather than from a foreign one.

        Parameters
        ----------
        origin : str or None
            The header that browsers send with the page's address; programs send none.
        host : str
            The header with the address as the browser knows it. Served to this machine only, it
            must be a name of this machine: a foreign name that points here is an attack.
        """
        if self.is_local and urlsplit(f"//{host}").hostname not in _LOCAL_NAMES:
            return False
        return origin is None or urlsplit(origin).netloc == host


def are_addresses(hosts: Sequence[str], origins: Sequence[str]) -> bool:
    """Return whether the headers `Host` and `Origin` of a request are written as addresses are.

    Parameters
    ----------
    hosts, origins : sequence of str
        All values of these headers; a program may send none, nobody may send two.
    """
    if len(hosts) > 1 or len(origins) > 1:
        return False
    return all(map(_is_host, hosts)) and all(map(_is_origin, origins))


def _is_host(text: str) -> bool:
    """Return whether a text is a name or an IP address, with or without a port (RFC 9110, 7.2)."""
    found = _HOST.fullmatch(text)
    if found is None or int(found[1] or 0) > _MAX_PORT:
        return False
    try:
        # The brackets of what is no IPv6 address raise here.
        return urlsplit(f"//{text}").hostname is not None
    except ValueError:
        return False


def _is_origin(text: str) -> bool:
    """Return whether a text is an origin, as browsers write it (RFC 6454, 6.2)."""
    scheme = _SCHEME.match(text)
    return text == "null" or (scheme is not None and _is_host(text[scheme.end() :]))


def make_access(host: str, token: str | None) -> Access:
    """Return the rules for an address; without a token a new one is made."""
    return Access(host, token if token else secrets.token_urlsafe(12))


def token_fault(token: str | None) -> str:
    """Return what is wrong with a token that a user chose; "" if nothing is."""
    if token is None or len(token) >= _LEAST_TOKEN:
        return ""
    return f"--token: {len(token)} characters; choose at least {_LEAST_TOKEN}, or leave it out"
