"""Decoders of pictures that print what they think of a file: libpng, libjpeg, libtiff."""

import contextlib
import os
import threading
from collections.abc import Iterator

import cv2

_lock = threading.Lock()
_n_inside = 0
_before: tuple[int, int] = (-1, 0)


@contextlib.contextmanager
def quiet_decoders() -> Iterator[None]:
    """Lead nowhere what OpenCV and the libraries below it print to standard error.

    They know nothing of Python's streams, so the file of the process itself is replaced meanwhile,
    for all of its threads.
    """
    global _n_inside, _before
    with _lock:
        if _n_inside == 0:
            level = cv2.utils.logging.setLogLevel(0)
            _before = _lead_nowhere(), level
        _n_inside += 1
    try:
        yield
    finally:
        with _lock:
            _n_inside -= 1
            if _n_inside == 0:
                kept, level = _before
                cv2.utils.logging.setLogLevel(level)
                if kept >= 0:
                    os.dup2(kept, 2)
                    os.close(kept)


def _lead_nowhere() -> int:
    """Lead standard error nowhere; return a copy of what it was, -1 where it is closed."""
    try:
        kept = os.dup(2)
    except OSError:
        return -1
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    os.close(nowhere)
    return kept
