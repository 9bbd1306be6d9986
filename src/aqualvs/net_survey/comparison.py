"""Comparison of dives along the same net: from the files of the runs to the changes.

Hole sites are holes that stay, are new, are gone, or were not passed again (`find_sites`).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import date
from enum import StrEnum

import numpy as np
from scipy import optimize, sparse
from scipy.special import chdtri, ndtri

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.net_survey.frames import (
    PlacedSurvey,
    Raster,
    SurveyShift,
    WallFrame,
    align,
    common_frame,
    corners_of,
    has_places,
    looked_at,
    place_survey,
    shifted,
    wrapped,
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
from aqualvs.net_survey.surveys import Survey

# Two holes are one if their places differ by no more than chance makes in all but one of 1000.
_GATE = float(chdtri(2, 1e-3))
# Lasers looked at a place if they did so with this chance, given how well places are known.
LOOKED = 0.8
# A hole has grown beyond chance in all but one of 100.
_GROWN = float(-ndtri(0.005))
_SIDE = 0.1
MISSED = 0.2
"""Share of the holes that lasers swept over and that one dive does not find: 6 of 34 in short
rendered dives, which are harder than long ones (docs/net-condition.md)."""


class HoleState(StrEnum):
    """Change of a hole between dates; the value is that of `state` in `holes_change.csv`."""

    NEW = "new"
    """Seen on the last date, and not when an earlier dive looked there."""
    GROWN = "grown"
    SMALLER = "smaller"
    SAME = "same"
    GONE = "gone"
    """Not seen when a dive of the last date looked there: mended, or missed."""
    FIRST_LOOK = "not looked at before"
    """Seen on the last date; no earlier dive looked there."""
    NOT_PASSED = "not looked at now"
    """Seen on an earlier date; no dive of the last date looked there."""


@dataclass(frozen=True, slots=True)
class Site:
    """A place on the net with a hole on one date or more."""

    state: HoleState
    # Shape (2,): u and d in metres.
    place: FloatArray
    sigma: FloatArray
    # Shape (V,): diameter on each date in metres; NaN where it was not seen.
    sizes: FloatArray
    sigma_sizes: FloatArray
    # Shape (V,): chance that lasers looked there on each date.
    looked: FloatArray
    # Run and number in its `holes.csv`.
    numbers: list[str]

    @property
    def missed(self) -> float:
        """Chance that a hole there escaped all looks on the dates on which it was not seen.

        For a new hole those of the earlier dates, for one that is gone those of the last.
        """
        unseen = self.looked[~np.isfinite(self.sizes)]
        if self.state is HoleState.GONE:
            unseen = self.looked[-1:]
        return float(MISSED ** np.count_nonzero(unseen >= LOOKED))


def find_sites(
    placed: Sequence[PlacedSurvey], shifts: Sequence[SurveyShift], frame: WallFrame
) -> list[Site]:
    """Bring holes of dives, already shifted, together.

    `shifts`: what each shift leaves open is in its sigma.
    """
    dates = sorted({one.survey.date for one in placed})
    known = [np.flatnonzero(np.isfinite(one.holes).all(axis=1)) for one in placed]
    parts = [(i, k) for i, holes in enumerate(known) for k in holes.tolist()]
    if not parts:
        return []
    place = np.array([placed[i].holes[k] for i, k in parts])
    sigma = np.array([np.hypot(placed[i].sigma, shifts[i].sigma) for i, _ in parts])
    size = np.array([placed[i].survey.holes.diameter[k] for i, k in parts])
    of_run = np.array([i for i, _ in parts])
    group = _groups(place, sigma, size, of_run, frame)
    visits = _Visits.of(placed, shifts, frame)
    return [
        _site(np.flatnonzero(group == g), parts, (place, sigma), placed, dates, visits)
        for g in dict.fromkeys(group)
    ]


def _groups(
    place: FloatArray, sigma: FloatArray, size: FloatArray, of_run: IntArray, frame: WallFrame
) -> IntArray:
    """Return numbers of groups (n,), dive after dive, of holes that are one.

    Of two dives each hole has one counterpart, at most: those of all pairs within the uncertainty
    that together lie nearest. Parts that touch in one dive are one hole, unless another dive told
    them apart as well.
    """
    group = np.full(len(place), -1, np.int64)
    for run in np.unique(of_run):
        mine, known = np.flatnonzero(of_run == run), np.flatnonzero(group >= 0)
        distance, inside = _distances(mine, known, (place, sigma, size), frame)
        found = _counterparts(distance, group[known])
        for k, hole in enumerate(mine):
            if found[k] < 0 and inside[k].any():
                # A piece of a hole that another dive saw whole.
                found[k] = group[known[np.argmin(np.where(inside[k], distance[k], np.inf))]]
            group[hole] = found[k] if found[k] >= 0 else group.max() + 1
    return _join_touching(group, _touching(place, size, of_run, frame), of_run)


def _touching(place: FloatArray, size: FloatArray, of_run: IntArray, frame: WallFrame) -> BoolArray:
    """Mark the pairs of holes of one dive that touch."""
    off = np.hypot(*wrapped(place[:, None] - place[None], frame).transpose(2, 0, 1))
    # Parts of one hole are no farther apart than a strand or two, in metres.
    gap = 0.03
    near = off <= 0.5 * (size[:, None] + size[None]) + gap
    return np.asarray(near & (of_run[:, None] == of_run[None]))


def _join_touching(group: IntArray, touching: BoolArray, of_run: IntArray) -> IntArray:
    """Join groups whose holes touch in the one dive that saw both."""
    n = int(group.max()) + 1
    seen = np.zeros((n, int(of_run.max()) + 1), np.bool_)
    seen[group, of_run] = True
    join = np.zeros((n, n), np.bool_)
    for i, k in np.argwhere(touching):
        join[group[i], group[k]] |= np.count_nonzero(seen[group[i]] & seen[group[k]]) == 1
    _, number = sparse.csgraph.connected_components(
        sparse.csr_array(join.astype(np.float64)), directed=False
    )
    return np.asarray(number[group], np.int64)


def _distances(
    mine: IntArray,
    known: IntArray,
    holes: tuple[FloatArray, FloatArray, FloatArray],
    frame: WallFrame,
) -> tuple[FloatArray, BoolArray]:
    """Return squares of distances by uncertainty (n, m), and what lies inside known holes."""
    place, sigma, size = holes
    off = wrapped(place[mine][:, None] - place[known][None], frame)
    # The middle of what lasers saw of a hole is off the hole's by this share of its diameter.
    off_middle = 0.25
    middle = off_middle * np.maximum(size[mine][:, None], size[known][None])
    variance = sigma[mine][:, None] ** 2 + sigma[known][None] ** 2 + middle[..., None] ** 2
    inside = np.hypot(off[..., 0], off[..., 1]) <= 0.5 * size[known][None]
    return np.asarray((off**2 / variance).sum(axis=-1)), np.asarray(inside)


def _counterparts(distance: FloatArray, group: IntArray) -> IntArray:
    """Return the group that each hole belongs to, no group twice; -1 where to none."""
    found = np.full(len(distance), -1, np.int64)
    numbers = np.unique(group)
    if not len(numbers):
        return found
    nearest = np.stack([distance[:, group == g].min(axis=1) for g in numbers], axis=1)
    cost = np.where(nearest < _GATE, nearest, 2.0 * _GATE)
    for k, g in zip(*optimize.linear_sum_assignment(cost), strict=True):
        if nearest[k, g] < _GATE:
            found[k] = numbers[g]
    return found


@dataclass(frozen=True, slots=True)
class _Visits:
    """Places that the lasers of each dive looked at, with the date and their uncertainty."""

    raster: Raster
    n_dates: int
    dives: list[tuple[BoolArray, int, FloatArray]]

    @classmethod
    def of(
        cls, placed: Sequence[PlacedSurvey], shifts: Sequence[SurveyShift], frame: WallFrame
    ) -> "_Visits":
        low, high = corners_of(placed)
        max_squares = 4_000_000
        side = max(_SIDE, float(np.sqrt(np.prod(high - low) / max_squares)))
        raster = Raster.over(low, high, side, frame)
        dates = sorted({one.survey.date for one in placed})
        dives = [
            (looked_at(a, raster), dates.index(a.survey.date), np.hypot(a.sigma, b.sigma))
            for a, b in zip(placed, shifts, strict=True)
        ]
        return cls(raster, len(dates), dives)

    def chance(self, place: FloatArray, sigma: FloatArray) -> FloatArray:
        """Return with what chance (V,) a place was looked at on each date."""
        found = np.zeros(self.n_dates)
        # Spread like a normal distribution, always the same ones.
        n = 16
        at = ndtri((np.arange(n) + 0.5) / n)
        samples = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)
        for seen, visit, own in self.dives:
            index = self.raster.index(place + samples * np.hypot(sigma, own))
            share = float(np.mean(np.where(index >= 0, seen[index], False)))
            found[visit] = max(found[visit], share)
        return found


def _site(
    mine: IntArray,
    parts: Sequence[tuple[int, int]],
    where: tuple[FloatArray, FloatArray],
    placed: Sequence[PlacedSurvey],
    dates: Sequence[date],
    visits: _Visits,
) -> Site:
    place, sigma = where
    best = mine[np.argmin(sigma[mine].prod(axis=1))]
    n_dates = len(dates)
    sizes, errors = np.full(n_dates, np.nan), np.full(n_dates, np.nan)
    for i in {parts[k][0] for k in mine}:
        holes, visit = placed[i].survey.holes, dates.index(placed[i].survey.date)
        numbers = [parts[k][1] for k in mine if parts[k][0] == i]
        # Parts of one hole that a dive saw apart add up by area.
        size = float(np.linalg.norm(holes.diameter[numbers]))
        # A dive sees too little of a hole, never too much: of one date the largest counts.
        if not size <= sizes[visit]:
            sizes[visit], errors[visit] = size, float(np.linalg.norm(holes.sigma[numbers]))
    looked = visits.chance(place[best], sigma[best])
    looked[np.isfinite(sizes)] = 1.0
    runs = [(placed[parts[k][0]].survey, parts[k][1]) for k in mine]
    return Site(
        state=_state(sizes, errors, looked),
        place=place[best],
        sigma=sigma[best],
        sizes=sizes,
        sigma_sizes=errors,
        looked=looked,
        numbers=[f"{one.name}:{one.holes.number[i]}" for one, i in runs],
    )


def _state(sizes: FloatArray, errors: FloatArray, looked: FloatArray) -> HoleState:
    seen = np.isfinite(sizes)
    before = np.flatnonzero(seen[:-1])
    if not seen[-1]:
        return HoleState.GONE if looked[-1] >= LOOKED else HoleState.NOT_PASSED
    if not len(before):
        return HoleState.NEW if (looked[:-1] >= LOOKED).any() else HoleState.FIRST_LOOK
    change = sizes[-1] - sizes[before[-1]]
    if abs(change) <= _GROWN * np.hypot(errors[-1], errors[before[-1]]):
        return HoleState.SAME
    return HoleState.GROWN if change > 0.0 else HoleState.SMALLER


@dataclass(frozen=True, slots=True)
class OnWall:
    """Changes by place: cells and hole sites on the wall."""

    frame: WallFrame
    placed: list[PlacedSurvey]  # Dives in the common frame, shifted.
    shifts: list[SurveyShift]  # Theirs.
    history: WallHistory
    cells: list[CellChange]
    growth: Growth | None  # Per day, over all cells seen on two dates; None without one.
    means: list[Growth | None]  # Of the cells seen on every date, date by date.
    sites: list[Site]  # Holes.


@dataclass(frozen=True, slots=True)
class Comparison:
    """Result of comparing dives along the same net."""

    surveys: list[Survey]  # In the order of time.
    dates: list[date]
    # Mean solidity of all that was seen, date by date: of other parts of the net, perhaps.
    whole: list[Growth | None]
    # Change of that per day.
    rate: Growth | None
    # None where places cannot be compared.
    wall: OnWall | None

    warnings: list[str]


def compare(surveys: Sequence[Survey], cell: float) -> Comparison:
    """Compare dives along the same net, of two dates or more.

    `cell`: side of the cells in metres.
    """
    ordered = sorted(surveys, key=lambda one: (one.date, one.name))
    dates = sorted({one.date for one in ordered})
    whole = [_mean_solidity(one for one in ordered if one.date == day) for day in dates]
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
        if not frame.round and not shift.determined[0]:
            warnings.append(
                f"{survey.folder}: growth and holes do not determine its position along the net "
                "relative to earlier dives; it is left out of the map"
            )
            continue
        if not shift.determined.all():
            warnings.append(_alignment_warning(survey, shift, frame))
        placed.append(shifted(one, shift))
        shifts.append(shift)
    if len({one.survey.date for one in placed}) < 2:
        warnings.append("places are not compared, only whole dives: fewer than two dates are left")
        return None, warnings
    wall = history(placed, shifts, frame, cell)
    changes = cell_changes(wall), wall_growth(wall), date_means(wall)
    return OnWall(
        frame, placed, shifts, wall, *changes, find_sites(placed, shifts, frame)
    ), warnings


def _alignment_warning(survey: Survey, shift: SurveyShift, frame: WallFrame) -> str:
    parts = []
    if not shift.determined[0]:
        parts.append(f"bearing (± {np.rad2deg(shift.sigma[0] / frame.radius):.0f}°)")
    if not shift.determined[1]:
        parts.append(f"depth (± {shift.sigma[1]:.1f} m)")
    return (
        f"{survey.folder}: growth and holes do not determine the offset of its "
        f"{' and '.join(parts)} from earlier dives; taken as logged"
    )


def _mean_solidity(surveys: Iterable[Survey]) -> Growth | None:
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
    summaries = [one.facts.get("summary", {}) for one in surveys]
    known = [s["bar_mm"] for s in summaries if isinstance(s.get("bar_mm"), int | float)]
    # Dives along nets whose bars differ by so much, as a share, are hardly of one net.
    other_net = 0.1
    if known and max(known) > (1.0 + other_net) * min(known):
        found.append(
            f"meshes differ, from {min(known):.1f} to {max(known):.1f} mm bar: is this the "
            "same net?"
        )
    twines = {one.facts.get("options", {}).get("twine_mm") for one in surveys}
    if len(twines) > 1:
        found.append(
            "--twine-mm differs between runs, or was given for some only: solidity may differ for "
            "that reason alone"
        )
    for one, summary in zip(surveys, summaries, strict=True):
        slip = summary.get("track_slip_m")
        if isinstance(slip, int | float) and slip > 0.0:
            found.append(
                f"{one.folder}: its track and its log differ by {slip:.1f} m in depth; its places "
                "and the sizes of its holes are unreliable"
            )
    return found
