"""How far a batch is: a bar with the time left on standard error, and a line for every dive."""

from collections.abc import Callable
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from aqualvs.app.batch.records import DiveRecord
from aqualvs.closing import Closing

# Pieces take seconds, so that the last half minute says little of the speed.
_SPEED_OVER_S = 600.0


class BatchProgress(Closing):
    """Shows a bar where standard error is a terminal, and tells each dive; a context manager.

    Parameters
    ----------
    n_dives : int
    tell : callable
        Takes one line of text.
    """

    def __init__(self, n_dives: int, tell: Callable[[str], object]) -> None:
        self._n_dives, self._n_ended, self._n_frames = n_dives, 0, 0
        self._total = 0
        self._tell = tell
        console = Console(stderr=True)
        columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn())
        self._bar = Progress(
            *columns,
            TextColumn("time left"),
            TimeRemainingColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
            speed_estimate_period=_SPEED_OVER_S,
        )
        self._task = self._bar.add_task(self._words(), total=None)

    def expect(self, n_bytes: int) -> None:
        """Note that there is so much more, or less, to be worked through than was said."""
        self._total += n_bytes
        self._bar.update(self._task, total=max(self._total, 1))

    def measured(self, n_bytes: int, n_frames: int) -> None:
        """Note that a piece is done."""
        self._n_frames += n_frames
        self._bar.update(self._task, advance=n_bytes, description=self._words())

    def ended(self, record: DiveRecord) -> None:
        """Note that a dive is done, or given up."""
        self._n_ended += 1
        self._bar.update(self._task, description=self._words())
        self._tell(record.line())

    def _words(self) -> str:
        return f"{self._n_ended} of {self._n_dives} dives, {self._n_frames} frames"

    def __enter__(self) -> Self:
        """Show the bar."""
        self._bar.start()
        return self

    def close(self) -> None:
        """Take the bar away."""
        self._bar.stop()
