"""Ports for tests, while other tests and programs use others."""

import contextlib
import random
import socket

# Sockets that ask for no port get one from 32768 on (Linux) or from 49152 on (others).
_FIRST, _LAST = 20_000, 32_000


def free_port() -> int:
    """Return a port that nobody uses, by TCP or UDP, and that the system gives to nobody unasked.

    A port that the system chose, and that was let go so that its number can be passed on, may be
    another program's by the time it is used.
    """
    draw = random.SystemRandom()
    while True:
        port = draw.randrange(_FIRST, _LAST)
        with (
            contextlib.suppress(OSError),
            socket.socket(socket.AF_INET, socket.SOCK_STREAM) as tcp,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp,
        ):
            tcp.bind(("127.0.0.1", port))
            udp.bind(("127.0.0.1", port))
            return port
