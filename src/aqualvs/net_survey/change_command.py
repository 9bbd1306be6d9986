"""`aqualvs net-change`: the same net compared between dates."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aqualvs.errors import OptionError
from aqualvs.net_survey.comparison import Comparison, compare
from aqualvs.net_survey.page import draw_change, write_page
from aqualvs.net_survey.surveys import (
    Survey,
    check_surveys,
    date_of_run,
    find_runs,
    given_dates,
    left_out,
    read_survey,
)
from aqualvs.net_survey.tables import summary_lines, write_tables
from aqualvs.results.files import Claim, writing

NET_CHANGE_CSV, HOLES_CHANGE_CSV = "net_change.csv", "holes_change.csv"
NET_CHANGE_PNG, NET_CHANGE_HTML = "net_change.png", "net_change.html"
NET_CHANGE_FILES = (NET_CHANGE_CSV, HOLES_CHANGE_CSV, NET_CHANGE_PNG, NET_CHANGE_HTML)
"""What is written."""

_GIVEN = "the user"


@dataclass(frozen=True, slots=True, kw_only=True)
class NetChangeRequest:
    """Request for `aqualvs net-change`.

    Attributes
    ----------
    runs : tuple of Path
        Folders of runs, or of batches.
    out : Path
        Folder to write.
    dates : tuple of str
        None, or one for each of `runs`.
    cell_m : float
        Side of the map's cells.
    overwrite : bool
    """

    runs: tuple[Path, ...]
    out: Path
    dates: tuple[str, ...] = ()
    cell_m: float = 1.0
    overwrite: bool = False

    def __post_init__(self) -> None:
        """Refuse values that cannot be."""
        if not 0.0 < self.cell_m < np.inf:
            raise OptionError(f"--cell-m {self.cell_m:g}: must be positive; correct it")


def net_change(request: NetChangeRequest, echo: Callable[[str], object]) -> Comparison:
    """Compare dives along the same net, write the changes and print them.

    Raises
    ------
    AqualvsError
        If a run cannot be read or a file not be written, or there is nothing to compare.
    """
    surveys, origins = _surveys(request)
    check_surveys(surveys)
    files = [request.out / name for name in NET_CHANGE_FILES]
    with Claim("net-change", files, overwrite=request.overwrite):
        for folder in request.runs:
            for line in left_out(folder):
                echo(line)
        for one in surveys:
            echo(f"{one.folder}: {one.date} ({origins[str(one.folder)]})")
        result = compare(surveys, request.cell_m)
        with writing(request.out):
            write_tables(request.out, result, (NET_CHANGE_CSV, HOLES_CHANGE_CSV))
            draw_change(result, request.out / NET_CHANGE_PNG)
            write_page(request.out / NET_CHANGE_HTML, request.out / NET_CHANGE_PNG, result, origins)
    for line in summary_lines(result):
        echo(line)
    echo(f"page: {request.out / NET_CHANGE_HTML}")
    return result


def _surveys(request: NetChangeRequest) -> tuple[list[Survey], dict[str, str]]:
    """Return the dives, and the source of each date."""
    given = given_dates(request.dates, len(request.runs))
    surveys, origins = [], {}
    for folder, day in zip(request.runs, given, strict=True):
        for run in find_runs(folder):
            found, origin = (day, _GIVEN) if day is not None else date_of_run(run)
            surveys.append(read_survey(run, found))
            origins[str(run)] = origin
    return surveys, origins
