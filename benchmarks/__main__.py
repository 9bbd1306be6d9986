"""`python -m benchmarks [WORD...]`: run every bench_*.py whose name contains a word, one table.

A benchmark is a module with `run()`, which returns rows with `name`, `value`, `unit`, `reference`
(None where nobody has published a figure) and `ratio` (how many times better than the reference).
"""

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

_KEYS = ("name", "value", "unit", "reference", "ratio")


def names(words: Sequence[str]) -> list[str]:
    """Return the benchmarks beside this file that contain one of the words, or all of them."""
    found = sorted(path.stem for path in Path(__file__).parent.glob("bench_*.py"))
    return [name for name in found if not words or any(word in name for word in words)]


def rows_of(name: str) -> list[dict[str, Any]]:
    """Run one benchmark; ValueError where a row lacks a key."""
    rows: list[dict[str, Any]] = importlib.import_module(f"benchmarks.{name}").run()
    for row in rows:
        missing = [key for key in _KEYS if key not in row]
        if missing:
            raise ValueError(f"a row of {name} lacks {', '.join(missing)}")
    return rows


def main(words: Sequence[str]) -> int:
    """Print the table; 1 where a benchmark failed or none was found."""
    table = Table("benchmark", "what", box=None)
    for column in ("value", "unit", "reference", "times better"):
        table.add_column(column, justify="left" if column == "unit" else "right")
    console, failed = Console(), []
    chosen = names(words)
    for name in chosen:
        try:
            for row in rows_of(name):
                table.add_row(name.removeprefix("bench_"), *map(_shown, (row[k] for k in _KEYS)))
        except Exception as error:  # one broken benchmark must not hide the others
            failed.append(f"{name} failed: {type(error).__name__}: {error}")
    console.print(table)
    for line in failed or ([] if chosen else ["no benchmark of that name"]):
        console.print(line, style="red", markup=False)
    return 1 if failed or not chosen else 0


def _shown(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
