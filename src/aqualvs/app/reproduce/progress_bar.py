"""How far `aqualvs reproduce` is, on standard error: experiment, frames, and time left."""

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
from rich.text import Text

from aqualvs.app.progress import hidden_progress

TYPICAL_S: Mapping[str, float] = {
    "rig": 2.0,
    "dome": 9.0,
    "index": 14.0,
    "box": 10.0,
    "mesh": 45.0,
    "distance": 31.0,
    "angles": 47.0,
    "dome-or-not": 14.0,
    "sea": 32.0,
    "control": 2.0,
    "failures": 58.0,
    "stripes": 1.0,
    "filters": 1.0,
    "fits": 1.0,
    "sheets": 11.0,
    "beliefs": 2.0,
    "video": 17.0,
}
"""Seconds, to guess what is left; only their ratios matter once some are done."""

_UNKNOWN_S = 25.0
# As if so many typical seconds had gone by before: the first, short experiments say little.
_TRUST_S = 20.0


class TimeLeft:
    """Guess of the time that is left, from what the experiments so far took.

    Parameters
    ----------
    names : sequence of str
        Experiments to come.
    now : callable
        Clock in seconds.
    """

    def __init__(self, names: Sequence[str], now: Callable[[], float] = time.monotonic) -> None:
        self._to_come = {name: TYPICAL_S.get(name, _UNKNOWN_S) for name in names}
        self._now = now
        self._running = 0.0
        self._done = 0.0
        self._started = self._began = now()

    def start(self, name: str) -> None:
        """Note that an experiment begins."""
        self._running = self._to_come.pop(name)
        self._began = self._now()

    def end(self) -> None:
        """Note that the running experiment is done."""
        self._done += self._running
        self._running = 0.0
        self._began = self._now()

    @property
    def seconds(self) -> float:
        """Seconds left."""
        return self._ahead() * self._pace()

    @property
    def share(self) -> float:
        """Share of the work that is behind, 0 to 1."""
        total = self._done + self._running + sum(self._to_come.values())
        return 1.0 - self._ahead() / total if total > 0.0 else 1.0

    def _pace(self) -> float:
        """Return seconds per typical second."""
        return (_TRUST_S + self._began - self._started) / (_TRUST_S + self._done)

    def _ahead(self) -> float:
        """Return typical seconds ahead; one that takes too long is held at nine tenths."""
        within = (self._now() - self._began) / self._pace()
        return sum(self._to_come.values()) + max(self._running - within, 0.1 * self._running)


class ExperimentBar:
    """A progress bar over experiments.

    Parameters
    ----------
    bar : rich.progress.Progress
    names : sequence of str
    """

    def __init__(self, bar: Progress, names: Sequence[str]) -> None:
        self._bar = bar
        self._n = len(names)
        self._i = self._frames = 0
        self._left = TimeLeft(names)
        self._task = bar.add_task("", total=1.0, left=self._left, frames="")

    def start(self, name: str) -> None:
        """Show that an experiment begins."""
        self._i += 1
        self._left.start(name)
        self._bar.update(
            self._task,
            description=f"{self._i}/{self._n} {name}",
            completed=self._left.share,
        )

    def tick(self, n_frames: int) -> None:
        """Count rendered frames."""
        self._frames += n_frames
        self._bar.update(
            self._task, frames=f"{self._frames} frames rendered", completed=self._left.share
        )

    def end(self) -> None:
        """Show that the running experiment is done."""
        self._left.end()
        self._bar.update(self._task, completed=self._left.share)


@contextlib.contextmanager
def experiment_bar(names: Sequence[str]) -> Iterator[ExperimentBar]:
    """Show how far the experiments are; nothing where standard error is not a terminal.

    Parameters
    ----------
    names : sequence of str
        Experiments to come, in their order.
    """
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[frames]}"),
        _LeftColumn(),
    )
    disable = not console.is_terminal
    with (
        hidden_progress(),
        Progress(*columns, console=console, transient=True, disable=disable) as bar,
    ):
        yield ExperimentBar(bar, names)


class _LeftColumn(ProgressColumn):
    """The time left in words."""

    def render(self, task: Task) -> Text:
        """Return the time left as text."""
        left: TimeLeft = task.fields["left"]
        return Text(left_in_words(left.seconds))


def left_in_words(seconds: float) -> str:
    """Return a guessed time as one would say it."""
    if seconds < 60.0:
        return f"about {max(5, 5 * round(seconds / 5.0))} s left"
    return f"about {round(seconds / 60.0)} min left"
