"""What was measured before, and on which machine: one JSON file that every run appends to."""

import json
import math
import os
import platform
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from aqualvs.errors import OutputError, SourceError
from aqualvs.workers.start_method import n_cores

DEFAULT = Path("out/bench/history.json")
FORMAT = 1
_FIELDS = ("name", "value", "unit", "reference", "ratio")


@dataclass(frozen=True, slots=True)
class Row:
    """One figure; `ratio` says how many times better than the reference."""

    group: str
    name: str
    value: float | None
    unit: str
    reference: float | None
    ratio: float | None

    @property
    def key(self) -> tuple[str, str]:
        return self.group, self.name


@dataclass(frozen=True, slots=True)
class Machine:
    """What a figure depends on; figures of two machines are never compared."""

    system: str
    cpu: str
    cores: int
    python: str


@dataclass(frozen=True, slots=True)
class Entry:
    """One run.

    `when` is UTC in ISO 8601; `commit` is empty outside a git repository and ends in + where files
    differ from it; `load` are the processes that wanted to run, averaged over a minute.
    """

    when: str
    version: str
    commit: str
    machine: Machine
    load: float
    quick: bool
    rows: tuple[Row, ...]
    failed: tuple[str, ...]


def row_of(group: str, found: Mapping[str, Any]) -> Row:
    """Take over a benchmark's row; ValueError where it lacks a key."""
    missing = [key for key in _FIELDS if key not in found]
    if missing:
        raise ValueError(f"a row of {group} lacks {', '.join(missing)}")
    numbers = {key: _number(found[key]) for key in ("value", "reference", "ratio")}
    return Row(group, str(found["name"]), unit=str(found["unit"]), **numbers)


def _number(value: Any) -> float | None:
    """JSON has no word for what is not finite; a figure that is not is none."""
    return float(value) if value is not None and math.isfinite(value) else None


def entry_now(rows: Iterable[Row], failed: Iterable[str], *, quick: bool) -> Entry:
    """Describe the run that ends now."""
    return Entry(
        when=datetime.now(UTC).isoformat(timespec="seconds"),
        version=version("aqualvs"),
        commit=commit_of(Path(__file__).parent),
        machine=machine(),
        load=round(os.getloadavg()[0], 1) if hasattr(os, "getloadavg") else 0.0,
        quick=quick,
        rows=tuple(rows),
        failed=tuple(failed),
    )


def machine() -> Machine:
    """Describe this machine; cores are those that the process may use."""
    python = f"{platform.python_implementation()} {platform.python_version()}"
    return Machine(f"{platform.system()} {platform.machine()}", _cpu(), n_cores(), python)


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    names = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor())


def commit_of(folder: Path) -> str:
    """Return the short name of the commit, with + where files differ; empty without git."""
    try:
        name = _git(folder, "rev-parse", "--short", "HEAD")
        changed = _git(folder, "status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.SubprocessError):
        return ""
    return name + ("+" if changed else "")


def _git(folder: Path, *arguments: str) -> str:
    done = subprocess.run(
        ["git", *arguments], cwd=folder, capture_output=True, text=True, timeout=30, check=True
    )
    return done.stdout.strip()


def read(path: Path) -> list[Entry]:
    """Return all runs, oldest first; none where there is no file.

    Raises
    ------
    SourceError
        If the file is no history, or one of another format.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        if document["format"] != FORMAT:
            raise ValueError(f"format {document['format']}, not {FORMAT}")
        return [_entry(one) for one in document["entries"]]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, KeyError, TypeError) as fault:
        raise SourceError(
            f"{path}: no history of benchmarks ({fault}); move it away or name another file"
        ) from fault


def _entry(found: Mapping[str, Any]) -> Entry:
    rows = tuple(Row(**row) for row in found["rows"])
    return Entry(
        **{
            **found,
            "machine": Machine(**found["machine"]),
            "rows": rows,
            "failed": tuple(found["failed"]),
        }
    )


def append(path: Path, entry: Entry) -> None:
    """Add a run; the file is replaced as a whole, so that it is never half written.

    Raises
    ------
    SourceError
        If what is there is no history; it stays as it is.
    OutputError
        If the file cannot be written.
    """
    entries = [asdict(one) for one in (*read(path), entry)]
    text = json.dumps({"format": FORMAT, "entries": entries}, indent=1, allow_nan=False)
    fresh = path.with_name(f"{path.name}.{os.getpid()}.new")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        fresh.write_text(text + "\n", encoding="utf-8")
        fresh.replace(path)
    except OSError as fault:
        raise OutputError(f"{path}: cannot be written ({fault.strerror}); name another") from fault


def before(entries: Sequence[Entry], here: Machine, *, quick: bool) -> dict[tuple[str, str], Row]:
    """Return the newest row of every name that the same machine measured in the same way."""
    like = (one for one in entries if one.machine == here and one.quick == quick)
    return {row.key: row for one in like for row in one.rows}


def change(now: Row, then: Row | None) -> float | None:
    """Return how many times better a row is than before; None where that cannot be told.

    Ratios to the reference of the same run are compared, because what else the machine was doing
    slows both alike; values alone never are.
    """
    if then is None or not now.ratio or not then.ratio:
        return None
    return now.ratio / then.ratio
