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

# Until the first frame is done; compiled code is kept for the next run.
_FIRST_RUN = "(the first run on a machine compiles for a minute or two)"


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
def terminal_bar(label: str, n_frames: int | None, unit: str) -> Iterator[Callable[[int], None]]:
    """Show a bar on standard error; nothing where Rich does not take that for a terminal.

    Parameters and what it yields are those of `aqualvs.terminal.progress`.
    """
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), _Rate(unit))
    bar = Progress(
        *columns,
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
    with bar:
        task = bar.add_task(f"{label} {_FIRST_RUN}", total=n_frames)

        def tick(n_done: int) -> None:
            bar.update(task, advance=n_done, description=label)

        yield tick
