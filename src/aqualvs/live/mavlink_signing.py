"""MAVLink 2 signing by pymavlink: who does not have the key is not heard.

https://mavlink.io/en/guide/message_signing.html
"""

import hashlib
import logging
import os
import re
import time
from pathlib import Path
from typing import Any

from aqualvs.errors import OptionError

_HEX_KEY = re.compile(r"[0-9A-Fa-f]{64}")
_LONGEST_KEY = 1000
# Signatures count units of 10 us since 2015-01-01 00:00 UTC.
_EPOCH_S, _UNITS_PER_S = 1_420_070_400, 100_000
_READABLE_BY_OTHERS = 0o077
_log = logging.getLogger(__name__)


def load_key(path: Path) -> bytes:
    """Return the key of a file: 64 hexadecimal digits, or a passphrase.

    The key of a passphrase is its SHA-256, as in MAVProxy, Mission Planner and QGroundControl.

    Raises
    ------
    OptionError
        If there is no such file, or it holds neither.
    """
    try:
        if not path.is_file():
            raise FileNotFoundError(0, "no such file")
        with path.open("rb") as file:
            data = file.read(_LONGEST_KEY + 1)
        readable = os.name == "posix" and bool(path.stat().st_mode & _READABLE_BY_OTHERS)
        text = data.decode().strip()
    except OSError as fault:
        raise OptionError(f"MAVLink key {path}: cannot be read ({fault.strerror})") from None
    except UnicodeDecodeError:
        text = ""
    if not text or len(data) > _LONGEST_KEY or not text.isprintable():
        raise OptionError(
            f"MAVLink key {path}: write one line, a passphrase or 64 hexadecimal digits"
        )
    if readable:
        _log.warning("MAVLink key %s: others can read it; chmod 600 %s", path, path)
    return (
        bytes.fromhex(text) if _HEX_KEY.fullmatch(text) else hashlib.sha256(text.encode()).digest()
    )


class Signer:
    """Signs what one connection sends, and checks what it receives.

    Parameters
    ----------
    dialect : module
        pymavlink's messages.
    key : bytes
        32 of them.
    """

    def __init__(self, dialect: Any, key: bytes) -> None:
        self._outgoing, self._incoming = dialect.MAVLinkSigning(), dialect.MAVLinkSigning()
        for state in (self._outgoing, self._incoming):
            state.secret_key, state.timestamp = key, _now()
        self._outgoing.sign_outgoing = True
        # Given, and never true, so that pymavlink counts what it refuses.
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
