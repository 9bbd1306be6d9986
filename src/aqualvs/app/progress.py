"""How far a run is, on standard error."""

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import TypeAlias

Tick: TypeAlias = Callable[[int], None]

_HIDDEN: ContextVar[bool] = ContextVar("hidden", default=False)
# What says of something else that it is a terminal (https://force-color.org).
_CLAIMS = ("TTY_COMPATIBLE", "FORCE_COLOR")


@contextlib.contextmanager
def hidden_progress() -> Iterator[None]:
    """Show no bars of what is done inside: two at a time overwrite each other."""
    token = _HIDDEN.set(True)
    try:
        yield
    finally:
        _HIDDEN.reset(token)


@contextlib.contextmanager
def progress(label: str, n_frames: int | None, unit: str = "frames") -> Iterator[Tick]:
    """Show a progress bar; nothing where standard error is not a terminal, or bars are hidden.

    Parameters
    ----------
    label : str
        What is going on.
    n_frames : int or None
        Frames to come, if known.
    unit : str
        What is counted, if not frames.

    Yields
    ------
    tick : callable
        To be called with the number of frames that have been done since the last call.
    """
    if _HIDDEN.get() or not _may_be_terminal():
        yield _tell_nobody
        return
    # Rich takes as long to import as a video to open, and is needed for a terminal only.
    from aqualvs.app.terminal_bar import terminal_bar

    with terminal_bar(label, n_frames, unit) as tick:
        yield tick


def _may_be_terminal() -> bool:
    """Return whether standard error may be a terminal; False is certain."""
    if any(os.environ.get(name) for name in _CLAIMS):
        return True
    try:
        return sys.stderr.isatty()
    except (AttributeError, ValueError):
        return False


def _tell_nobody(n_done: int) -> None:
    """Do nothing."""
