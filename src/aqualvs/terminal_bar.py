"""The progress bar of a terminal."""

import contextlib
from collections.abc import Callable, Iterator

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


class Rate(ProgressColumn):
    """Frames, or whatever is counted, per second."""

    def __init__(self, unit: str) -> None:
        super().__init__()
        self._unit = unit

    def render(self, task: Task) -> Text:
        """Return the rate as text."""
        speed = task.finished_speed or task.speed
        if not speed and task.completed and task.elapsed:
            # Rich forgets what is older than half a minute.
            speed = task.completed / task.elapsed
        return Text(f"{_rounded(speed)} {self._unit}/s" if speed else "")


def _rounded(speed: float) -> str:
    """Return a rate with two significant digits at least."""
    return f"{speed:.0f}" if speed >= 10.0 else f"{speed:#.2g}"


@contextlib.contextmanager
def terminal_bar(
    label: str, n_frames: int | None, unit: str, *, hint: str
) -> Iterator[Callable[[int], None]]:
    """Show a bar on standard error; nothing where Rich does not take that for a terminal.

    Parameters and what it yields are those of `aqualvs.terminal.progress`. The hint is shown until
    the first frame is done.
    """
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), Rate(unit))
    bar = Progress(
        *columns,
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
    with bar:
        task = bar.add_task(f"{label} ({hint})", total=n_frames)

        def tick(n_done: int) -> None:
            bar.update(task, advance=n_done, description=label)

        yield tick
