"""A serial port by pyserial: Linux, macOS and Windows."""

import contextlib
import os
import select
import socket
import threading

from aqualvs.errors import OptionError
from aqualvs.live.mavlink.ports import READ_BYTES, SerialAddress, StreamPort

# On Windows, a write that the driver does not take at once is given up after this time.
_WRITE_S = 0.1


def check_speed(address: SerialAddress) -> None:
    """Raise `OptionError` if pyserial is missing, or there is no such speed."""
    try:
        from serial import Serial
    except ImportError as fault:
        raise OptionError(
            f"MAVLink connection {address.device}: serial ports need pyserial: "
            "pip install 'aqualvs[mavlink]'"
        ) from fault
    if address.baud not in Serial.BAUDRATES:
        known = ", ".join(str(baud) for baud in Serial.BAUDRATES if baud >= 9600)
        raise OptionError(
            f"MAVLink connection {address.device}: speed {address.baud} baud is unknown here; "
            f"use one of {known}"
        )


class SerialPort(StreamPort):
    """A serial port with eight bits, no parity, one stop bit and no flow control.

    A thread reads, because Windows cannot wait for serial ports and sockets together.

    Raises `OSError` if it is not there, not a serial port, or not ours to open.
    """

    def __init__(self, address: SerialAddress) -> None:
        # How long the reader waits for a byte before it looks whether the port was closed.
        read_s = 0.1
        bits_per_byte = 10
        super().__init__()
        # Only those who have a serial line need it.
        from serial import Serial

        self._bytes_per_s = address.baud / bits_per_byte
        write_s = 0.0 if os.name == "posix" else _WRITE_S
        try:
            self._serial = Serial(
                address.device, address.baud, timeout=read_s, write_timeout=write_s
            )
        except Exception as fault:
            raise _as_os_error(fault) from fault
        self._received, self._incoming = socket.socketpair()
        self._received.setblocking(False)
        self._closing = False
        self._reader = threading.Thread(
            target=self._pour, name=f"serial {address.device}", daemon=True
        )
        self._reader.start()

    @property
    def lag_s(self) -> float:
        """How long the driver is going to send what it holds already."""
        return float(self._serial.out_waiting) / self._bytes_per_s

    def fileno(self) -> int:
        """Return the number to wait on."""
        return self._received.fileno()

    def close(self) -> None:
        """Free the port at once; what waits is lost."""
        if self._closing:
            return
        self._closing = True
        # The reader may wait for room.
        self._received.close()
        with contextlib.suppress(OSError):
            self._serial.cancel_read()
        self._reader.join()
        # Without this, closing waits until the driver has sent what it holds. Of a device that has
        # gone, pyserial also passes on errors of the system that are no OSError.
        with contextlib.suppress(Exception):
            self._serial.reset_output_buffer()
        self._serial.close()

    def _pour(self) -> None:
        """Pass on what comes until the port is closed or gone."""
        with self._incoming, contextlib.suppress(OSError):
            while not self._closing:
                size = min(READ_BYTES, max(1, self._serial.in_waiting))
                self._incoming.sendall(self._serial.read(size))

    def _take(self) -> bytes:
        return self._received.recv(READ_BYTES)

    def _give(self, data: bytes) -> int:
        # pyserial tries again and again while there is no room.
        if os.name == "posix" and not select.select((), (self._serial,), (), 0)[1]:
            raise BlockingIOError
        return self._serial.write(data) or 0


def _as_os_error(fault: Exception) -> OSError:
    """Return why a port cannot be opened; pyserial's own text names the device three times."""
    number = fault.args[0] if fault.args and isinstance(fault.args[0], int) else None
    if number is None:
        return OSError(0, "this is not a serial port")
    return OSError(number, os.strerror(number))
