"""The folder that `aqualvs reproduce` writes: results, pictures, numbers, and times.

==================  ========================================================================
`reproduce.html`    everything, on one page
`results.json`      all findings; the same version of aqualvs writes the same file
`figures/`          every figure as PNG, PDF and SVG
`series/`           the numbers behind the figures, as CSV
`times.json`        how long each experiment took
`failures/`         the traceback of an experiment that failed
`work/`             rendered dives and what was solved from them, kept so that the same version is
                    faster the next time; can be deleted
==================  ========================================================================
"""

import csv
import hashlib
import json
import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import numpy as np

from aqualvs import __version__
from aqualvs.app.disk import writing
from aqualvs.app.reproduce.experiment import Column, Experiment, Finding, Outcome, Picture, Series
from aqualvs.app.reproduce.style import STYLE

RESULTS, TIMES, FIGURES, SERIES, WORK = "results.json", "times.json", "figures", "series", "work"
DOI = "10.3390/robotics10040126"

_FORMATS: Mapping[str, Mapping[str, str | None]] = {
    "png": {"Software": None},
    "pdf": {"CreationDate": None, "Producer": None, "Creator": None},
    "svg": {"Date": None, "Creator": None},
}
_MADE_BY = "made_by.txt"
# What rounding differs by from run to run stays hidden.
_DIGITS = 7


@dataclass(frozen=True, slots=True, kw_only=True)
class Shown:
    """A figure on disk: stem of its files in `figures/`, its caption, and its width in inches."""

    file: str
    caption: str
    width_in: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Record:
    """An experiment that was run, as `results.json` keeps it.

    Attributes
    ----------
    name, title, paper, about : str
        As in `Experiment`.
    sentence : str
    findings : tuple of Finding
    pictures : tuple of Shown
    series : tuple of str
        Files in `series/`.
    notes : tuple of str
    failure : str
        Why there is no outcome; empty if there is one.
    """

    name: str
    title: str
    paper: str
    about: str
    sentence: str = ""
    findings: tuple[Finding, ...] = ()
    pictures: tuple[Shown, ...] = ()
    series: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    failure: str = ""


def save_outcome(experiment: Experiment, outcome: Outcome, folder: Path) -> Record:
    """Write the figures and series of an outcome and return its record.

    Raises
    ------
    OutputError
        If something cannot be written.
    ValueError
        If the columns of a series differ in length.
    """
    return Record(
        name=experiment.name,
        title=experiment.title,
        paper=experiment.paper,
        about=experiment.about,
        sentence=outcome.sentence,
        findings=outcome.findings,
        pictures=tuple(_save_picture(experiment.name, one, folder) for one in outcome.pictures),
        series=tuple(_save_series(experiment.name, one, folder) for one in outcome.series),
        notes=outcome.notes,
    )


def write_results(records: Sequence[Record], seconds: Mapping[str, float], folder: Path) -> None:
    """Write `results.json` and `times.json`.

    Raises
    ------
    OutputError
        If one of them cannot be written.
    """
    content = {
        "aqualvs": __version__,
        "sources": sources_digest(),
        "paper": f"https://doi.org/{DOI}",
        "experiments": [asdict(record) for record in records],
    }
    _write_json(folder / RESULTS, content)
    _write_json(folder / TIMES, {name: round(value, 1) for name, value in seconds.items()})


def read_results(folder: Path) -> tuple[dict[str, Record], dict[str, float]]:
    """Return what this version left in a folder, and how long it took; nothing of other versions.

    Files that cannot be read count as missing: they are about to be written again.
    """
    try:
        content = json.loads((folder / RESULTS).read_text(encoding="utf-8"))
        if content["sources"] != sources_digest():
            return {}, {}
        records = {one["name"]: _record(one) for one in content["experiments"]}
        times = json.loads((folder / TIMES).read_text(encoding="utf-8"))
        return records, {str(name): float(value) for name, value in times.items()}
    except (OSError, ValueError, TypeError, KeyError):
        return {}, {}


def is_reproduced(folder: Path) -> bool:
    """Return whether the experiments have been run in a folder before, by whichever version."""
    return (folder / WORK / _MADE_BY).is_file()


def work_folder(folder: Path) -> Path:
    """Return the folder for rendered dives, emptied of what another version left in it.

    Raises
    ------
    OutputError
        If it cannot be made.
    """
    work = folder / WORK
    mark = work / _MADE_BY
    with writing(work):
        if mark.is_file() and mark.read_text(encoding="utf-8") != sources_digest():
            shutil.rmtree(work)
        work.mkdir(parents=True, exist_ok=True)
        mark.write_text(sources_digest(), encoding="utf-8")
    return work


@cache
def sources_digest() -> str:
    """Return a digest of the package's sources: what makes one version differ from another."""
    digest = hashlib.sha256(__version__.encode())
    for name, source in sorted(_sources(files("aqualvs"), ""), key=lambda one: one[0]):
        digest.update(name.encode())
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def _sources(folder: Traversable, above: str) -> list[tuple[str, Traversable]]:
    found = []
    for entry in folder.iterdir():
        name = f"{above}/{entry.name}"
        if entry.is_dir():
            found.extend(_sources(entry, name))
        elif name.endswith(".py"):
            found.append((name, entry))
    return found


def _record(content: Mapping[str, Any]) -> Record:
    texts = {key: str(content[key]) for key in ("name", "title", "paper", "about", "sentence")}
    return Record(
        **texts,
        findings=tuple(Finding(**one) for one in content["findings"]),
        pictures=tuple(Shown(**one) for one in content["pictures"]),
        series=tuple(content["series"]),
        notes=tuple(content["notes"]),
        failure=str(content["failure"]),
    )


def _save_picture(name: str, picture: Picture, folder: Path) -> Shown:
    import matplotlib as mpl

    stem = f"{name}_{picture.name}"
    place = folder / FIGURES
    # The salt keeps the identifiers inside an SVG the same from run to run.
    with writing(place), mpl.rc_context({**STYLE, "svg.hashsalt": stem}):
        place.mkdir(parents=True, exist_ok=True)
        for kind, metadata in _FORMATS.items():
            picture.figure.savefig(place / f"{stem}.{kind}", metadata=dict(metadata))
    width = round(float(picture.figure.get_figwidth()), 2)
    return Shown(file=stem, caption=picture.caption, width_in=width)


def _save_series(name: str, series: Series, folder: Path) -> str:
    file = f"{name}_{series.name}.csv"
    columns = [[_cell(value) for value in _plain(column)] for column in series.columns.values()]
    rows = list(zip(*columns, strict=True))
    path = folder / SERIES / file
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("w", newline="", encoding="utf-8") as out:
            table = csv.writer(out, lineterminator="\n")
            table.writerow(series.columns)
            table.writerows(rows)
    return file


def _plain(column: Column) -> list[Any]:
    return column if isinstance(column, list) else np.asarray(column).tolist()


def _cell(value: str | int | float) -> str:
    """Return a value as text; nothing where there is no number."""
    if isinstance(value, float):
        return f"{value:.{_DIGITS}g}" if math.isfinite(value) else ""
    return str(value)


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    text = json.dumps(content, indent=1, ensure_ascii=False) + "\n"
    with writing(path):
        path.write_text(text, encoding="utf-8", errors="replace")
