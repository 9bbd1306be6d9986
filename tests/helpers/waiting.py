"""Waiting for what happens in other threads and processes, however busy the machine is.

A test may not depend on how soon something happens, only on that it happens: it waits for the
event. What needs a limit states one that holds with four busy programs on each core.
"""

import time
from collections.abc import Callable

TIMEOUT_S = 180.0
"""So long is waited for what must happen in the end; only a test that fails waits so long."""


def until(
    condition: Callable[[], object],
    what: str = "what was waited for",
    patience_s: float = TIMEOUT_S,
) -> None:
    """Wait until a condition is true; fail where it never becomes so."""
    end = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < end, f"{what} did not happen"
        time.sleep(0.005)
