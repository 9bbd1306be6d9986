"""Imports of much, without looking for garbage on the way."""

import contextlib
import gc
from collections.abc import Iterator


@contextlib.contextmanager
def importing() -> Iterator[None]:
    """Leave what is imported inside alone, now and later: none of it becomes garbage.

    To look through it again and again takes a sixth of the time of importing.
    """
    collected = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if collected:
            gc.enable()
