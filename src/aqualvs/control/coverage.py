"""Map of the area that a dive has seen, in cells.

The vertical axis is depth. The horizontal axis is the bearing of the net, where the vehicle reports
its heading: round a cage, bearings are places. Else it is the way along the net in metres by the
speed asked for, which a current shifts.
"""

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from aqualvs.control.autopilot import Decision
from aqualvs.control.missions import bearing_of
from aqualvs.control.vehicle import VehicleState
from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.scanning.posture import Posture, Refusal


class Across(StrEnum):
    """Quantity of the map's horizontal axis."""

    BEARING = "bearing"
    """Of the net's far normal, in radians."""
    ALONG = "along"
    """Metres to the right of the start, by the speed asked for."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CoverageOptions:
    """Resolution of the map, and the size of the field of view."""

    depth_cell: float = 0.1  # Height of a cell in metres.
    # Width in radians, or metres.
    bearing_cell: float = math.radians(1.0)
    along_cell: float = 0.1
    # How far above and below its own depth the vehicle sees the net at a range of 1 m, in metres;
    # grows with the range.
    seen_up: float = 0.2
    # As much to either side; counts along metres, and for bearings as `radius` says.
    seen_aside: float = 0.2
    # Of a round cage, in metres, to turn metres into bearings; None counts the middle alone.
    radius: float | None = None

    def __post_init__(self) -> None:
        """Raise `OptionError` naming the sizes if one is not positive."""
        sizes = (self.depth_cell, self.bearing_cell, self.along_cell)
        if not min(sizes) > 0.0:
            raise OptionError(f"coverage: cells of {sizes}; every size must be positive")
        if not (min(self.seen_up, self.seen_aside) >= 0.0 and (self.radius or 1.0) > 0.0):
            raise OptionError(
                f"coverage: sees {self.seen_up:g} m up, {self.seen_aside:g} m aside, radius "
                f"{self.radius}; the first two are 0 or more, a radius is positive"
            )


@dataclass(frozen=True, slots=True)
class CoverageMap:
    """Map of what has been seen."""

    across: Across  # What counts from left to right.
    depth_edges: FloatArray  # Shape (N + 1,): metres, downward.
    # Shape (M + 1,): radians, or metres. Bearings go on beyond a full turn where that joins them;
    # those of more than a turn are folded into 0 to 2 pi.
    across_edges: FloatArray
    seconds: FloatArray  # Shape (N, M): for how long each cell was in view; 0 is unseen.
    path: FloatArray  # Shape (K, 3): time, place across and depth of the vehicle's foot on the net.


class Coverage:
    """Builder of the coverage map, step by step."""

    # Longer steps are gaps, in seconds.
    LONGEST_STEP_S = 1.0

    def __init__(self, options: CoverageOptions | None = None) -> None:
        self.options = options or CoverageOptions()
        self._last_s = math.nan
        self._along = 0.0
        self._rows: list[tuple[float, float, float, float, float, float]] = []

    def add(
        self,
        now_s: float,
        posture: Posture | Refusal | None,
        decision: Decision,
        state: VehicleState,
    ) -> None:
        """Add one step; without a posture or a depth nothing is seen."""
        step = now_s - self._last_s
        step = step if 0.0 < step <= self.LONGEST_STEP_S else 0.0
        self._last_s = now_s
        if decision.engaged:
            self._along += step * decision.guidance.sway
        if not isinstance(posture, Posture) or state.depth is None:
            return
        bearing = bearing_of(posture, state)
        place = math.nan if bearing is None else bearing
        self._rows.append((now_s, step, place, self._along, state.depth, posture.range))

    def map(self) -> CoverageMap:
        """Return the map so far: by bearings if all are known, else along the net."""
        rows = np.array(self._rows, dtype=np.float64).reshape(-1, 6)
        rows = rows[np.isfinite(rows[:, [0, 3, 4, 5]]).all(axis=1)]
        by_bearing = len(rows) > 0 and bool(np.isfinite(rows[:, 2]).all())
        across = Across.BEARING if by_bearing else Across.ALONG
        places = _joined(rows[:, 2]) if by_bearing else rows[:, 3]
        # How far to either side is seen, in the unit of the map.
        aside = self.options.seen_aside * rows[:, 5]
        if by_bearing:
            radius = self.options.radius
            aside = np.zeros(len(rows)) if radius is None else aside / radius
        up = self.options.seen_up * rows[:, 5]
        width = self.options.bearing_cell if by_bearing else self.options.along_cell
        down_edges = _edges(rows[:, 4] - up, rows[:, 4] + up, self.options.depth_cell)
        across_edges = _edges(places - aside, places + aside, width)
        seconds = np.zeros((max(len(down_edges) - 1, 0), max(len(across_edges) - 1, 0)))
        for row, place, high, wide in zip(rows, places, up, aside, strict=True):
            top, bottom = _cells(row[4] - high, row[4] + high, down_edges)
            left, right = _cells(place - wide, place + wide, across_edges)
            seconds[top:bottom, left:right] += row[1]
        path = np.column_stack([rows[:, 0], places, rows[:, 4]])
        return CoverageMap(across, down_edges, across_edges, seconds, path)


def _joined(bearings: FloatArray) -> FloatArray:
    """Return bearings without jumps, or folded if they go round more than once."""
    joined = np.unwrap(bearings)
    return joined if np.ptp(joined) <= 2.0 * np.pi else bearings % (2.0 * np.pi)


def _edges(low: FloatArray, high: FloatArray, size: float) -> FloatArray:
    """Return edges of whole cells from the lowest to the highest."""
    if not len(low):
        return np.zeros(0)
    first = math.floor(float(low.min()) / size + 1e-9)
    last = math.floor(float(high.max()) / size + 1e-9) + 1
    return size * np.arange(first, last + 1, dtype=np.float64)


def _cells(low: float, high: float, edges: FloatArray) -> tuple[int, int]:
    """Return first and one past the last cell that hold any of a span."""
    size = edges[1] - edges[0]
    first = math.floor((low - edges[0]) / size + 1e-9)
    last = math.floor((high - edges[0]) / size + 1e-9) + 1
    return max(first, 0), min(last, len(edges) - 1)
