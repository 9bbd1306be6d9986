"""The public benchmark set: dives by difficulty, at fixed seeds.

A difficulty is laid over the same courses and the same nets as the clear dives, so that what it
costs can be read off. Whoever changes anything here gives the set the next number: scores are
compared by name and checksum.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import rig_to_mapping
from aqualvs.simulation.example_rigs import example_rig
from aqualvs.simulation.scenario import Scenario
from aqualvs.simulation.scenario_file import parse_scenario
from aqualvs.simulation.visible import CONTRAST_LIMIT, VISIBLE_LIMIT

BENCHMARK_NAME = "aqualvs-bench-1"
"""Of the set as a whole; the number rises with every change of a definition."""

N_FRAMES = 20
"""Frames of every dive."""

_DURATION_S = 5.0
_WORKING_RANGE = (0.25, 1.35)

LEVELS: Mapping[str, str] = MappingProxyType(
    {
        "clear": "clear water, clean nets and a wall",
        "turbid": "turbid water: glowing sheets, halo, marine snow",
        "sun": "close below the surface: caustics, glare, overexposure",
        "fouled": "nets with growth on 45 and 60 % of their twine",
        "folded": "slack nets that hang in folds",
        "crowded": "holes, fish, bubbles, a box, a wall behind the net",
        "empty": "no target in range, or no lasers: nothing may be measured",
    }
)
"""Levels of difficulty, each with one line about it."""

_COURSES: dict[str, dict[str, Any]] = {
    "near": {
        "range_mm": {"values": [310, 420, 560, 650], "sway": 4, "period_s": 2.3},
        "pitch_deg": {"values": [6, -4, 8], "sway": 1.5, "period_s": 3.1},
        "yaw_deg": {"values": [-10, 12, -4], "sway": 1.5, "period_s": 2.7},
        "slide_x_mm": [0, 90, 200],
        "slide_z_mm": [0, -15, 20],
    },
    "far": {
        "range_mm": {"values": [500, 800, 1250, 900], "sway": 6, "period_s": 2.9},
        "pitch_deg": {"values": [-5, 6, -2], "sway": 1, "period_s": 3.1},
        "yaw_deg": {"values": [8, -12, 5], "sway": 1, "period_s": 2.3},
        "slide_x_mm": [0, -120, -260],
        "slide_z_mm": [0, 30, -20],
    },
    "swing": {
        "range_mm": {"values": [520, 660, 580], "sway": 5, "period_s": 2.6},
        "pitch_deg": {"values": [-14, 15, -8, 10]},
        "yaw_deg": {"values": [24, -25, 14, -20]},
        "slide_x_mm": [0, 60, 20],
        "slide_z_mm": [0, 40, 90],
    },
}
_COURSES["wall"] = _COURSES["swing"]

_TARGETS: dict[str, dict[str, Any]] = {
    "near": {"net": {"bar_mm": 25, "twine_mm": 2.2, "roll_deg": 3}},
    "far": {"net": {"mesh": "square", "bar_mm": 30, "twine_mm": 2.6, "roll_deg": 12}},
    "swing": {"net": {"mesh": "hexagon", "bar_mm": 18, "twine_mm": 2.0, "roll_deg": 20}},
    "wall": {"walls": [{"tile_mm": 150}]},
}

_MURKY: dict[str, Any] = {
    "attenuation_per_m": [2.0, 1.25, 1.6],
    "veil": [0.115, 0.235, 0.165],
    "sheet_scatter_per_m": 1.5,
    "forward_scatter": 0.16,
    "halo_px": 12,
    "snow": 1500,
}
_HAZY: dict[str, Any] = {
    "attenuation_per_m": [1.3, 0.75, 1.0],
    "veil": [0.095, 0.22, 0.165],
    "sheet_scatter_per_m": 0.8,
    "forward_scatter": 0.10,
    "halo_px": 11,
    "snow": 900,
}
_SUN: dict[str, Any] = {"caustics": 0.65, "glare": 0.5, "ambient": [0.50, 0.82, 0.78]}
_STRONG_SUN: dict[str, Any] = {"caustics": 0.9, "glare": 1.0, "ambient": [0.8, 1.3, 1.2]}
# Overexposed: half of a wall is at full scale.
_BLINDING_SUN: dict[str, Any] = {"caustics": 1.0, "glare": 1.0, "ambient": [1.2, 2.0, 1.9]}

_OVER: dict[str, dict[str, dict[str, Any]]] = {
    "clear": {"near": {}, "far": {}, "swing": {}, "wall": {}},
    "turbid": {"near": {"water": _MURKY}, "far": {"water": _MURKY}, "wall": {"water": _HAZY}},
    "sun": {
        "near": {"water": _STRONG_SUN, "walls": [{"behind_mm": 200}]},
        "far": {"water": _STRONG_SUN},
        "swing": {"water": _SUN},
        "wall": {"water": _BLINDING_SUN},
    },
    "fouled": {
        "near": {"net": {"fouling": 0.6, "growth": 2.5}, "walls": [{"behind_mm": 200}]},
        "far": {"net": {"fouling": 0.45, "growth": 1.5}},
        "swing": {"net": {"fouling": 0.6, "growth": 2.0}},
    },
    "folded": {
        "near": {
            "net": {
                "folds": [
                    {"direction_deg": 10, "height_mm": -24, "width_mm": 45, "every_mm": 90},
                ]
            }
        },
        "far": {
            "net": {
                "folds": [
                    {"direction_deg": -15, "height_mm": -40, "width_mm": 75, "every_mm": 150},
                    {"direction_deg": 60, "height_mm": -15, "width_mm": 60, "every_mm": 120},
                ]
            }
        },
        "swing": {
            "net": {
                "folds": [
                    {"direction_deg": 35, "height_mm": -30, "width_mm": 50, "every_mm": 100},
                ]
            }
        },
    },
    "crowded": {
        "near": {
            "net": {"bar_mm": 30, "holes_mm": [[60, 40, 35]]},
            "walls": [{"behind_mm": 450, "yaw_deg": 4, "tile_mm": 150}],
            "fish": 4,
            "bubbles": 60,
        },
        "far": {
            "net": {"fouling": 0.1, "missing": 0.05},
            "walls": [{"behind_mm": 250, "pitch_deg": -5}],
            "boxes": [{"centre_mm": [330, 120, -60], "heading_deg": 12}],
            "fish": 5,
            "bubbles": 40,
            "water": {"snow": 300},
        },
        "swing": {
            "net": {"fouling": 0.15, "holes_mm": [[-90, 0, 50], [120, -60, 40]]},
            "boxes": [{"centre_mm": [-260, 220, -80], "heading_deg": -20}],
            "fish": 4,
            "bubbles": 80,
        },
    },
    "empty": {
        "open": {"fish": 3, "bubbles": 25, "water": {"snow": 600}},
        "dark": {
            "motion": _COURSES["near"],
            "net": {"bar_mm": 25, "twine_mm": 2.2, "fouling": 0.3},
            "water": _SUN,
            "lasers_on": False,
        },
    },
}


@dataclass(frozen=True, slots=True)
class BenchmarkDive:
    """A dive of the set.

    Attributes
    ----------
    name : str
        `LEVEL_COURSE`; the name of its folder and of its row in scores.
    level : str
        One of `LEVELS`.
    scenario : Scenario
        What is rendered.
    """

    name: str
    level: str
    scenario: Scenario

    def shortened(self, n_frames: int) -> "BenchmarkDive":
        """Return the same dive in fewer frames, spread over all of its time."""
        fps = n_frames / self.scenario.duration
        return replace(self, scenario=replace(self.scenario, fps=fps))


def benchmark_rig() -> Rig:
    """Return the rig of all dives: the example rig, believed from 0.25 to 1.35 m."""
    return replace(example_rig(), name=BENCHMARK_NAME, working_range=_WORKING_RANGE)


def benchmark_dives() -> tuple[BenchmarkDive, ...]:
    """Return all dives of the set, level after level."""
    return tuple(
        BenchmarkDive(name, level, parse_scenario(content, name, name))
        for name, level, content in _definitions()
    )


def benchmark_checksum() -> str:
    """Return the first 12 hex digits of the SHA-256 of everything that defines the set.

    The rig counts to nine digits, so that the last bit of a sine changes nothing.
    """
    parts = [
        BENCHMARK_NAME,
        [VISIBLE_LIMIT, CONTRAST_LIMIT],
        _rounded(rig_to_mapping(benchmark_rig())),
        list(_definitions()),
    ]
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode("ascii")).hexdigest()[:12]


def _definitions() -> list[tuple[str, str, dict[str, Any]]]:
    """Return name, level and scenario mapping of every dive, seeds included."""
    found: list[tuple[str, str, dict[str, Any]]] = []
    for level, courses in _OVER.items():
        for course, over in courses.items():
            content = _laid_over(_TARGETS.get(course, {}), over)
            content["motion"] = content.get("motion", _COURSES.get(course, {}))
            timing = {"duration_s": _DURATION_S, "fps": N_FRAMES / _DURATION_S}
            seed = 1000 + len(found)
            found.append((f"{level}_{course}", level, {**timing, "seed": seed, **content}))
    return found


def _laid_over(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """Return a mapping with another's values over its own; the net is laid over key by key."""
    merged = {**base, **over}
    if "net" in base and "net" in over:
        merged["net"] = {**base["net"], **over["net"]}
    return merged


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(part) for part in value]
    return float(f"{value:.9g}") if isinstance(value, float) else value
