"""A small rig and printed panels for the tests of simulated calibration pictures."""

from dataclasses import replace

import numpy as np

from aqualvs.geometry.transforms import SE3
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL
from aqualvs.simulation.scenarios import example_rig
from aqualvs.simulation.textures import CharucoPrint

BOARD = CharucoPrint(
    squares=(7, 5), square=24e-3, marker=18e-3, border=12e-3, dictionary="DICT_4X4_250"
)


def small_rig(share=0.5):
    """The example rig with fewer pixels over the same field of view."""
    rig = example_rig()
    lens = rig.lens
    scaled = replace(
        lens,
        fx=share * lens.fx,
        fy=share * lens.fy,
        # Pixel centres are whole numbers, so the picture's corner is at -0.5.
        cx=share * (lens.cx + 0.5) - 0.5,
        cy=share * (lens.cy + 0.5) - 0.5,
    )
    width, height = rig.size_px
    return replace(rig, lens=scaled, size_px=(round(share * width), round(share * height)))


def facing(distance, rotvec=(0.0, 0.0, 0.0), size=(0.0, 0.0)):
    """dome_from_panel of a panel before the dome, turned about its middle."""
    middle = SE3(DOME_FROM_CAM_NOMINAL, np.array([0.0, distance, 0.0]))
    turned = middle @ SE3.from_rotvec(rotvec, np.zeros(3))
    return turned @ SE3(np.eye(3), np.array([-0.5 * size[0], -0.5 * size[1], 0.0]))
