"""`python -m benchmarks [WORD...]`: measure, show a table for each group, and keep the figures.

A benchmark is a module bench_*.py with `run()`, or `run(quick)`, which returns rows with `name`,
`value`, `unit`, `reference` (the same job done plainly in the same run, or where nobody can do it
plainly the figure that was asked for; None where there is neither) and `ratio` (how many times
better than the reference).
"""

import argparse
import importlib
import inspect
import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType

from benchmarks.history import DEFAULT, Entry, Row, append, before, change, entry_now, read, row_of
from benchmarks.history import machine as this_machine
from rich.console import Console
from rich.table import Table

from aqualvs.errors import AqualvsError
from aqualvs.geometry.compiled import compiled_at_once

# Minutes each, most of it spent on accuracy or on playing in real time.
_SLOW = frozenset(
    {"bench_batch", "bench_control", "bench_live", "bench_net_condition", "bench_nets"}
)
# Dives that tests make as well.
sys.path.append(str(Path(__file__).parents[1] / "tests" / "helpers"))
# Columns, where the output is no terminal that says how wide it is.
_WIDTH = 120
# Ratios of the same code wander by so much from run to run.
_NOISE = 0.25


def names(words: Sequence[str], *, quick: bool = False) -> list[str]:
    """Return the benchmarks beside this file that contain one of the words, or all of them."""
    found = sorted(path.stem for path in Path(__file__).parent.glob("bench_*.py"))
    chosen = [name for name in found if not words or any(word in name for word in words)]
    return [name for name in chosen if not (quick and name in _SLOW)]


def rows_of(module: ModuleType, group: str, *, quick: bool) -> list[Row]:
    """Run one benchmark; ValueError where a row lacks a key."""
    can_be_quick = "quick" in inspect.signature(module.run).parameters
    with compiled_at_once():
        found = module.run(quick=quick) if can_be_quick else module.run()
    return [row_of(group, one) for one in found]


def main(arguments: Sequence[str]) -> int:
    """Measure, show and keep; 1 where a benchmark failed, 2 where there is nothing to do."""
    options = _options(arguments)
    console = Console()
    if not console.is_terminal:
        console.width = _WIDTH
    chosen = names(options.words, quick=options.quick)
    if not chosen:
        console.print("no benchmark of that name", style="red")
        return 2
    try:
        entries = read(options.against or options.history)
        read(options.history)
        then = before(entries, this_machine(), quick=options.quick)
        began = time.perf_counter()
        rows, failed = _measure(chosen, then, console, quick=options.quick)
        entry = entry_now(rows, failed, quick=options.quick)
        append(options.history, entry)
    except AqualvsError as fault:
        console.print(str(fault), style="red", markup=False)
        return 2
    if options.quick:
        console.print(f"left out by --quick: {', '.join(sorted(map(_group, _SLOW)))}")
    console.print(verdict(entry, then, time.perf_counter() - began), markup=False, soft_wrap=True)
    console.print(f"kept in {options.history}", markup=False, soft_wrap=True)
    return 1 if failed else 0


def _options(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("words", nargs="*", metavar="WORD", help="only those whose name has it")
    parser.add_argument("--quick", action="store_true", help="fewer rounds, and none of the slow")
    parser.add_argument("--history", type=Path, default=DEFAULT, metavar="FILE")
    parser.add_argument(
        "--against", type=Path, metavar="FILE", help="compare with another history than one's own"
    )
    return parser.parse_args(arguments)


def _measure(
    chosen: Sequence[str], then: Mapping[tuple[str, str], Row], console: Console, *, quick: bool
) -> tuple[list[Row], list[str]]:
    rows: list[Row] = []
    failed: list[str] = []
    for name in chosen:
        began = time.perf_counter()
        try:
            module = importlib.import_module(f"benchmarks.{name}")
            mine = rows_of(module, _group(name), quick=quick)
        except Exception as error:  # one broken benchmark must not hide the others
            failed.append(f"{_group(name)}: {type(error).__name__}: {error}")
            console.print(f"{_group(name)} failed: {failed[-1]}", style="red", markup=False)
            continue
        seconds = f"({time.perf_counter() - began:.0f} s)"
        console.print(f"{title(name, module)} {seconds}", style="bold", markup=False)
        console.print(table(mine, then))
        rows += mine
    return rows, failed


def title(name: str, module: ModuleType) -> str:
    """Return the name of a group and what it is about, from the first line of its module."""
    lines = (module.__doc__ or "").strip().splitlines()
    return f"{_group(name)}: {lines[0].rstrip('.')}" if lines else _group(name)


def table(rows: Sequence[Row], then: Mapping[tuple[str, str], Row]) -> Table:
    """Return the table of one group: how many times better than the reference and than before."""
    shown = Table("what", box=None)
    for column in ("value", "unit", "reference", "better", "before"):
        shown.add_column(column, justify="left" if column == "unit" else "right", no_wrap=True)
    for row in rows:
        better = change(row, then.get(row.key))
        cells = [_shown(row.value), row.unit, _shown(row.reference), _times(row.ratio)]
        shown.add_row(row.name, *cells, _times(better))
    return shown


def verdict(entry: Entry, then: Mapping[tuple[str, str], Row], elapsed_s: float) -> str:
    """Say in one line how it went."""
    ratios = [row.ratio for row in entry.rows if row.ratio is not None]
    reached = sum(ratio >= 1.0 for ratio in ratios)
    said = [
        f"{len(entry.rows)} rows in {elapsed_s:.0f} s",
        f"{reached} of {len(ratios)} reach their reference",
        _compared(entry.rows, then),
    ]
    if entry.load > 1.5 * entry.machine.cores:
        said.append(f"the machine was busy ({entry.load:g} processes, {entry.machine.cores} cores)")
    if entry.failed:
        said.append(f"FAILED: {', '.join(one.split(':')[0] for one in entry.failed)}")
    return "; ".join(said)


def _compared(rows: Sequence[Row], then: Mapping[tuple[str, str], Row]) -> str:
    changes = {row.key: change(row, then.get(row.key)) for row in rows}
    known = {key: value for key, value in changes.items() if value is not None}
    if not known:
        return "nothing to compare with on this machine yet"
    middle = f"{len(known)} compared with before: median x{statistics.median(known.values()):.2f}"
    fallen = sum(value < 1.0 - _NOISE for value in known.values())
    if not fallen:
        return f"{middle}, none fell by more than {100 * _NOISE:.0f} %"
    (group, name), least = min(known.items(), key=lambda one: one[1])
    worst = f"most of all {group}/{name} (x{least:.2f})"
    return f"{middle}, {fallen} fell by more than {100 * _NOISE:.0f} %, {worst}"


def _group(name: str) -> str:
    return name.removeprefix("bench_")


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _times(value: float | None) -> str:
    return "-" if value is None else f"x{value:.3g}"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
