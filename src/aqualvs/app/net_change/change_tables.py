"""`net_change.csv` and `holes_change.csv`."""

from pathlib import Path

import numpy as np

from aqualvs.app.net_change.cells import CellChange, Growth
from aqualvs.app.net_change.comparison import Comparison, OnWall
from aqualvs.app.net_change.frames import WallFrame
from aqualvs.app.net_change.hole_sites import HoleState, Site
from aqualvs.app.net_change.words import bearing_deg
from aqualvs.app.net_tables import Cell, write_table
from aqualvs.geometry.arrays import FloatArray

_DATES = ("first_date", "last_date", "n_dates")
NET_CHANGE_COLUMNS = (
    *("cell", "depth_from_m", "depth_to_m", "bearing_from_deg", "bearing_to_deg"),
    *("along_from_m", "along_to_m", *_DATES),
    *("solidity_before", "sigma_before", "solidity_after", "sigma_after"),
    *("difference", "sigma_difference", "z", "per_day", "sigma_per_day", "change"),
    *("excess_per_day", "sigma_excess", "beside"),
    *("seen_before_m", "seen_after_m"),
)
"""Columns of `net_change.csv`: one row for every cell seen on two dates; `cell` is `all` where
places cannot be compared."""
HOLES_CHANGE_COLUMNS = (
    *("site", "state", "depth_m", "sigma_depth_m", "bearing_deg", "sigma_bearing_deg"),
    *("along_m", "sigma_along_m", "diameter_before_mm", "sigma_before_mm"),
    *("diameter_after_mm", "sigma_after_mm", "first_seen", "last_seen", "looked_before"),
    *("looked_after", "missed", "holes"),
)
"""Columns of `holes_change.csv`: one row for every place with a hole on one date or more."""

NOT_COMPARED = "not compared"
_PLACES, _SHARES, _RATES = 3, 4, 6


def cell_rows(result: Comparison) -> list[dict[str, Cell]]:
    """Return the rows of `net_change.csv`."""
    if result.wall is None:
        return _whole_rows(result)
    wall = result.wall
    return [_cell_row(one, wall) for one in wall.cells]


def hole_rows(result: Comparison) -> list[dict[str, Cell]]:
    """Return the rows of `holes_change.csv`."""
    if result.wall is not None:
        wall = result.wall
        return [_site_row(i, one, wall) for i, one in enumerate(wall.sites)]
    rows: list[dict[str, Cell]] = []
    for survey in result.surveys:
        for number, diameter, sigma in zip(
            survey.holes.number, survey.holes.diameter, survey.holes.sigma, strict=True
        ):
            row = dict.fromkeys(HOLES_CHANGE_COLUMNS, None) | {
                "site": len(rows) + 1,
                "state": NOT_COMPARED,
                "first_seen": survey.date.isoformat(),
                "last_seen": survey.date.isoformat(),
                "holes": f"{survey.name}:{number}",
            }
            when = "before" if survey.date < result.dates[-1] else "after"
            row |= {f"diameter_{when}_mm": _mm(diameter), f"sigma_{when}_mm": _mm(sigma)}
            rows.append(row)
    return rows


def write_tables(folder: Path, result: Comparison, names: tuple[str, str]) -> None:
    """Write both tables.

    Raises
    ------
    OSError
        As the system says it.
    """
    write_table(folder / names[0], NET_CHANGE_COLUMNS, cell_rows(result))
    write_table(folder / names[1], HOLES_CHANGE_COLUMNS, hole_rows(result))


def _whole_rows(result: Comparison) -> list[dict[str, Cell]]:
    known = [(d, one) for d, one in zip(result.dates, result.whole, strict=True) if one]
    if len(known) < 2 or result.rate is None:
        return []
    (first, before), (last, after) = known[0], known[-1]
    change = Growth(after.value - before.value, float(np.hypot(before.sigma, after.sigma)))
    seen = [
        sum(
            float(s.stretches.seen[s.stretches.usable].sum()) for s in result.surveys if s.date == d
        )
        for d in (first, last)
    ]
    row = dict.fromkeys(NET_CHANGE_COLUMNS, None)
    row |= {"cell": "all", "first_date": first.isoformat(), "last_date": last.isoformat()}
    row |= {"n_dates": len(known), **_numbers(before, after, change, result.rate)}
    row |= {"change": _change(change, abs(change.z) > 2.0)}
    return [row | {"seen_before_m": round(seen[0], 1), "seen_after_m": round(seen[1], 1)}]


def _cell_row(one: CellChange, wall: OnWall) -> dict[str, Cell]:
    raster, dates = wall.history.raster, wall.history.dates
    middle = raster.middle(np.array(one.cell))
    low, high = middle - 0.5 * raster.size, middle + 0.5 * raster.size
    row: dict[str, Cell] = dict.fromkeys(NET_CHANGE_COLUMNS, None)
    row |= {"cell": one.cell, **_between("depth", "m", float(low[1]), float(high[1]))}
    if wall.frame.round:
        ends = (bearing_deg(float(at), wall.frame) for at in (low[0], high[0]))
        row |= _between("bearing", "deg", *ends)
    else:
        row |= _between("along", "m", float(low[0]), float(high[0]))
    row |= {"first_date": dates[one.first].isoformat(), "last_date": dates[one.last].isoformat()}
    row |= {"n_dates": one.n_dates, **_numbers(one.before, one.after, one.difference, one.per_day)}
    row |= {"change": _change(one.difference, one.changed)}
    row |= {"excess_per_day": round(one.excess.value, _RATES)}
    row |= {"sigma_excess": round(one.excess.sigma, _RATES), "beside": _beside(one)}
    return row | {"seen_before_m": round(one.seen[0], 1), "seen_after_m": round(one.seen[1], 1)}


def _between(name: str, unit: str, low: float, high: float) -> dict[str, Cell]:
    return {
        f"{name}_from_{unit}": round(low, _PLACES),
        f"{name}_to_{unit}": round(high, _PLACES),
    }


def _numbers(before: Growth, after: Growth, change: Growth, rate: Growth) -> dict[str, Cell]:
    return {
        "solidity_before": round(before.value, _SHARES),
        "sigma_before": round(before.sigma, _SHARES),
        "solidity_after": round(after.value, _SHARES),
        "sigma_after": round(after.sigma, _SHARES),
        "difference": round(change.value, _SHARES),
        "sigma_difference": round(change.sigma, _SHARES),
        "z": round(change.z, 2),
        "per_day": round(rate.value, _RATES),
        "sigma_per_day": round(rate.sigma, _RATES),
    }


def _change(difference: Growth, beyond: bool) -> str:
    if not beyond:
        return "not told"
    return "more" if difference.value > 0.0 else "less"


def _beside(one: CellChange) -> str:
    if not one.apart:
        return "as the rest"
    return "faster" if one.excess.value > 0.0 else "slower"


def _site_row(i: int, one: Site, wall: OnWall) -> dict[str, Cell]:
    dates = wall.history.dates
    seen = np.flatnonzero(np.isfinite(one.sizes))
    before = seen[seen < len(dates) - 1]
    row: dict[str, Cell] = dict.fromkeys(HOLES_CHANGE_COLUMNS, None)
    row |= {"site": i + 1, "state": one.state.value, **_place(one.place, one.sigma, wall.frame)}
    if len(before):
        k = before[-1]
        row |= {"diameter_before_mm": _mm(one.sizes[k])}
        row |= {"sigma_before_mm": _mm(one.sigma_sizes[k])}
    if seen[-1] == len(dates) - 1:
        row |= {"diameter_after_mm": _mm(one.sizes[-1]), "sigma_after_mm": _mm(one.sigma_sizes[-1])}
    row |= {
        "first_seen": dates[seen[0]].isoformat(),
        "last_seen": dates[seen[-1]].isoformat(),
        "looked_before": round(float(one.looked[:-1].max()), 2),
        "looked_after": round(float(one.looked[-1]), 2),
        "holes": " ".join(one.numbers),
    }
    if one.state in (HoleState.NEW, HoleState.GONE):
        row |= {"missed": round(one.missed, 3)}
    return row


def _place(place: FloatArray, sigma: FloatArray, frame: WallFrame) -> dict[str, Cell]:
    found: dict[str, Cell] = {
        "depth_m": round(float(place[1]), _PLACES),
        "sigma_depth_m": round(float(sigma[1]), _PLACES),
    }
    if not frame.round:
        return found | {
            "along_m": round(float(place[0]), _PLACES),
            "sigma_along_m": round(float(sigma[0]), _PLACES),
        }
    degrees = float(np.rad2deg(sigma[0] / frame.radius))
    return found | {
        "bearing_deg": round(bearing_deg(float(place[0]), frame), 1),
        "sigma_bearing_deg": round(degrees, 1),
    }


def _mm(metres: float) -> float:
    return round(1e3 * float(metres), 1)
