"""A serial port by pyserial, over a pair of pseudo terminals."""

import contextlib
import os
import select
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from aqualvs.errors import OptionError
from aqualvs.live.mavlink.ports import check_address, open_port, parse_address
from waiting import TIMEOUT_S, until

# Windows has no pseudo terminals.
tty = pytest.importorskip("tty")


@pytest.fixture
def line() -> Iterator[tuple[int, str]]:
    """The far end, and the name of the near one."""
    far, near = os.openpty()
    tty.setraw(near)
    os.set_blocking(far, False)
    try:
        yield far, os.ttyname(near)
    finally:
        for one in (far, near):
            with contextlib.suppress(OSError):
                os.close(one)


def test_every_byte_passes_unchanged_both_ways(line: tuple[int, str]) -> None:
    far, name = line
    every = bytes(range(256)) * 8
    with contextlib.closing(open_port(parse_address(f"serial:{name}:921600"))) as port:
        os.write(far, every)
        got = b""
        while len(got) < len(every):
            assert select.select([port], [], [], TIMEOUT_S)[0], "nothing came"
            got += port.read()[0]
        assert got == every
        assert port.read() == (b"", ())
        assert port.write(every, ())
        back = b""

        def received() -> bool:
            nonlocal back
            with contextlib.suppress(BlockingIOError):
                back += os.read(far, 4096)
            port.flush()
            return len(back) >= len(every)

        until(received, "all bytes at the far end")
        assert back == every


def test_a_line_that_takes_nothing_makes_nobody_wait(line: tuple[int, str]) -> None:
    _far, name = line
    with contextlib.closing(open_port(parse_address(f"serial:{name}"))) as port:
        while port.write(bytes(1000), ()) and not port.unsent:
            pass
        assert not port.write(b"more", ())


def test_a_device_that_goes_is_an_error_and_closes_at_once(line: tuple[int, str]) -> None:
    far, name = line
    threads = threading.active_count()
    with contextlib.closing(open_port(parse_address(f"serial:{name}"))) as port:
        os.close(far)
        assert select.select([port], [], [], TIMEOUT_S)[0]
        with pytest.raises(ConnectionResetError):
            port.read()
    assert threading.active_count() == threads


def test_what_is_no_serial_port_is_said_in_a_few_words(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="this is not a serial port"):
        open_port(parse_address(f"serial:{tmp_path / 'file'}"))
    with pytest.raises(FileNotFoundError, match=r"No such file or directory$"):
        open_port(parse_address(f"serial:{tmp_path / 'missing'}"))


def test_without_pyserial_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(OptionError, match=r"COM3.*aqualvs\[mavlink\]"):
        check_address(parse_address("serial:COM3:115200"))
