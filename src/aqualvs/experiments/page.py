"""Page and folder of `aqualvs reproduce`: the paper's figures beside ours.

The page is one file that prints well, without scripts or requests to a network; figures are
embedded, and link to the files beside the page. The folder contains

==================  ========================================================================
`reproduce.html`    everything, on one page
`results.json`      all findings; the same version of aqualvs writes the same file
`figures/`          every figure as PNG, PDF and SVG
`series/`           the data of the figures, as CSV
`times.json`        duration of each experiment
`failures/`         tracebacks of failed experiments
`work/`             rendered dives and results of calibrations, which the same version reuses; can
                    be deleted
==================  ========================================================================
"""

import csv
import hashlib
import json
import math
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context

from aqualvs import __version__
from aqualvs.experiments.experiment import (
    DataColumns,
    Experiment,
    ExperimentFigure,
    ExperimentResult,
    ExperimentRow,
)
from aqualvs.report import html
from aqualvs.report.figure_style import STYLE
from aqualvs.report.html import Card
from aqualvs.results.files import writing

RESULTS, TIMES, FIGURES, SERIES, WORK = "results.json", "times.json", "figures", "series", "work"
PAGE, FAILURES = "reproduce.html", "failures"
FILES = (PAGE, RESULTS, TIMES, FIGURES, SERIES, WORK, FAILURES)
"""All files and folders that the command writes into its folder."""
DOI = "10.3390/robotics10040126"

_FORMATS: Mapping[str, Mapping[str, str | None]] = {
    "png": {"Software": None},
    "pdf": {"CreationDate": None, "Producer": None, "Creator": None},
    "svg": {"Date": None, "Creator": None},
}
_MADE_BY = "made_by.txt"


@dataclass(frozen=True, slots=True, kw_only=True)
class PrintedFigure:
    """A figure on disk: stem of its files in `figures/`, its caption, and its width in inches."""

    file: str
    caption: str
    width_in: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Record:
    """Result of an experiment in `results.json`."""

    # As in `Experiment`.
    name: str
    title: str
    paper: str
    about: str

    sentence: str = ""
    findings: tuple[ExperimentRow, ...] = ()
    pictures: tuple[PrintedFigure, ...] = ()
    series: tuple[str, ...] = ()  # Files in `series/`.
    notes: tuple[str, ...] = ()
    failure: str = ""  # Error of a failed experiment; empty if it succeeded.


def save_outcome(
    name: str, experiment: Experiment, outcome: ExperimentResult, folder: Path
) -> Record:
    """Write the figures and series of an experiment's outcome and return its record.

    Raises `OutputError` if something cannot be written. Raises `ValueError` if the columns of a
    series differ in length.
    """
    return Record(
        name=name,
        title=experiment.title,
        paper=experiment.paper,
        about=experiment.about,
        sentence=outcome.sentence,
        findings=outcome.findings,
        pictures=tuple(_save_picture(name, one, folder) for one in outcome.pictures),
        series=tuple(_save_series(name, one, folder) for one in outcome.series),
        notes=outcome.notes,
    )


def write_results(records: Sequence[Record], seconds: Mapping[str, float], folder: Path) -> None:
    """Write `results.json` and `times.json`.

    Raises `OutputError` if one of them cannot be written.
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
    """Return the records and durations of this version in a folder; empty for other versions.

    Files that cannot be read count as missing: they will be written again.
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
    """Return whether any version has run the experiments in a folder before."""
    return (folder / WORK / _MADE_BY).is_file()


def work_folder(folder: Path) -> Path:
    """Return the folder for rendered dives; delete its content if it is of another version.

    Raises `OutputError` if it cannot be created.
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
    """Return a digest of the package's sources, which identifies the version."""
    digest = hashlib.sha256(__version__.encode())
    package = Path(__file__).parents[1]
    sources = [path for path in package.rglob("*") if path.suffix in (".py", ".yaml")]
    names = {f"/{path.relative_to(package).as_posix()}": path for path in sources}
    for name, path in sorted(names.items()):
        digest.update(name.encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _record(content: Mapping[str, Any]) -> Record:
    texts = ("name", "title", "paper", "about", "sentence", "failure")
    return Record(
        **{key: str(content[key]) for key in texts},
        findings=tuple(ExperimentRow(**one) for one in content["findings"]),
        pictures=tuple(PrintedFigure(**one) for one in content["pictures"]),
        series=tuple(content["series"]),
        notes=tuple(content["notes"]),
    )


def _save_picture(name: str, picture: ExperimentFigure, folder: Path) -> PrintedFigure:
    stem = f"{name}_{picture.name}"
    place = folder / FIGURES
    # The salt makes the identifiers in an SVG the same in every run.
    with writing(place), rc_context({**STYLE, "svg.hashsalt": stem}):
        place.mkdir(parents=True, exist_ok=True)
        for kind, metadata in _FORMATS.items():
            picture.figure.savefig(place / f"{stem}.{kind}", metadata=dict(metadata))
    width = round(float(picture.figure.get_figwidth()), 2)
    return PrintedFigure(file=stem, caption=picture.caption, width_in=width)


def _save_series(name: str, series: DataColumns, folder: Path) -> str:
    file = f"{name}_{series.name}.csv"
    # As numbers of Python, so that integers are written without a point.
    plain = (np.asarray(column).tolist() for column in series.columns.values())
    rows = list(zip(*([_cell(value) for value in column] for column in plain), strict=True))
    path = folder / SERIES / file
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("w", newline="", encoding="utf-8") as out:
            table = csv.writer(out, lineterminator="\n")
            table.writerow(series.columns)
            table.writerows(rows)
    return file


def _cell(value: str | int | float) -> str:
    """Return a value as text; empty if it is not finite."""
    # Few enough digits to hide differences by rounding.
    digits = 7
    if isinstance(value, float):
        return f"{value:.{digits}g}" if math.isfinite(value) else ""
    return str(value)


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    text = json.dumps(content, indent=1, ensure_ascii=False) + "\n"
    with writing(path):
        path.write_text(text, encoding="utf-8", errors="replace")


FRAME = "a frame"
"""Key of the scanner's median time for one frame among the durations."""


# A larger SVG, in bytes, is larger than its PNG and opens more slowly.
_LARGEST_SVG = 250_000
# Size of a figure on the page.
_PX_PER_INCH = 125


def write_page(records: Sequence[Record], seconds: Mapping[str, float], folder: Path) -> None:
    """Write the page from records, in their order, and from the figures in the folder.

    `seconds`: durations of experiments, as far as known. Raises `OutputError` if a figure cannot be
    read or the page cannot be written.
    """
    path = folder / PAGE
    with writing(path):
        text = page_html(records, seconds, folder)
        path.write_text(text, encoding="utf-8", errors="replace")


def page_html(records: Sequence[Record], seconds: Mapping[str, float], folder: Path) -> str:
    """Return the page as HTML; see `write_page`.

    Raises `OSError` if a figure cannot be read.
    """
    content = {
        "title": "The paper’s experiments and ours",
        "version": __version__,
        "doi": DOI,
        "results": RESULTS,
        "records": records,
        "times": {name: duration(seconds[name]) for name in seconds},
        "with_bar": with_bar(records),
        "bar_text": _bar_text,
        "picture": lambda printed: _picture(printed, folder),
        "cards": html.cards(_cards(records, seconds)),
        "warnings": _notice(records),
    }
    return html.page("reproduce.html", content)


def _cards(records: Sequence[Record], seconds: Mapping[str, float]) -> Iterator[Card]:
    bars = [finding.met for _, finding in with_bar(records)]
    done = sum(not record.failure for record in records)
    took = sum(seconds.get(record.name, 0.0) for record in records)
    yield Card("bars met", f"{sum(map(bool, bars))} of {len(bars)}", "our criterion")
    yield Card("experiments", f"{done} of {len(records)}", "done; each can be run alone")
    yield Card("time", duration(took), f"on {os.cpu_count() or 1} cores")
    papers_fps = 25
    if FRAME in seconds:
        rate = 1.0 / seconds[FRAME]
        yield Card("speed", f"{rate:.0f} fps", f"scanning, median frame; the paper: {papers_fps}")


def _notice(records: Sequence[Record]) -> str:
    lines = [f"{record.name} failed: {record.failure}" for record in records if record.failure]
    lines += [
        f"{record.name}: {finding.what}: {finding.ours}, bar {_bar_text(finding.bar)}"
        for record, finding in with_bar(records)
        if not finding.met
    ]
    return html.notice(lines) if lines else ""


def with_bar(records: Sequence[Record]) -> list[tuple[Record, ExperimentRow]]:
    """Return the findings that have a criterion, with their records."""
    return [
        (record, finding)
        for record in records
        for finding in record.findings
        if finding.met is not None
    ]


def _bar_text(bar: str) -> str:
    # No line break between sign and number.
    return bar.replace("<= ", "≤\u00a0").replace(">= ", "≥\u00a0")


def _picture(printed: PrintedFigure, folder: Path) -> tuple[str, str]:
    """Return a figure as a data URL, and the style with its width."""
    drawing, pixels = (folder / FIGURES / f"{printed.file}.{kind}" for kind in ("svg", "png"))
    width = f"max-width: {_PX_PER_INCH * printed.width_in:.0f}px"
    if drawing.stat().st_size <= _LARGEST_SVG:
        return html.data_url(drawing.read_bytes(), "svg+xml"), width
    return html.data_url(pixels.read_bytes(), "png"), width


def duration(seconds: float) -> str:
    """Return a duration as text."""
    if seconds < 10.0:
        return f"{seconds:.1f} s"
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s"
