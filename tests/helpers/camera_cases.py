"""What tests of simulated cameras share: a small rig, and what a line adds to its background."""

from dataclasses import replace
from functools import cache

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.simulation.cameras import simulated_camera
from aqualvs.simulation.lasers import default_sources
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenarios import example_rig, load_scenario

REAL = ("webcam", "action", "pal")


def half_size_rig():
    """The example rig at half its resolution."""
    rig = example_rig()
    lens = replace(rig.lens, fx=408.0, fy=439.0, cx=184.0, cy=141.0)
    return replace(rig, size_px=(360, 288), lens=lens)


@cache
def wall_pictures(name: str, power: float, wavelength_nm: float | None = None):
    """A wall at 438 mm without noise: lasers on, lasers off, and where the stripes' middles are.

    Returns
    -------
    on, off : float arrays, shape (288, 360, 3)
    lit : int array, shape (N, 2)
        Columns and rows, 20 px off the edge at least.
    """
    rig, scenario = half_size_rig(), load_scenario("wall")
    sources = [replace(source, power=power) for source in default_sources(rig)]
    if wavelength_nm is not None:
        sources = [replace(source, wavelength_nm=wavelength_nm) for source in sources]
    renderer = Renderer(rig, sources, samples=1, camera=simulated_camera(name))
    scene = scenario.scene_at(0.5)
    on = renderer.render(scene, 0.5)
    off = renderer.render(replace(scene, lasers_on=False), 0.5)
    lit = np.rint(on.lit.pixels).astype(int)
    lit = lit[np.all((lit >= 20) & (lit < np.array(rig.size_px) - 20), axis=1)]
    return on.image.astype(float), off.image.astype(float), lit


def line_minus_background(
    name: str, power: float, wavelength_nm: float | None = None
) -> FloatArray:
    """What the line adds to red, green and blue on the average of its middle, in grey levels."""
    on, off, lit = wall_pictures(name, power, wavelength_nm)
    return np.asarray((on - off)[lit[:, 1], lit[:, 0]].mean(axis=0))


def chroma(rgb: FloatArray) -> tuple[float, float]:
    """U and V of a colour or of a difference of colours (ITU-R BT.601, as the samples' table)."""
    luma = rgb @ [0.299, 0.587, 0.114]
    return float(0.564 * (rgb[2] - luma)), float(0.713 * (rgb[0] - luma))
