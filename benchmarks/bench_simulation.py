"""One simulated frame with its truth on one core, after the one-time trace of all pixels."""

import time
from typing import Any

import numpy as np

from aqualvs.optics.rig import Rig
from aqualvs.simulation.example_rigs import bluerov2_rig, example_rig
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenarios import load_scenario

_TARGET_MS = 400.0
_SMALL = ("wall", "net_diamond", "net_clutter")


def run() -> list[dict[str, Any]]:
    """Least processor time of a frame; the target stands for 720x576, nobody publishes a figure."""
    rows = [_row(example_rig(), name, _TARGET_MS) for name in _SMALL]
    return [*rows, _row(bluerov2_rig(), "net_clutter", None)]


def _row(rig: Rig, scenario: str, target: float | None) -> dict[str, Any]:
    value = _best_ms(rig, scenario)
    width, height = rig.size_px
    return {
        "name": f"simulate {scenario} {width}x{height}",
        "value": value,
        "unit": "ms",
        "reference": target,
        "ratio": target / value if target else None,
    }


def _best_ms(rig: Rig, scenario: str) -> float:
    renderer, rng = Renderer(rig), np.random.default_rng(0)
    scene = load_scenario(scenario).scene_at(0.0)
    renderer.render(scene, 0.0, rng)
    times = []
    for _ in range(5):
        start = time.process_time()
        renderer.render(scene, 0.0, rng)
        times.append(time.process_time() - start)
    return 1e3 * min(times)
