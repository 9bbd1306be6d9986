"""How far a run is, on standard error."""

import contextlib
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import TypeAlias

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

Tick: TypeAlias = Callable[[int], None]

# Until the first frame is done; compiled code is kept for the next run.
_FIRST_RUN = "(the first run on a machine compiles for about 20 s)"
_HIDDEN: ContextVar[bool] = ContextVar("hidden", default=False)


class _Rate(ProgressColumn):
    """Frames, or whatever is counted, per second."""

    def __init__(self, unit: str) -> None:
        super().__init__()
        self._unit = unit

    def render(self, task: Task) -> Text:
        """Return the rate as text."""
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:.0f} {self._unit}/s")


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
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), _Rate(unit))
    bar = Progress(
        *columns,
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=_HIDDEN.get() or not console.is_terminal,
    )
    with bar:
        task = bar.add_task(f"{label} {_FIRST_RUN}", total=n_frames)

        def tick(n_done: int) -> None:
            bar.update(task, advance=n_done, description=label)

        yield tick
