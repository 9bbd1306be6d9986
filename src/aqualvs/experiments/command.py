"""`aqualvs reproduce`: runs the experiments one after the other and shows them on one page.

Progress on standard error names the experiment, the frames rendered and the time left.
"""

import contextlib
import statistics
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from aqualvs.errors import OutputError
from aqualvs.experiments import experiment as catalogue
from aqualvs.experiments.experiment import Experiment
from aqualvs.experiments.laboratory import Laboratory
from aqualvs.experiments.page import (
    FAILURES,
    FILES,
    FRAME,
    PAGE,
    Record,
    is_reproduced,
    read_results,
    save_outcome,
    with_bar,
    work_folder,
    write_page,
    write_results,
)
from aqualvs.results.files import Claim, writing
from aqualvs.terminal import Echo, hidden_progress


class TimeLeft:
    """Estimate of the time left, from the durations of the experiments so far.

    `names`: experiments to run. `now`: clock in seconds.
    """

    def __init__(self, names: Sequence[str], now: Callable[[], float] = time.monotonic) -> None:
        self._to_come = {name: catalogue.MODULES[name][1] for name in names}
        self._now = now
        # Typical seconds of the running experiment, and of those done.
        self._running = self._done = 0.0
        # Clock at the start of all, and of the running experiment.
        self._started = self._began = now()

    def start(self, name: str) -> None:
        """Note the start of an experiment."""
        self._running = self._to_come.pop(name)
        self._began = self._now()

    def end(self) -> None:
        """Note the end of the running experiment."""
        self._done += self._running
        self._running = 0.0
        self._began = self._now()

    @property
    def seconds(self) -> float:
        """Estimated seconds left."""
        return self._ahead() * self._pace()

    @property
    def text(self) -> str:
        """The same as text."""
        return time_left_text(self.seconds)

    @property
    def share(self) -> float:
        """Share of the work that is done, 0 to 1."""
        total = self._done + self._running + sum(self._to_come.values())
        return 1.0 - self._ahead() / total if total > 0.0 else 1.0

    def _pace(self) -> float:
        """Return the ratio of actual to typical seconds so far."""
        # Prior weight of a ratio of 1, as the first experiments are short.
        prior_s = 20.0
        return (prior_s + self._began - self._started) / (prior_s + self._done)

    def _ahead(self) -> float:
        """Return the typical seconds left; at least a tenth of the running experiment."""
        within = (self._now() - self._began) / self._pace()
        return sum(self._to_come.values()) + max(self._running - within, 0.1 * self._running)


class ExperimentBar:
    """Progress bar over experiments."""

    def __init__(self, bar: Progress, names: Sequence[str]) -> None:
        self._bar = bar
        self._n = len(names)
        self._i = self._frames = 0
        self._left = TimeLeft(names)
        self._task = bar.add_task("", total=1.0, left=self._left, frames="")

    def start(self, name: str) -> None:
        """Show the start of an experiment."""
        self._i += 1
        self._left.start(name)
        self._bar.update(
            self._task, description=f"{self._i}/{self._n} {name}", completed=self._left.share
        )

    def tick(self, n_frames: int) -> None:
        """Count rendered frames."""
        self._frames += n_frames
        self._bar.update(
            self._task, frames=f"{self._frames} frames rendered", completed=self._left.share
        )

    def end(self) -> None:
        """Show the end of the running experiment."""
        self._left.end()
        self._bar.update(self._task, completed=self._left.share)


@contextlib.contextmanager
def experiment_bar(names: Sequence[str]) -> Iterator[ExperimentBar]:
    """Show the progress of the experiments `names`, if standard error is a terminal."""
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[frames]}"),
        TextColumn("{task.fields[left].text}"),
    )
    disable = not console.is_terminal
    with (
        hidden_progress(),
        Progress(*columns, console=console, transient=True, disable=disable) as bar,
    ):
        yield ExperimentBar(bar, names)


def time_left_text(seconds: float) -> str:
    """Return an estimated time as text, rounded to 5 s or to minutes."""
    if seconds < 60.0:
        return f"about {max(5, 5 * round(seconds / 5.0))} s left"
    return f"about {round(seconds / 60.0)} min left"


def print_experiments(echo: Echo) -> None:
    """Print the name, title and section of the paper of every experiment."""
    width = max(map(len, catalogue.MODULES))
    for name in catalogue.MODULES:
        found = catalogue.experiment(name)
        echo(f"{name:<{width}}  {found.title} ({found.paper or 'an ablation'})")


def reproduce(names: Sequence[str], out: Path, echo: Echo) -> int:
    """Run experiments, write the page after each of them, and return 0, or 1 if one failed.

    `names`: all experiments if empty. Results of other experiments by the same version in the
    folder `out` stay on the page. Raises `OptionError` if a name is not known, `OutputError` if the
    folder cannot be written.
    """
    names = catalogue.ordered(names)
    files = [out / name for name in FILES]
    known = files if is_reproduced(out) else []
    claim = Claim("reproduce", files, overwrite=True, known=known)
    with experiment_bar(names) as bar:
        laboratory = Laboratory(work_folder(out), bar.tick)
        results = _Records(out)
        for number, name in enumerate(names, 1):
            bar.start(name)
            results.run(name, laboratory)
            echo(f"[{number}/{len(names)}] {_line(results.records[name], results.seconds[name])}")
            bar.end()
            write_page(results.in_order(), results.seconds, out)
    claim.close()
    records = [results.records[name] for name in names]
    failed = [record.name for record in records if record.failure]
    if failed:
        echo(f"{len(failed)} of {len(names)} experiments failed: {', '.join(failed)}")
    bars = [bool(row.met) for _, row in with_bar(records)]
    took = sum(results.seconds[name] for name in names)
    echo(f"{sum(bars)} of {len(bars)} criteria met, {took:.0f} s")
    echo(f"page: {out / PAGE}")
    return int(bool(failed))


class _Records:
    """Records of the experiments in a folder, written after each experiment."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.records, self.seconds = read_results(folder)

    def run(self, name: str, laboratory: Laboratory) -> None:
        """Run one experiment and store its outcome or its failure."""
        started = time.perf_counter()
        self.records[name] = self._record(name, laboratory)
        self.seconds[name] = time.perf_counter() - started
        if laboratory.frame_s:
            self.seconds[FRAME] = statistics.median(laboratory.frame_s)
        write_results(self.in_order(), self.seconds, self.folder)

    def in_order(self) -> list[Record]:
        return [self.records[name] for name in catalogue.MODULES if name in self.records]

    def _record(self, name: str, laboratory: Laboratory) -> Record:
        found: Experiment | None = None
        kept = self.folder / FAILURES / f"{name}.txt"
        try:
            found = catalogue.experiment(name)
            record = save_outcome(name, found, found.run(laboratory), self.folder)
        except OutputError:
            raise
        except Exception as fault:
            # The failure of one experiment must not end the others.
            with writing(kept):
                kept.parent.mkdir(parents=True, exist_ok=True)
                kept.write_text("".join(traceback.format_exception(fault)), encoding="utf-8")
            return _failed(name, found, fault)
        kept.unlink(missing_ok=True)
        return record


def _failed(name: str, found: Experiment | None, fault: Exception) -> Record:
    message = " ".join(str(fault).split())
    return Record(
        name=name,
        title=found.title if found else name,
        paper=found.paper if found else "",
        about=found.about if found else "",
        failure=f"{type(fault).__name__}: {message}" if message else type(fault).__name__,
    )


def _line(record: Record, seconds: float) -> str:
    if record.failure:
        return (
            f"{record.name}: failed: {record.failure}; the full traceback is in "
            f"{FAILURES}/{record.name}.txt"
        )
    missed = [finding.what for finding in record.findings if finding.met is False]
    more = f" MISSED: {'; '.join(missed)}." if missed else ""
    return f"{record.name}: {record.sentence}{more} ({seconds:.0f} s)"
