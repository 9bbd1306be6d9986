"""Tables and sentences of a comparison: `net_change.csv`, `holes_change.csv`, and the summary."""

from collections.abc import Iterator, Sequence
from datetime import date

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.net_survey.comparison import LOOKED, Comparison, HoleState, OnWall, Site
from aqualvs.net_survey.frames import WallFrame
from aqualvs.net_survey.growth import CellChange, Growth
from aqualvs.nets.tables import Cell
from aqualvs.text import count_text, with_sign

STATE_TITLES = {
    HoleState.NEW: "new",
    HoleState.GROWN: "grown",
    HoleState.GONE: "gone, repaired or missed this time",
    HoleState.FIRST_LOOK: "seen now, where no earlier dive looked",
    HoleState.NOT_PASSED: "seen before, where no dive looked now",
    HoleState.SMALLER: "smaller, partly repaired or partly seen",
    HoleState.SAME: "the same",
}
"""How sentences call what became of a hole; what matters most comes first."""


def dives_text(result: Comparison) -> str:
    """Return how many dives and dates are compared."""
    dives, dates = len(result.surveys), len(result.dates)
    return f"{count_text(dives, 'dive')} on {count_text(dates, 'date')}"


def summary_lines(result: Comparison) -> list[str]:
    """Return the whole comparison in lines."""
    first, last, wall = result.dates[0], result.dates[-1], result.wall
    lines = [f"{dives_text(result)}, {first} to {last} ({count_text((last - first).days, 'day')})"]
    if wall is None:
        lines += [_whole_line(result), _hole_counts(result)]
    else:
        lines += [*_shift_lines(wall), _growth_line(wall), *_where_lines(wall)]
        lines += [*_mean_lines(wall), *_hole_lines(wall), *_not_looked(wall)]
    return lines + [f"warning: {one}" for one in result.warnings]


def place_text(place: FloatArray, frame: WallFrame) -> str:
    """Return where on the net something is."""
    if frame.round:
        return f"{place[1]:.1f} m deep, bearing {bearing_deg(place[0], frame):.0f}°"
    return f"{place[1]:.1f} m deep, {place[0]:.1f} m along"


def bearing_deg(u: float, frame: WallFrame) -> float:
    """Return the bearing of a place around a round net, in [0, 360)."""
    return float(np.rad2deg(u / frame.radius)) % 360.0


def rate_text(growth: Growth) -> str:
    """Return growth as percent of the net's area a week."""
    days = 7.0
    week, sigma = 100.0 * days * growth.value, 100.0 * days * growth.sigma
    return f"{with_sign(week, 1)} ± {sigma:.1f} % of the net's area a week"


def verdict(growth: Growth) -> str:
    """Return whether a growth is beyond its uncertainty."""
    # Beyond this many standard deviations a change is called one.
    min_z = 2.0
    if abs(growth.z) < min_z:
        return "no change beyond the uncertainty"
    return "fouling has grown" if growth.value > 0.0 else "fouling has become less"


def by_state(sites: Sequence[Site]) -> dict[HoleState, list[Site]]:
    """Return the holes by what became of them, what matters most first."""
    found = {state: [one for one in sites if one.state is state] for state in STATE_TITLES}
    return {state: some for state, some in found.items() if some}


def size_text(site: Site) -> str:
    """Return a hole's diameter when last seen, after that before if it is still there."""
    known = np.isfinite(site.sizes)
    last = site.sizes[known][-2:] if known[-1] else site.sizes[known][-1:]
    sizes = [f"{1e3 * size:.0f}" for size in last]
    sigma = 1e3 * float(site.sigma_sizes[known][-1])
    return f"{' -> '.join(sizes)} mm (± {sigma:.0f} mm)"


def _whole_line(result: Comparison) -> str:
    means = ", ".join(
        f"{day}: {100 * one.value:.1f} ± {100 * one.sigma:.1f} %"
        for day, one in zip(result.dates, result.whole, strict=True)
        if one
    )
    rate = f"; {rate_text(result.rate)}: {verdict(result.rate)}" if result.rate else ""
    return f"solidity of all that each date's dives saw, perhaps other parts: {means}{rate}"


def _hole_counts(result: Comparison) -> str:
    counts = []
    for day in result.dates:
        searched = [s for s in result.surveys if s.date == day and s.searched]
        n = sum(len(s.holes.number) for s in searched)
        counts.append(f"{day}: {n if searched else 'not searched for'}")
    return f"holes: {', '.join(counts)}; without positions it is unknown which are the same"


def _shift_lines(wall: OnWall) -> Iterator[str]:
    for one, shift in zip(wall.placed[1:], wall.shifts[1:], strict=True):
        if not shift.determined.any():
            continue
        parts = []
        if shift.determined[0] and wall.frame.round:
            degrees, sigma = np.rad2deg([shift.value[0], shift.sigma[0]]) / wall.frame.radius
            parts.append(f"bearing {with_sign(degrees, 1)} ± {sigma:.1f}°")
        elif shift.determined[0]:
            parts.append(f"along {with_sign(shift.value[0], 2)} ± {shift.sigma[0]:.2f} m")
        if shift.determined[1]:
            parts.append(f"depth {with_sign(shift.value[1], 2)} ± {shift.sigma[1]:.2f} m")
        how = " and ".join(["growth"] * shift.by_pattern + ["holes"] * shift.by_holes)
        yield f"{one.survey.name}: aligned with earlier dives by {how}: {', '.join(parts)}"


def _growth_line(wall: OnWall) -> str:
    if wall.growth is None:
        return "no part of the net was seen on two dates: growth is unknown"
    area = len(wall.cells) * float(np.prod(wall.history.raster.size))
    return (
        f"fouling: {rate_text(wall.growth)}, on {area:.0f} m² seen on two dates or more: "
        f"{verdict(wall.growth)}"
    )


def _where_lines(wall: OnWall) -> Iterator[str]:
    n = len(wall.cells)
    if not n:
        return
    counts = [
        f"{word} in {sum(one.changed and sign * one.difference.value > 0.0 for one in wall.cells)}"
        for word, sign in (("more", 1.0), ("less", -1.0))
    ]
    yield f"  beyond chance {' and '.join(counts)} of {n} cells"
    worst = max(wall.cells, key=lambda one: one.per_day.value)
    yield f"  most at {_where(wall, worst)}: {rate_text(worst.per_day)}"
    apart = [one for one in wall.cells if one.apart]
    if apart:
        most = max(apart, key=lambda one: abs(one.excess.z))
        words = "faster" if most.excess.value > 0.0 else "slower"
        size = Growth(abs(most.excess.value), most.excess.sigma)
        differ = "differs" if len(apart) == 1 else "differ"
        yield (
            f"  {count_text(len(apart), 'cell')} {differ} from the rest of the wall; surest at "
            f"{_where(wall, most)}, {words} by {rate_text(size).lstrip('+')}"
        )
    elif n > 1:
        yield "  no cell differs from the rest of the wall beyond chance"


def _where(wall: OnWall, cell: CellChange) -> str:
    return place_text(wall.history.raster.middle(np.array(cell.cell)), wall.frame)


def _mean_lines(wall: OnWall) -> Iterator[str]:
    known = [(d, m) for d, m in zip(wall.history.dates, wall.means, strict=True) if m is not None]
    if not known:
        yield "  no part of the net was seen on all dates"
        return
    n = int(np.count_nonzero(wall.history.known.all(axis=1)))
    area = n * float(np.prod(wall.history.raster.size))
    means = ", ".join(f"{day}: {100 * m.value:.1f} ± {100 * m.sigma:.1f} %" for day, m in known)
    yield f"  solidity of the {area:.0f} m² seen on all dates: {means}"


def _hole_lines(wall: OnWall) -> Iterator[str]:
    if not wall.sites:
        yield "holes: none on any date"
        return
    max_listed = 20
    for state, sites in by_state(wall.sites).items():
        yield f"holes {STATE_TITLES[state]}: {len(sites)}"
        if state is HoleState.SAME:
            yield from _since(wall, sites)
            continue
        for one in sites[:max_listed]:
            yield f"  {size_text(one)}: {place_text(one.place, wall.frame)}{_doubt(one)}"
        if len(sites) > max_listed:
            yield f"  and {len(sites) - max_listed} more, see holes_change.csv"


def _since(wall: OnWall, sites: Sequence[Site]) -> Iterator[str]:
    """Report the remaining holes that are newer than the first look at their places."""
    for v, day in enumerate(wall.history.dates[1:-1], start=1):
        mine = [
            one
            for one in sites
            if np.isfinite(one.sizes[v])
            and not np.isfinite(one.sizes[:v]).any()
            and (one.looked[:v] >= LOOKED).any()
        ]
        if mine:
            yield f"  of these new on {day}: {len(mine)}"


def _doubt(site: Site) -> str:
    if site.state not in (HoleState.NEW, HoleState.GONE):
        return ""
    share = 100.0 * site.missed
    if site.state is HoleState.NEW:
        return f"; if it was there before, earlier dives would have missed it in {share:.0f} %"
    return f"; if it is still there, the last date's dives miss it in {share:.0f} %"


def _not_looked(wall: OnWall) -> Iterator[str]:
    known, square = wall.history.known, float(np.prod(wall.history.raster.size))
    missing = int(np.count_nonzero(known[:, :-1].any(axis=1) & ~known[:, -1]))
    first = int(np.count_nonzero(~known[:, :-1].any(axis=1) & known[:, -1]))
    if missing or first:
        yield (
            f"not looked at on {wall.history.dates[-1]}: {missing * square:.0f} m² that earlier "
            f"dives saw; only then: {first * square:.0f} m²"
        )


NET_CHANGE_COLUMNS = (
    *("cell", "depth_from_m", "depth_to_m", "bearing_from_deg", "bearing_to_deg"),
    *("along_from_m", "along_to_m", "first_date", "last_date", "n_dates"),
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
    if (wall := result.wall) is None:
        return _whole_rows(result)
    return [_cell_row(one, wall) for one in wall.cells]


def hole_rows(result: Comparison) -> list[dict[str, Cell]]:
    """Return the rows of `holes_change.csv`."""
    if (wall := result.wall) is not None:
        return [_site_row(i, one, wall) for i, one in enumerate(wall.sites)]
    rows: list[dict[str, Cell]] = []
    for survey in result.surveys:
        day, holes = survey.date.isoformat(), survey.holes
        when = "before" if survey.date < result.dates[-1] else "after"
        for number, diameter, sigma in zip(holes.number, holes.diameter, holes.sigma, strict=True):
            row = dict.fromkeys(HOLES_CHANGE_COLUMNS, None)
            row |= {"site": len(rows) + 1, "state": NOT_COMPARED}
            row |= {"first_seen": day, "last_seen": day, "holes": f"{survey.name}:{number}"}
            row |= {f"diameter_{when}_mm": _mm(diameter), f"sigma_{when}_mm": _mm(sigma)}
            rows.append(row)
    return rows


def _whole_rows(result: Comparison) -> list[dict[str, Cell]]:
    known = [(d, one) for d, one in zip(result.dates, result.whole, strict=True) if one]
    if len(known) < 2 or result.rate is None:
        return []
    (first, before), (last, after) = known[0], known[-1]
    change = Growth(after.value - before.value, float(np.hypot(before.sigma, after.sigma)))
    seen = dict.fromkeys(result.dates, 0.0)
    for survey in result.surveys:
        seen[survey.date] += float(survey.stretches.seen[survey.stretches.usable].sum())
    row = dict.fromkeys(NET_CHANGE_COLUMNS, None)
    row |= {"cell": "all", **_dates(first, last, len(known), (seen[first], seen[last]))}
    row |= _numbers(before, after, change, result.rate)
    return [row | {"change": _change(change, abs(change.z) > 2.0)}]


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
    row |= _dates(dates[one.first], dates[one.last], one.n_dates, one.seen)
    row |= _numbers(one.before, one.after, one.difference, one.per_day)
    row |= {"change": _change(one.difference, one.changed)}
    row |= {"excess_per_day": round(one.excess.value, _RATES)}
    return row | {"sigma_excess": round(one.excess.sigma, _RATES), "beside": _beside(one)}


def _dates(first: date, last: date, n_dates: int, seen: tuple[float, float]) -> dict[str, Cell]:
    found: dict[str, Cell] = {"seen_before_m": round(seen[0], 1), "seen_after_m": round(seen[1], 1)}
    found |= {"first_date": first.isoformat(), "last_date": last.isoformat(), "n_dates": n_dates}
    return found


def _between(name: str, unit: str, low: float, high: float) -> dict[str, Cell]:
    return {f"{name}_from_{unit}": round(low, _PLACES), f"{name}_to_{unit}": round(high, _PLACES)}


def _numbers(before: Growth, after: Growth, change: Growth, rate: Growth) -> dict[str, Cell]:
    found: dict[str, Cell] = {"z": round(change.z, 2)}
    for value, sigma, growth, digits in (
        ("solidity_before", "sigma_before", before, _SHARES),
        ("solidity_after", "sigma_after", after, _SHARES),
        ("difference", "sigma_difference", change, _SHARES),
        ("per_day", "sigma_per_day", rate, _RATES),
    ):
        found |= {value: round(growth.value, digits), sigma: round(growth.sigma, digits)}
    return found


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
        row |= {"diameter_before_mm": _mm(one.sizes[k]), "sigma_before_mm": _mm(one.sigma_sizes[k])}
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
    (u, depth), (sigma_u, sigma_depth) = (
        [round(float(value), _PLACES) for value in one] for one in (place, sigma)
    )
    found: dict[str, Cell] = {"depth_m": depth, "sigma_depth_m": sigma_depth}
    if not frame.round:
        return found | {"along_m": u, "sigma_along_m": sigma_u}
    bearing, degrees = bearing_deg(float(place[0]), frame), np.rad2deg(sigma[0] / frame.radius)
    return found | {"bearing_deg": round(bearing, 1), "sigma_bearing_deg": round(float(degrees), 1)}


def _mm(metres: float) -> float:
    return round(1e3 * float(metres), 1)
