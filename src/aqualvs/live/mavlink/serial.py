"""A serial port by the system's own calls; POSIX only."""

import fcntl
import os
import struct
import termios

from aqualvs.errors import OptionError
from aqualvs.live.mavlink.ports import SerialAddress, StreamPort

_CHUNK = 4096
_BITS_PER_BYTE = 10
_COMMON = (9600, 38400, 57600, 115200, 230400, 460800, 921600, 1500000)


def speed_of(address: SerialAddress) -> int:
    """Return the system's code of a speed.

    Raises
    ------
    OptionError
        If it knows no such speed.
    """
    code: int | None = getattr(termios, f"B{address.baud}", None)
    if not code:
        known = ", ".join(str(baud) for baud in _COMMON if hasattr(termios, f"B{baud}"))
        raise OptionError(
            f"MAVLink connection {address.device}: speed {address.baud} baud is unknown here; "
            f"use one of {known}"
        )
    return code


class SerialPort(StreamPort):
    """A serial port with eight bits, no parity, one stop bit and no flow control.

    Parameters
    ----------
    address : SerialAddress

    Raises
    ------
    OSError
        If it is not there, not a serial port, or not ours to open.
    """

    def __init__(self, address: SerialAddress) -> None:
        super().__init__()
        self._bytes_per_s = address.baud / _BITS_PER_BYTE
        self._number = os.open(address.device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            _make_raw(self._number, speed_of(address))
        except termios.error as fault:
            os.close(self._number)
            raise OSError(fault.args[0], "this is no serial port") from fault

    @property
    def lag_s(self) -> float:
        """How long the driver is going to send what it holds already."""
        answer = fcntl.ioctl(self._number, termios.TIOCOUTQ, b"\0\0\0\0")
        return float(struct.unpack("i", answer)[0]) / self._bytes_per_s

    def fileno(self) -> int:
        """Return the number to wait on."""
        return self._number

    def close(self) -> None:
        """Free the port at once; what waits is lost."""
        if self._number < 0:
            return
        number, self._number = self._number, -1
        try:
            # Without this, closing waits until the driver has sent what it holds.
            termios.tcflush(number, termios.TCOFLUSH)
        except termios.error:
            pass
        finally:
            os.close(number)

    def _take(self) -> bytes:
        return os.read(self._number, _CHUNK)

    def _give(self, data: bytes) -> int:
        return os.write(self._number, data)


def _make_raw(number: int, speed: int) -> None:
    """Pass bytes through as they are."""
    state = termios.tcgetattr(number)
    state[0] = termios.IGNBRK
    state[1] = 0
    state[2] = termios.CS8 | termios.CREAD | termios.CLOCAL
    state[3] = 0
    state[4] = state[5] = speed
    # With a minimum of 1 an idle port says "not now"; an empty read then means that it has gone.
    state[6][termios.VMIN], state[6][termios.VTIME] = 1, 0
    termios.tcsetattr(number, termios.TCSANOW, state)
