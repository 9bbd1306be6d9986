"""Our pictures against those of an independent renderer that shares no code with us."""

import csv
import json

import av
import numpy as np
import pytest

from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.optics.dome import Dome
from aqualvs.optics.lens import Lens
from aqualvs.optics.rig import Laser, Rig
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenario import dome_from_target
from aqualvs.simulation.scene import Scene, Wall
from whole import part_of

pytestmark = pytest.mark.samples

_NOMINAL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_REACH = 14


def _rig(folder):
    truth = json.loads((folder / "truth" / "rig_truth.json").read_text(encoding="utf-8"))
    camera, dome = truth["camera"], truth["dome"]
    turn = rotation_from_rotvec(truth["camera_rotvec"])
    return Rig(
        name="samples",
        size_px=(camera["width"], camera["height"]),
        lens=Lens(
            fx=camera["fx"],
            fy=camera["fy"],
            cx=camera["cx"],
            cy=camera["cy"],
            distortion=tuple(camera["dist"]),
        ),
        dome_from_cam=SE3(turn @ _NOMINAL, np.array(truth["lens_mm"]) / 1e3),
        housing=Dome(dome["inner_mm"] / 1e3, dome["thickness_mm"] / 1e3, dome["n_acrylic"]),
        n_air=truth["n_air"],
        n_water=truth["n_water"],
        lasers=tuple(
            Laser(str(i), Plane.from_normal(laser["normal"], laser["d_mm"] / 1e3))
            for i, laser in enumerate(truth["lasers"])
        ),
        working_range=(0.3, 1.0),
    )


def _green(path, wanted):
    with av.open(str(path)) as container:
        return {
            i: frame.to_ndarray(format="rgb24")[..., 1].astype(float)
            for i, frame in enumerate(container.decode(video=0))
            if i in wanted
        }


def _centres(image, pixels, others, axis):
    """Centre of the light above background, at fixed lines across the stripe's rough place."""
    order = np.argsort(pixels[:, 1 - axis])
    along, across = pixels[order, 1 - axis], pixels[order, axis]
    lines = image if axis == 0 else image.T
    centres = {}
    for line in range(int(along[0]) + 20, int(along[-1]) - 20, 5):
        rough = round(float(np.interp(line, along, across)))
        at = (line, rough) if axis == 1 else (rough, line)
        alone = np.min(np.linalg.norm(others - at, axis=1)) > 3 * _REACH
        if rough < _REACH or rough + _REACH >= lines.shape[1] or not alone:
            continue
        profile = lines[line, rough - _REACH : rough + _REACH + 1]
        # The lowest grey level stands for the background: a steep stripe fills half the window.
        above = np.maximum(profile - profile.min() - 0.3 * np.ptp(profile), 0.0)
        centres[line] = above @ np.arange(-_REACH, _REACH + 1) / above.sum() + rough
    return centres


@pytest.mark.parametrize(
    ("frame", "range_mm"), part_of([(5, 374), (15, 438), (25, 525), (35, 659)], every=3)
)
def test_stripes_on_a_wall_fall_where_the_independent_renderer_puts_them(samples, frame, range_mm):
    folder = samples / "lab-paper"
    with (folder / "truth" / "dives" / "wall.csv").open(encoding="utf-8") as file:
        assert float(list(csv.DictReader(file))[frame]["range_mm"]) == range_mm
    theirs = _green(folder / "dives" / "wall.mp4", {frame})[frame]
    pose = dome_from_target(range_mm / 1e3, 0.0, 0.0)
    renderer = Renderer(_rig(folder))
    picture = renderer.render(
        Scene(dome_from_scene=pose, walls=(Wall(contrast=0.0),), target="wall")
    )
    ours = picture.image[..., 1].astype(float)
    for i in range(3):
        mine = picture.lit.laser == i
        pixels, others = picture.lit.pixels[mine], picture.lit.pixels[~mine]
        axis = 1 if np.ptp(pixels[:, 0]) > np.ptp(pixels[:, 1]) else 0
        a, b = (_centres(image, pixels, others, axis) for image in (ours, theirs))
        difference = np.array([a[line] - b[line] for line in a])
        assert len(difference) > 50
        # H.264 and the wall's texture move single centres by some tenths of a pixel.
        assert abs(np.median(difference)) < 0.08
        assert np.percentile(np.abs(difference), 90) < 0.4


def test_our_truth_points_are_theirs(samples):
    folder = samples / "lab-paper"
    renderer = Renderer(_rig(folder))
    with np.load(folder / "truth" / "dives" / "wall" / "points_0022.npz") as data:
        xyz, px, laser = data["xyz"] / 1e3, data["px"], data["laser"]
    # Their projection and ours agree to rounding and Newton's residue.
    pixels, valid = renderer.rig.camera().project(xyz)
    assert valid.all()
    assert np.abs(pixels - px).max() < 1e-6
    scene = Scene(dome_from_scene=dome_from_target(0.525, 0.0, 0.0), walls=(Wall(),), target="wall")
    lit = renderer.lit_points(scene)
    for i in range(3):
        ours = np.sort(lit.points_in_dome[lit.laser == i][:, [0, 2]], axis=0)
        theirs = np.sort(xyz[laser == i][:, [0, 2]], axis=0)
        # Both cover the picture from edge to edge, a point a pixel: 1 mm.
        assert np.abs(ours[[0, -1]] - theirs[[0, -1]]).max() < 1.5e-3
