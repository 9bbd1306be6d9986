"""What changed on a net, in sentences."""

from collections.abc import Iterator, Sequence

import numpy as np

from aqualvs.app.net_change.cells import CellChange, Growth
from aqualvs.app.net_change.comparison import Comparison, OnWall
from aqualvs.app.net_change.frames import WallFrame
from aqualvs.app.net_change.hole_sites import LOOKED, HoleState, Site
from aqualvs.geometry.arrays import FloatArray

_WEEK = 7.0
_MOST_LISTED = 20
_ORDER = (
    HoleState.NEW,
    HoleState.GROWN,
    HoleState.GONE,
    HoleState.FIRST_LOOK,
    HoleState.NOT_PASSED,
    HoleState.SMALLER,
    HoleState.SAME,
)
_TITLES = {
    HoleState.NEW: "new",
    HoleState.GROWN: "grown",
    HoleState.GONE: "gone, mended or missed this time",
    HoleState.FIRST_LOOK: "seen now, where no earlier dive looked",
    HoleState.NOT_PASSED: "seen before, where no dive looked now",
    HoleState.SMALLER: "smaller, mended in part or seen in part",
    HoleState.SAME: "the same",
}
# Beyond this many standard deviations a change is called one.
_TOLD = 2.0


def summary_lines(result: Comparison) -> list[str]:
    """Return the whole comparison in lines."""
    lines = [_span_line(result)]
    wall = result.wall
    if wall is None:
        lines += [_whole_line(result), _hole_counts(result)]
    else:
        lines += [*_shift_lines(wall), _growth_line(wall), *_where_lines(wall)]
        lines += [*_mean_lines(wall), *_hole_lines(wall), *_not_looked(wall)]
    return lines + [f"warning: {one}" for one in result.warnings]


def state_title(state: HoleState) -> str:
    """Return how sentences call what became of a hole."""
    return _TITLES[state]


def place_words(place: FloatArray, frame: WallFrame) -> str:
    """Return where on the net something is."""
    if frame.round:
        return f"{place[1]:.1f} m deep, bearing {bearing_deg(place[0], frame):.0f}°"
    return f"{place[1]:.1f} m deep, {place[0]:.1f} m along"


def bearing_deg(u: float, frame: WallFrame) -> float:
    """Return the bearing of a place around a round net, in [0, 360)."""
    return float(np.rad2deg(u / frame.radius)) % 360.0


def rate_words(growth: Growth) -> str:
    """Return growth as percent of the net's area a week."""
    week, sigma = 100.0 * _WEEK * growth.value, 100.0 * _WEEK * growth.sigma
    return f"{week:+.1f} ± {sigma:.1f} % of the net's area a week"


def verdict(growth: Growth) -> str:
    """Return whether a growth is beyond its uncertainty."""
    if abs(growth.z) < _TOLD:
        return "no change beyond the uncertainty"
    return "fouling has grown" if growth.value > 0.0 else "fouling has become less"


def by_state(sites: Sequence[Site]) -> dict[HoleState, list[Site]]:
    """Return the holes by what became of them, what matters most first."""
    found = {state: [one for one in sites if one.state is state] for state in _ORDER}
    return {state: some for state, some in found.items() if some}


def size_words(site: Site) -> str:
    """Return a hole's diameter when last seen, after that before if it is still there."""
    known = np.isfinite(site.sizes)
    last = site.sizes[known][-2:] if known[-1] else site.sizes[known][-1:]
    sizes = [f"{1e3 * size:.0f}" for size in last]
    sigma = 1e3 * float(site.sigma_sizes[known][-1])
    return f"{' -> '.join(sizes)} mm (± {sigma:.0f} mm)"


def _span_line(result: Comparison) -> str:
    days = (result.dates[-1] - result.dates[0]).days
    return (
        f"{len(result.surveys)} dives on {len(result.dates)} dates, {result.dates[0]} to "
        f"{result.dates[-1]} ({days} days)"
    )


def _whole_line(result: Comparison) -> str:
    means = ", ".join(
        f"{day}: {100 * one.value:.1f} ± {100 * one.sigma:.1f} %"
        for day, one in zip(result.dates, result.whole, strict=True)
        if one
    )
    rate = f"; {rate_words(result.rate)}: {verdict(result.rate)}" if result.rate else ""
    return f"solidity of all that each date's dives saw, perhaps other parts: {means}{rate}"


def _hole_counts(result: Comparison) -> str:
    counts = [
        f"{day}: {sum(len(s.holes.number) for s in result.surveys if s.date == day)}"
        for day in result.dates
    ]
    return f"holes: {', '.join(counts)}; which are the same cannot be told without places"


def _shift_lines(wall: OnWall) -> Iterator[str]:
    for one, shift in zip(wall.placed[1:], wall.shifts[1:], strict=True):
        if not shift.told.any():
            continue
        parts = []
        if shift.told[0] and wall.frame.round:
            degrees, sigma = np.rad2deg([shift.value[0], shift.sigma[0]]) / wall.frame.radius
            parts.append(f"bearing {degrees:+.1f} ± {sigma:.1f}°")
        elif shift.told[0]:
            parts.append(f"along {shift.value[0]:+.2f} ± {shift.sigma[0]:.2f} m")
        if shift.told[1]:
            parts.append(f"depth {shift.value[1]:+.2f} ± {shift.sigma[1]:.2f} m")
        how = " and ".join(
            name for name, told in (("growth", shift.by_pattern), ("holes", shift.by_holes)) if told
        )
        yield f"{one.survey.name}: laid on earlier dives by {how}: {', '.join(parts)}"


def _growth_line(wall: OnWall) -> str:
    if wall.growth is None:
        return "no part of the net was seen on two dates: growth is not told"
    area = len(wall.cells) * float(np.prod(wall.history.raster.size))
    return (
        f"fouling: {rate_words(wall.growth)}, on {area:.0f} m² seen on two dates or more: "
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
    yield f"  most at {_extreme(wall, max(wall.cells, key=lambda one: one.per_day.value))}"
    apart = [one for one in wall.cells if one.apart]
    if apart:
        most = max(apart, key=lambda one: abs(one.excess.z))
        words = "faster" if most.excess.value > 0.0 else "slower"
        yield (
            f"  {len(apart)} cells differ from the rest of the wall; surest at "
            f"{_where(wall, most)}, {words} by {rate_words(_size(most.excess)).lstrip('+')}"
        )
    elif n > 1:
        yield "  no cell differs from the rest of the wall beyond chance"


def _size(growth: Growth) -> Growth:
    return Growth(abs(growth.value), growth.sigma)


def _extreme(wall: OnWall, cell: CellChange) -> str:
    return f"{_where(wall, cell)}: {rate_words(cell.per_day)}"


def _where(wall: OnWall, cell: CellChange) -> str:
    return place_words(wall.history.raster.middle(np.array(cell.cell)), wall.frame)


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
    for state, sites in by_state(wall.sites).items():
        yield f"holes {_TITLES[state]}: {len(sites)}"
        if state is HoleState.SAME:
            yield from _since(wall, sites)
            continue
        for one in sites[:_MOST_LISTED]:
            yield f"  {size_words(one)}: {place_words(one.place, wall.frame)}{_doubt(one)}"
        if len(sites) > _MOST_LISTED:
            yield f"  and {len(sites) - _MOST_LISTED} more, see holes_change.csv"


def _since(wall: OnWall, sites: Sequence[Site]) -> Iterator[str]:
    """Tell which of the holes that stay are newer than the first look at their places."""
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
