"""When a dive took place: what the user says, else what its names say, else its video's clock."""

import re
from collections.abc import Sequence
from datetime import UTC, date, datetime
from pathlib import Path

from aqualvs.app.runfile import read_run_yaml
from aqualvs.errors import OptionError, SourceError
from aqualvs.live.logs import dive_start_utc

_NAMED = re.compile(r"(?<!\d)(20\d\d)([-_.]?)(\d\d)\2(\d\d)(?!\d)")
AUTO = "auto"
"""Instead of a date: find it."""


def given_dates(texts: Sequence[str], n: int) -> list[date | None]:
    """Return the dates that the user gives for `n` folders; None where to be found.

    Raises
    ------
    OptionError
        If there is not one for every folder, or one is no date.
    """
    if texts and len(texts) != n:
        raise OptionError(
            f"--date is given {len(texts)} times for {n} folders; give it once for every RUN, in "
            f"their order ({AUTO} where it is to be found)"
        )
    return [_given(text) for text in texts] or [None] * n


def date_of_run(folder: Path) -> tuple[date, str]:
    """Return the day of a run's dive, and what says so.

    The date in the name of its folder counts first, then that in the name of the video, then the
    time that the video's container states. When it was evaluated says nothing.

    Raises
    ------
    OptionError
        If nothing tells.
    """
    source = _source(folder)
    names = [(folder.resolve().name, "the folder's name"), (source.name, "the video's name")]
    for name, words in names:
        found = named_date(name)
        if found is not None:
            return found, words
    start = dive_start_utc(source) if source.is_file() else None
    if start is not None:
        return datetime.fromtimestamp(start, UTC).date(), "the video's clock"
    raise OptionError(
        f"{folder}: neither its name nor its video tells the date of the dive; add --date "
        f"YYYY-MM-DD, once for every RUN in their order ({AUTO} where it is to be found)"
    )


def named_date(name: str) -> date | None:
    """Return the first date in a name such as `cage3_2026-05-01` or `20260501_1030.mp4`."""
    for year, _, month, day in _NAMED.findall(name):
        try:
            return date(int(year), int(month), int(day))
        except ValueError:
            continue
    return None


def _given(text: str) -> date | None:
    if text == AUTO:
        return None
    try:
        return datetime.fromisoformat(text).date()
    except ValueError as fault:
        raise OptionError(f"--date {text}: is no date; write it as 2026-05-01") from fault


def _source(folder: Path) -> Path:
    """Return the video of a run, which may be gone; an empty path where it is not known."""
    try:
        source = read_run_yaml(folder).get("source")
    except SourceError:
        return Path()
    if not isinstance(source, dict):
        return Path()
    return Path(str(source.get("path") or source.get("name") or ""))
