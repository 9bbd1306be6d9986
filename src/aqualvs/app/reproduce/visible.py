"""How much stripe each frame of a dive truly shows."""

import os

import numpy as np

from aqualvs.app.reproduce.laboratory import Dive, Laboratory
from aqualvs.geometry.arrays import FloatArray
from aqualvs.simulation.benchmark_dive import render_with_visible
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.visible import VISIBLE_LIMIT

_FILE = "visible.csv"
ENOUGH = VISIBLE_LIMIT
"""Visible stripe points from which on a posture can be asked for."""


def visible_points(laboratory: Laboratory, dive: Dive) -> FloatArray:
    """Return the number of stripe points on the target that stand out, for each frame.

    See `aqualvs.simulation.visible` for what stands out. The numbers are kept beside the dive.

    Parameters
    ----------
    laboratory : Laboratory
        Counts the frames, which are rendered once more for this.
    dive : Dive
    """
    path = dive.folder / _FILE
    if not path.exists():
        scenario = dive.scenario
        renderer = Renderer(dive.rig, threads=os.cpu_count() or 1)
        counts = []
        for i, t in enumerate(scenario.times()):
            rng = np.random.default_rng([scenario.seed, i])
            counts.append(len(render_with_visible(renderer, scenario.scene_at(t), t, rng)[1]))
            laboratory.rendered(i + 1, scenario.n_frames)
        path.write_text("".join(f"{count}\n" for count in counts), encoding="utf-8")
    return np.loadtxt(path, ndmin=1)
