"""Dives along a net that is known everywhere and on every date, as `aqualvs net` writes them."""

import csv
import json
from dataclasses import dataclass, field
from datetime import date, timedelta
from pathlib import Path

import numpy as np

from aqualvs.net_survey.growth import COMMON, SIGMA_SCALE
from aqualvs.net_survey.surveys import Holes, Stretches, Survey
from aqualvs.nets.tables import HOLE_COLUMNS, NET_COLUMNS

RADIUS = 8.0
START = date(2026, 5, 1)
STEP, HEIGHT, SHARE = 0.5, 0.5, 0.8
SIGMA = 0.025


@dataclass
class Cage:
    """A round net: solidity by place and day, and holes with the days on which they are there.

    `holes` are (bearing in degrees, depth, diameter, first day, last day).
    """

    rng: np.random.Generator
    rate: float = 0.002
    spread: float = 0.0005
    pattern: float = 0.05
    holes: list = field(default_factory=list)

    def __post_init__(self):
        k = 24
        self._wave = self.rng.normal(0.0, [1.2, 1.2], (k, 2))
        # Whole numbers of waves go round the net.
        self._wave[:, 0] = np.round(self._wave[:, 0] * RADIUS) / RADIUS
        self._phase = self.rng.uniform(0.0, 2.0 * np.pi, (2, k))
        self._k = k

    def _field(self, u, d, i):
        at = self._wave[:, 0] * u[..., None] + self._wave[:, 1] * d[..., None] + self._phase[i]
        return np.sqrt(2.0 / self._k) * np.cos(at).sum(axis=-1)

    def growth(self, u, d):
        """Per day."""
        return self.rate + self.spread * self._field(u, d, 1)

    def solidity(self, u, d, day):
        return 0.3 + self.pattern * self._field(u, d, 0) + day * self.growth(u, d)


def dive(
    cage,
    day,
    *,
    name=None,
    bearings=(0.0, 360.0),
    depths=(3.0, 3.4, 3.8, 4.2, 4.6, 5.0),
    shift=(0.0, 0.0),
    missed=0.0,
    noise=1.0,
    log=True,
):
    """A survey in lanes; its compass and depth sensor read too much by `shift` (degrees, m)."""
    rng = cage.rng
    width = RADIUS * np.deg2rad(bearings[1] - bearings[0])
    n = round(width / STEP)
    u0 = RADIUS * np.deg2rad(bearings[0])
    u = np.concatenate([u0 + STEP * (np.arange(n)[:: (-1) ** i] + 0.5) for i in range(len(depths))])
    d = np.repeat(depths, n)
    sigma = np.full(len(u), SIGMA)
    error = np.sqrt(COMMON) * rng.normal() + np.sqrt(1.0 - COMMON) * rng.normal(size=len(u))
    grid = np.linspace(-0.4, 0.4, 5)
    du, dd = (g.ravel() for g in np.meshgrid(STEP * grid, HEIGHT * grid))
    true = cage.solidity(u[:, None] + du, d[:, None] + dd, day).mean(axis=1)
    along = u - u[0]
    bearing = np.deg2rad(shift[0]) + u / RADIUS + np.deg2rad(rng.normal(0.0, 0.3, len(u)))
    depth = d + shift[1] + rng.normal(0.0, 0.02, len(u))
    corner = np.array([[-STEP, HEIGHT], [STEP, HEIGHT], [STEP, -HEIGHT], [-STEP, -HEIGHT]]) / 2.0
    y = -depth if log else -(d - d[0])
    outline = np.stack([along, y], axis=-1)[:, None] + corner * [1.0, -1.0]
    nan = np.full(len(u), np.nan)
    stretches = Stretches(
        begin_s=2.5 * np.arange(len(u)),
        along=along,
        depth=depth if log else nan,
        bearing=np.mod(bearing, 2.0 * np.pi) if log else nan,
        seen=np.full(len(u), 30.0),
        solidity=true + noise * SIGMA_SCALE * SIGMA * error,
        sigma=sigma,
        usable=np.ones(len(u), bool),
        placed=np.ones(len(u), bool),
        outline=outline,
    )
    return Survey(
        folder=Path(name or f"run-{START + timedelta(days=day)}"),
        date=START + timedelta(days=day),
        stretches=stretches,
        holes=_holes(cage, day, stretches, (u, d), shift, missed, log),
        by_bearing=False,
        by_depth=log,
        lasers_share=SHARE,
        facts=_facts(len(u), log),
    )


def _facts(n, log):
    y = "minus the depth in metres" if log else "metres above where the dive began"
    return {
        "coordinates": {"system": "local", "x": "metres along the net to the right", "y": y},
        "options": {"twine_mm": None, "stretch_m": 0.5},
        "summary": {"bar_mm": 25.0, "area_m2": n * STEP * HEIGHT * SHARE, "track_slip_m": 0.0},
    }


def _holes(cage, day, stretches, true, shift, missed, log):
    rng, (u, d) = cage.rng, true
    rows = []
    for bearing, depth, size, first, last in cage.holes:
        hole_u = RADIUS * np.deg2rad(bearing)
        du = np.mod(u - hole_u + np.pi * RADIUS, 2.0 * np.pi * RADIUS) - np.pi * RADIUS
        inside = (np.abs(du) <= 0.5 * STEP) & (np.abs(d - depth) <= 0.5 * SHARE * HEIGHT)
        k = np.flatnonzero(inside)
        if not first <= day <= last or not len(k) or rng.random() < missed:
            continue
        i = int(k[0])
        rows.append(
            (
                stretches.begin_s[i] + 1.0,
                stretches.along[i] - du[i] + rng.normal(0.0, 0.03),
                depth + shift[1] + rng.normal(0.0, 0.03) if log else np.nan,
                stretches.bearing[i],
                size + rng.normal(0.0, 0.012),
                0.012,
            )
        )
    rows.sort()
    columns = np.array(rows, float).reshape(-1, 6).T
    return Holes([str(i + 1) for i in range(len(rows))], *columns)


def write(survey, folder):
    """Write a survey as the files of a run's net."""
    folder.mkdir(parents=True, exist_ok=True)
    one, features = survey.stretches, []
    rows = []
    for i in range(len(one.along)):
        known = {
            "stretch": i + 1,
            "begin_s": one.begin_s[i],
            "along_m": one.along[i],
            "placed_by": "track",
            "depth_m": one.depth[i],
            "bearing_deg": np.rad2deg(one.bearing[i]),
            "solidity": one.solidity[i],
            "sigma_solidity": one.sigma[i],
            "n_strands": 17.0,
            "seen_m": one.seen[i],
        }
        rows.append({name: _cell(known.get(name)) for name in NET_COLUMNS})
        ring = [list(map(float, corner)) for corner in one.outline[i]]
        features.append(
            {
                "type": "Feature",
                "properties": {"kind": "stretch"},
                "geometry": {"type": "Polygon", "coordinates": [[*ring, ring[0]]]},
            }
        )
    _table(folder / "net.csv", NET_COLUMNS, rows)
    h = survey.holes
    holes = [
        {
            "hole": h.number[i],
            "time_s": h.time_s[i],
            "along_m": h.along[i],
            "depth_m": h.depth[i],
            "bearing_deg": np.rad2deg(h.bearing[i]),
            "diameter_mm": 1e3 * h.diameter[i],
            "sigma_diameter_mm": 1e3 * h.sigma[i],
        }
        for i in range(len(h.number))
    ]
    cells = [{name: _cell(row.get(name)) for name in HOLE_COLUMNS} for row in holes]
    _table(folder / "holes.csv", HOLE_COLUMNS, cells)
    content = {"type": "FeatureCollection", "aqualvs_net": survey.facts, "features": features}
    (folder / "net.geojson").write_text(json.dumps(content))
    return folder


def _cell(value):
    if value is None or (isinstance(value, float) and not np.isfinite(value)):
        return ""
    return value


def _table(path, columns, rows):
    with path.open("w", newline="") as file:
        table = csv.DictWriter(file, columns)
        table.writeheader()
        table.writerows(rows)
