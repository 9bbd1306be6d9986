"""Comparison of dives along the same net: from the files of the runs to the changes."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import date

import numpy as np

from aqualvs.net_survey.alignment import SurveyShift, align, shifted
from aqualvs.net_survey.frames import (
    PlacedSurvey,
    WallFrame,
    common_frame,
    has_places,
    place_survey,
)
from aqualvs.net_survey.growth import (
    COMMON,
    SIGMA_SCALE,
    CellChange,
    Growth,
    WallHistory,
    cell_changes,
    date_means,
    history,
    wall_growth,
)
from aqualvs.net_survey.hole_sites import Site, find_sites
from aqualvs.net_survey.surveys import Survey

# Dives along nets whose bars differ by so much, as a share, are hardly of one net.
_OTHER_NET = 0.1


@dataclass(frozen=True, slots=True)
class OnWall:
    """Changes by place: cells and hole sites on the wall.

    Attributes
    ----------
    frame : WallFrame
    placed : list of PlacedSurvey
        Dives in the common frame, shifted.
    shifts : list of SurveyShift
        Theirs.
    history : WallHistory
    cells : list of CellChange
    growth : Growth or None
        Per day, over all cells seen on two dates; None without one.
    means : list of Growth or None
        Of the cells seen on every date, date by date.
    sites : list of Site
        Holes.
    """

    frame: WallFrame
    placed: list[PlacedSurvey]
    shifts: list[SurveyShift]
    history: WallHistory
    cells: list[CellChange]
    growth: Growth | None
    means: list[Growth | None]
    sites: list[Site]


@dataclass(frozen=True, slots=True)
class Comparison:
    """Result of comparing dives along the same net.

    Attributes
    ----------
    surveys : list of Survey
        In the order of time.
    dates : list of date
    whole : list of Growth or None
        Mean solidity of all that was seen, date by date: of other parts of the net, perhaps.
    rate : Growth or None
        Change of that per day.
    wall : OnWall or None
        None where places cannot be compared.
    warnings : list of str
    """

    surveys: list[Survey]
    dates: list[date]
    whole: list[Growth | None]
    rate: Growth | None
    wall: OnWall | None
    warnings: list[str]


def compare(surveys: Sequence[Survey], cell: float) -> Comparison:
    """Compare dives along the same net.

    Parameters
    ----------
    surveys : sequence
        Of two dates or more.
    cell : float
        Side of the cells in metres.
    """
    ordered = sorted(surveys, key=lambda one: (one.date, one.name))
    dates = sorted({one.date for one in ordered})
    whole = [_whole(one for one in ordered if one.date == day) for day in dates]
    warnings = _warnings(ordered)
    frame, why = common_frame(ordered)
    wall = None
    if frame is None:
        warnings.append(f"places are not compared, only whole dives: {why}")
    else:
        wall, more = _on_wall(ordered, frame, cell)
        warnings += more
    return Comparison(ordered, dates, whole, _rate(dates, whole), wall, warnings)


def _on_wall(
    surveys: Sequence[Survey], frame: WallFrame, cell: float
) -> tuple[OnWall | None, list[str]]:
    placed: list[PlacedSurvey] = []
    shifts: list[SurveyShift] = []
    warnings = []
    for survey in surveys:
        one = place_survey(survey, frame)
        if not has_places(survey) or not len(one.rows):
            warnings.append(f"{survey.folder}: has no places on the net and is left out of the map")
            continue
        shift = align(one, placed, frame) if placed else SurveyShift.first()
        if not frame.round and not shift.told[0]:
            warnings.append(
                f"{survey.folder}: growth and holes do not tell how it lies along the net beside "
                "earlier dives, and it is left out of the map"
            )
            continue
        if not shift.told.all():
            warnings.append(_not_aligned(survey, shift, frame))
        placed.append(shifted(one, shift))
        shifts.append(shift)
    if len({one.survey.date for one in placed}) < 2:
        warnings.append("places are not compared, only whole dives: fewer than two dates are left")
        return None, warnings
    wall = history(placed, shifts, frame, cell)
    return OnWall(
        frame,
        placed,
        shifts,
        wall,
        cell_changes(wall),
        wall_growth(wall),
        date_means(wall),
        find_sites(placed, shifts, frame),
    ), warnings


def _not_aligned(survey: Survey, shift: SurveyShift, frame: WallFrame) -> str:
    parts = []
    if not shift.told[0]:
        parts.append(f"bearing (± {np.rad2deg(shift.sigma[0] / frame.radius):.0f}°)")
    if not shift.told[1]:
        parts.append(f"depth (± {shift.sigma[1]:.1f} m)")
    return (
        f"{survey.folder}: growth and holes do not tell how its {' and '.join(parts)} "
        f"lie{'s' if len(parts) == 1 else ''} beside earlier dives; taken as logged"
    )


def _whole(surveys: Iterable[Survey]) -> Growth | None:
    """Return the mean solidity of a date's dives, weighed by what was seen."""
    value = seen = own = common = 0.0
    for survey in surveys:
        one = survey.stretches
        good = one.usable
        weight, sigma = one.seen[good], SIGMA_SCALE * one.sigma[good]
        value += float(weight @ one.solidity[good])
        own += (1.0 - COMMON) * float(weight**2 @ sigma**2)
        common += COMMON * float(weight @ sigma) ** 2
        seen += float(weight.sum())
    return Growth(value / seen, float(np.sqrt(own + common)) / seen) if seen > 0.0 else None


def _rate(dates: Sequence[date], whole: Sequence[Growth | None]) -> Growth | None:
    known = [(day.toordinal(), one) for day, one in zip(dates, whole, strict=True) if one]
    if len(known) < 2:
        return None
    days = np.array([day for day, _ in known], np.float64)
    weights = np.array([one.sigma for _, one in known]) ** -2
    off = days - weights @ days / weights.sum()
    factors = weights * off / (weights @ off**2)
    value = factors @ np.array([one.value for _, one in known])
    return Growth(float(value), float(np.sqrt(factors**2 @ (1.0 / weights))))


def _warnings(surveys: Sequence[Survey]) -> list[str]:
    found = []
    bars = [one.facts.get("summary", {}).get("bar_mm") for one in surveys]
    known = [bar for bar in bars if isinstance(bar, int | float)]
    if known and max(known) > (1.0 + _OTHER_NET) * min(known):
        found.append(
            f"meshes differ, from {min(known):.1f} to {max(known):.1f} mm bar: is it the same net?"
        )
    twines = {one.facts.get("options", {}).get("twine_mm") for one in surveys}
    if len(twines) > 1:
        found.append(
            "the twine was given (--twine-mm) for some runs and not, or differently, for others: "
            "solidity may differ for that alone"
        )
    for one in surveys:
        slip = one.facts.get("summary", {}).get("track_slip_m")
        if isinstance(slip, int | float) and slip > 0.0:
            found.append(
                f"{one.folder}: its track and its log part by {slip:.1f} m in height; its places "
                "and the sizes of its holes are not to be trusted"
            )
    return found
