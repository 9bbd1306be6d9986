"""The terminal during a run: progress on standard error, and an orderly stop.

Ctrl-C and SIGTERM end the run after the current frame (`StopSignals`).
"""

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from types import FrameType
from typing import TYPE_CHECKING, Any, Self, TypeAlias

from aqualvs.closing import Closing

if TYPE_CHECKING:
    from rich.progress import Task

Echo: TypeAlias = Callable[[str], object]
"""Printer of a line for the user."""

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StopSignals(Closing):
    """Context manager that catches the first SIGINT or SIGTERM as a request to stop.

    The second signal is not caught, so that it ends the process. Outside of the main thread, where
    Python allows no handlers, no signal is caught.
    """

    def __init__(self) -> None:
        self.caught: signal.Signals | None = None  # The signal that asked to stop.
        self._previous: dict[signal.Signals, Any] = {}

    @property
    def exit_code(self) -> int:
        """Exit code by the shell's convention: 128 + signal, 0 if there was none."""
        return 0 if self.caught is None else 128 + self.caught

    def __enter__(self) -> Self:
        """Catch the signals from here on."""
        if threading.current_thread() is threading.main_thread():
            self._previous = {s: signal.signal(s, self._note) for s in _SIGNALS}
        return self

    def close(self) -> None:
        """Put the previous handlers back."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous = {}

    def _note(self, number: int, _frame: FrameType | None) -> None:
        self.caught = signal.Signals(number)
        self.close()


Tick: TypeAlias = Callable[[int], None]
_Shown: TypeAlias = tuple[Tick, Callable[[], None]]
"""What is to be called with the number of frames done, and to say why the first takes long."""

FIRST_RUN = "the first run on a machine compiles, which takes about a minute"
"""Said if the first frame takes long; compiled code is kept for the next run."""
_SLOW_S = 3.0  # Time after which that is said.

_HIDDEN: ContextVar[bool] = ContextVar("hidden", default=False)
# Variables that declare any output a terminal (https://force-color.org).
_CLAIMS = ("TTY_COMPATIBLE", "FORCE_COLOR")


@contextlib.contextmanager
def hidden_progress() -> Iterator[None]:
    """Hide progress bars inside the context: two at a time would overwrite each other."""
    token = _HIDDEN.set(True)
    try:
        yield
    finally:
        _HIDDEN.reset(token)


@contextlib.contextmanager
def progress(label: str, n_frames: int | None, unit: str = "frames") -> Iterator[Tick]:
    """Show a progress bar; print lines instead where standard error is no terminal.

    The first line comes at once, the others after 10 s, 20 s, 40 s and so on: few in a log, however
    long it takes. If the first frame takes long, either says why. Inside `hidden_progress`, show
    nothing. `n_frames` is None where it is not known. Yields what is to be called with the number
    of frames completed since the last call.
    """
    if _HIDDEN.get():
        yield lambda _: None
        return
    shown = _bar if _may_be_terminal() else _lines
    with (
        shown(label, n_frames, unit) as (tick, explain),
        _called_if_slow(explain, _SLOW_S) as timer,
    ):

        def count(n_done: int) -> None:
            timer.cancel()
            tick(n_done)

        yield count


class Lines:
    """Progress in lines, printed when the time since the beginning has doubled.

    `count`: words behind the number that is done.
    """

    def __init__(self, label: str, count: str, clock: Callable[[], float] = time.monotonic) -> None:
        first_s = 10.0
        self._label, self._count, self._clock = label, count, clock
        self._began, self._due_s, self._n_done = clock(), first_s, 0
        self._lock = threading.Lock()

    def tick(self, n_done: int) -> None:
        """Count what is done, and print it if it is time to."""
        with self._lock:
            self._n_done += n_done
            spent_s = self._clock() - self._began
            if spent_s >= self._due_s:
                while self._due_s <= spent_s:
                    self._due_s *= 2.0
                _say(f"{self._label}: {self._n_done} {self._count} after {spent_s:.0f} s")


def _say(words: str) -> None:
    print(f"aqualvs: {words}", file=sys.stderr, flush=True)


@contextlib.contextmanager
def told_if_slow(label: str, after_s: float = _SLOW_S) -> Iterator[None]:
    """Say on standard error what is waited for, if it takes longer than `after_s` seconds."""
    with _called_if_slow(lambda: _say(f"{label} ({FIRST_RUN})"), after_s):
        yield


@contextlib.contextmanager
def _called_if_slow(tell: Callable[[], object], after_s: float) -> Iterator[threading.Timer]:
    """Call a function after that time, unless the context ends or the timer is cancelled before."""
    timer = threading.Timer(after_s, tell)
    timer.start()
    try:
        yield timer
    finally:
        timer.cancel()


def _may_be_terminal() -> bool:
    """Return whether standard error may be a terminal; False is certain."""
    if any(os.environ.get(name) for name in _CLAIMS):
        return True
    try:
        return sys.stderr.isatty()
    except (AttributeError, ValueError):
        return False


@contextlib.contextmanager
def _lines(label: str, n_frames: int | None, unit: str) -> Iterator[_Shown]:
    """Print lines."""
    units = unit.removesuffix("s") if n_frames == 1 else unit
    count = unit if n_frames is None else f"{n_frames} {units}"
    _say(f"{label}: {count}")
    lines = Lines(label, count if n_frames is None else f"of {count}")
    yield lines.tick, lambda: _say(f"{label}: {FIRST_RUN}")


@contextlib.contextmanager
def _bar(label: str, n_frames: int | None, unit: str) -> Iterator[_Shown]:
    """Show a bar; nothing where Rich does not take standard error for a terminal."""
    from rich import console, progress

    stderr = console.Console(stderr=True)
    with progress.Progress(
        progress.TextColumn("{task.description}"),
        progress.BarColumn(),
        progress.MofNCompleteColumn(),
        progress.TextColumn("{task.fields[rate]}", markup=False),
        progress.TimeRemainingColumn(),
        console=stderr,
        transient=True,
        disable=not stderr.is_terminal,
    ) as bar:
        task = bar.add_task(label, total=n_frames, rate="")

        def tick(n_done: int) -> None:
            bar.update(task, advance=n_done, description=label)
            bar.update(task, rate=rate_text(bar.tasks[0], unit))

        yield tick, lambda: bar.update(task, description=f"{label} ({FIRST_RUN})")


def rate_text(task: "Task", unit: str) -> str:
    """Return frames, or whatever is counted, per second, with two significant digits at least."""
    speed = task.finished_speed or task.speed
    if not speed and task.completed and task.elapsed:
        # Rich forgets what is older than half a minute.
        speed = task.completed / task.elapsed
    if not speed:
        return ""
    return f"{speed:.0f} {unit}/s" if speed >= 10.0 else f"{speed:#.2g} {unit}/s"
