"""`aqualvs reproduce`: run the experiments one after the other and put them on one page."""

import statistics
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from aqualvs.app.disk import writing
from aqualvs.app.overwriting import Claim
from aqualvs.app.reproduce import catalogue
from aqualvs.app.reproduce.experiment import Experiment
from aqualvs.app.reproduce.laboratory import Laboratory
from aqualvs.app.reproduce.page import FRAME, PAGE, write_page
from aqualvs.app.reproduce.progress_bar import experiment_bar
from aqualvs.app.reproduce.records import (
    FIGURES,
    RESULTS,
    SERIES,
    TIMES,
    WORK,
    Record,
    is_reproduced,
    read_results,
    save_outcome,
    work_folder,
    write_results,
)
from aqualvs.errors import OutputError

Tell: TypeAlias = Callable[[str], object]
Load: TypeAlias = Callable[[str], Experiment]

_FAILURES = "failures"
_EXIT_FAILED = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class ReproduceRequest:
    """What is asked for; see `aqualvs reproduce --help`.

    Attributes
    ----------
    names : tuple of str
        Experiments; all of them if empty.
    out : Path
        Folder to write.
    """

    names: tuple[str, ...]
    out: Path


def tell_experiments(tell: Tell) -> None:
    """Tell every experiment's name, title and place in the paper."""
    width = max(map(len, catalogue.MODULES))
    for name in catalogue.MODULES:
        found = catalogue.experiment(name)
        tell(f"{name:<{width}}  {found.title} ({found.paper or 'an ablation of ours'})")


def reproduce(request: ReproduceRequest, tell: Tell, load: Load = catalogue.experiment) -> int:
    """Run experiments, write the page after each of them, and return the exit code.

    Results of other experiments that the same version left in the folder stay on the page.

    Parameters
    ----------
    request : ReproduceRequest
    tell : callable
        Takes one line of text.
    load : callable
        From a name to its experiment.

    Returns
    -------
    exit_code : int
        0, or 1 if an experiment failed.

    Raises
    ------
    OptionError
        If there is no experiment of some name.
    OutputError
        If the folder cannot be written.
    """
    names = catalogue.ordered(request.names)
    # Results of other experiments in the folder stay; those of the same are brought up to date.
    written = (PAGE, RESULTS, TIMES, FIGURES, SERIES, WORK, _FAILURES)
    files = [request.out / name for name in written]
    known = files if is_reproduced(request.out) else []
    claim = Claim("reproduce", files, overwrite=True, known=known)
    with experiment_bar(names) as bar:
        laboratory = Laboratory(work_folder(request.out), bar.tick)
        book = _Book(request.out)
        for number, name in enumerate(names, 1):
            bar.start(name)
            book.run(name, load, laboratory)
            tell(f"[{number}/{len(names)}] {_line(book.records[name], book.seconds[name])}")
            bar.end()
            write_page(book.in_order(), book.seconds, request.out)
    claim.close()
    for line in _closing(book, names, request.out):
        tell(line)
    return _EXIT_FAILED if any(book.records[name].failure for name in names) else 0


class _Book:
    """The records of a folder, on disk after every experiment."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.records, self.seconds = read_results(folder)

    def run(self, name: str, load: Load, laboratory: Laboratory) -> None:
        """Run one experiment and keep what comes of it, whatever that is."""
        started = time.perf_counter()
        self.records[name] = self._record(name, load, laboratory)
        self.seconds[name] = time.perf_counter() - started
        if laboratory.frame_s:
            self.seconds[FRAME] = statistics.median(laboratory.frame_s)
        write_results(self.in_order(), self.seconds, self.folder)

    def in_order(self) -> list[Record]:
        return [self.records[name] for name in catalogue.MODULES if name in self.records]

    def _record(self, name: str, load: Load, laboratory: Laboratory) -> Record:
        found: Experiment | None = None
        try:
            found = load(name)
            record = save_outcome(found, found.run(laboratory), self.folder)
        except OutputError:
            raise
        except Exception as fault:
            # Sixteen other experiments are still worth having.
            self._keep_traceback(name, fault)
            return _failed(name, found, fault)
        (self.folder / _FAILURES / f"{name}.txt").unlink(missing_ok=True)
        return record

    def _keep_traceback(self, name: str, fault: Exception) -> None:
        path = self.folder / _FAILURES / f"{name}.txt"
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text("".join(traceback.format_exception(fault)), encoding="utf-8")


def _failed(name: str, found: Experiment | None, fault: Exception) -> Record:
    said = " ".join(str(fault).split())
    return Record(
        name=name,
        title=found.title if found else name,
        paper=found.paper if found else "",
        about=found.about if found else "",
        failure=f"{type(fault).__name__}: {said}" if said else type(fault).__name__,
    )


def _line(record: Record, seconds: float) -> str:
    if record.failure:
        return (
            f"{record.name}: failed: {record.failure}; the whole story is in "
            f"{_FAILURES}/{record.name}.txt"
        )
    missed = [finding.what for finding in record.findings if finding.met is False]
    more = f" MISSED: {'; '.join(missed)}." if missed else ""
    return f"{record.name}: {record.sentence}{more} ({seconds:.0f} s)"


def _closing(book: _Book, names: Sequence[str], out: Path) -> list[str]:
    bars = [
        finding.met
        for name in names
        for finding in book.records[name].findings
        if finding.met is not None
    ]
    took = sum(book.seconds[name] for name in names)
    failed = [name for name in names if book.records[name].failure]
    lines = [f"{sum(bars)} of {len(bars)} bars met, {took:.0f} s", f"page: {out / PAGE}"]
    if failed:
        lines.insert(0, f"{len(failed)} of {len(names)} experiments failed: {', '.join(failed)}")
    return lines
