"""Keys, signatures, and addresses that may speak."""

import hashlib
from pathlib import Path
from typing import Any

import pytest

from aqualvs.errors import OptionError
from aqualvs.live.mavlink.peers import Signer, load_key
from aqualvs.live.mavlink.ports import AllowedPeers

pytest.importorskip("pymavlink")

from pymavlink.dialects.v20 import ardupilotmega as dialect

KEY = bytes(range(32))
ATTITUDE = dialect.MAVLink_attitude_message(0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("text", "key"),
    [
        (KEY.hex(), KEY),
        (KEY.hex().upper() + "\n", KEY),
        ("a passphrase\n", hashlib.sha256(b"a passphrase").digest()),
        ("Größe", hashlib.sha256("Größe".encode()).digest()),
    ],
)
def test_key_files(tmp_path: Path, text: str, key: bytes) -> None:
    path = tmp_path / "key"
    path.write_text(text, encoding="utf-8")
    path.chmod(0o600)
    assert load_key(path) == key


@pytest.mark.parametrize("data", [b"", b"\n \n", b"one\ntwo", b"\xff\xfe", b"x" * 2000])
def test_files_that_hold_no_key(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "key"
    path.write_bytes(data)
    with pytest.raises(OptionError, match=r"key: write one line, a passphrase"):
        load_key(path)


def test_a_key_that_is_not_there(tmp_path: Path) -> None:
    for path in (tmp_path / "none", tmp_path):
        with pytest.raises(OptionError, match=r"cannot be read \(no such file\)"):
            load_key(path)


def test_a_key_that_others_can_read_is_warned_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "key"
    path.write_text("secret", encoding="utf-8")
    path.chmod(0o644)
    load_key(path)
    assert "others can read it" in caplog.text
    assert "secret" not in caplog.text


class Ends:
    """A sender, and a receiver whose parsers share one state."""

    def __init__(self) -> None:
        self.sender, self.receiver = Signer(dialect, KEY), Signer(dialect, KEY)
        self.packer = dialect.MAVLink(None, 1, 1)
        self.sender.sign(self.packer)

    def frame(self, message: Any = ATTITUDE) -> bytes:
        self.sender.advance()
        packed: bytes = message.pack(self.packer)
        return packed

    def hears(self, frame: bytes) -> bool:
        """Whether a receiver, with a parser for a new address, takes a frame."""
        parser = dialect.MAVLink(None)
        parser.robust_parsing = True
        self.receiver.check(parser)
        return [m.get_type() for m in parser.parse_buffer(frame)] == ["ATTITUDE"]


def test_signed_messages_are_heard_once() -> None:
    ends = Ends()
    frame = ends.frame()
    assert ends.hears(frame)
    # Said again, from whatever address.
    assert not ends.hears(frame)
    assert ends.hears(ends.frame())
    assert ends.receiver.n_refused == 1


def test_unsigned_and_forged_messages_are_refused() -> None:
    ends = Ends()
    assert not ends.hears(ATTITUDE.pack(dialect.MAVLink(None, 1, 1)))
    forged = bytearray(ends.frame())
    forged[-1] ^= 1
    assert not ends.hears(bytes(forged))
    assert ends.receiver.n_refused == 2


def test_a_forged_message_from_the_future_locks_nobody_out() -> None:
    ends = Ends()
    assert ends.hears(ends.frame())
    future = bytearray(ends.frame())
    future[-7] = 0xFF
    assert not ends.hears(bytes(future))
    assert ends.hears(ends.frame())


def test_we_follow_a_clock_that_is_ahead() -> None:
    ends = Ends()
    ends.sender._outgoing.timestamp += 10**12
    assert ends.hears(ends.frame())
    ends.receiver.advance()
    assert ends.receiver._outgoing.timestamp > 10**12


@pytest.mark.parametrize(
    ("rules", "peer", "may"),
    [
        ((), ("10.0.0.1", 5), True),
        (("192.168.2.2",), ("192.168.2.2", 40000), True),
        (("192.168.2.2",), ("192.168.2.3", 40000), False),
        (("192.168.2.2:14550",), ("192.168.2.2", 14550), True),
        (("192.168.2.2:14550",), ("192.168.2.2", 14551), False),
        (("192.168.2.0/24", "10.0.0.1"), ("192.168.2.77", 1), True),
        (("192.168.2.1/24",), ("192.168.3.1", 1), False),
        (("fe80::1",), ("fe80::1%eth0", 1, 0, 2), True),
        (("[fe80::1]:7",), ("fe80::1", 8, 0, 2), False),
        (("192.168.2.2",), ("fe80::1", 8, 0, 2), False),
        (("192.168.2.2",), (), True),
    ],
)
def test_who_may_speak(rules: tuple[str, ...], peer: tuple[object, ...], may: bool) -> None:
    assert (peer in AllowedPeers(rules)) is may


@pytest.mark.parametrize(
    "text", ["", "blueos.local", "192.168.2", "192.168.2.2:99999", "1.2.3.4/40"]
)
def test_peers_that_are_no_addresses(text: str) -> None:
    with pytest.raises(OptionError, match=r"write numbers, such as 192\.168\.2\.2"):
        AllowedPeers((text,))
