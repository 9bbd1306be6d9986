"""Random scenes of nets, and random fans, for statistics over conditions rather than one dive."""

from dataclasses import replace
from typing import Literal, TypeAlias, get_args

import numpy as np

from aqualvs.errors import OptionError
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Laser, Rig
from aqualvs.simulation.scenario import dome_from_target, random_bubble, random_fish
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig
from aqualvs.simulation.scene import Mesh, Net, Scene, Wall, WaterOptics

Difficulty: TypeAlias = Literal["clean", "usual", "hard"]

# By difficulty: greatest fouling, numbers of fish and bubbles, probability of a wall behind and of
# glare, spread of the attenuation (factor on clear water).
_LIMITS: dict[str, tuple[float, int, int, float, float, float]] = {
    "clean": (0.0, 0, 0, 0.0, 0.0, 1.0),
    "usual": (0.3, 1, 12, 0.5, 0.15, 1.6),
    "hard": (0.6, 3, 40, 0.7, 0.5, 3.0),
}


def random_scene(rng: np.random.Generator, difficulty: Difficulty = "usual") -> Scene:
    """Return a random scene of a net before the vehicle.

    Mesh 15-50 mm, twine 1-4 mm, range 0.3-1.0 m, roll 0-90 deg, yaw and pitch within 20 deg, all
    uniform; fouling up to 60 %, fish, bubbles, a wall behind, turbidity, caustics and glare as
    allowed by the difficulty.

    Parameters
    ----------
    rng : Generator
        Random number generator; the same state gives the same scene.
    difficulty : {"clean", "usual", "hard"}
    A clean net in open water; usual conditions of a dive; everything at once.

    Raises
    ------
    OptionError
        If there is no such difficulty.
    """
    if difficulty not in _LIMITS:
        raise OptionError(
            f"difficulty is {difficulty!r}; choose one of {', '.join(get_args(Difficulty))}"
        )
    _, n_fish, n_bubbles, wall, _, _ = _LIMITS[difficulty]
    pitch, yaw = np.deg2rad(rng.uniform(-20.0, 20.0, 2))
    pose = dome_from_target(float(rng.uniform(0.3, 1.0)), float(pitch), float(yaw))
    net = _net(rng, difficulty)
    behind = float(rng.uniform(0.15, 0.9))
    walls = (Wall(depth=behind, yaw=float(rng.normal(0.0, 0.1))),) if rng.random() < wall else ()
    return Scene(
        dome_from_scene=pose,
        walls=walls,
        nets=(net,),
        fish=tuple(random_fish(rng, 0.2, behind) for _ in range(rng.integers(0, n_fish + 1))),
        bubbles=tuple(
            random_bubble(rng, 0.2, behind) for _ in range(rng.integers(0, n_bubbles + 1))
        ),
        target="net",
        water=_water(rng, difficulty),
    )


def random_fan_rig(rng: np.random.Generator) -> Rig:
    """Return the example rig or the BlueROV2's with a fan in place of its lasers.

    A fan is a laser with a grating: 4 to 15 near-parallel lines, 1 to 4 degrees apart, from one
    emitter 70 to 200 mm beside the camera, or above or below it in three of ten rigs.

    Parameters
    ----------
    rng : Generator
        Random number generator; the same state gives the same rig.
    """
    n = int(rng.integers(4, 16))
    spacing = np.deg2rad(rng.uniform(1.2, 4.0) if n < 10 else rng.uniform(1.0, 2.5))
    side = 1 if rng.random() < 0.5 else -1
    beside = float(rng.uniform(0.07, 0.2)) * side
    is_upright = rng.random() < 0.7
    up, ahead = float(rng.uniform(-0.05, 0.05)), float(rng.uniform(-0.03, 0.03))
    aim, roll = -side * np.deg2rad(rng.uniform(3.0, 14.0)), np.deg2rad(rng.uniform(-8.0, 8.0))
    emitter = np.array([beside, ahead, up])
    along = np.array([np.sin(roll), 0.0, np.cos(roll)])
    lasers = []
    for i in range(n):
        angle = aim + np.arcsin((i - 0.5 * (n - 1)) * np.sin(spacing))
        normal = np.cross([np.sin(angle), np.cos(angle), 0.0], along)
        normal /= np.linalg.norm(normal)
        offset = float(normal @ emitter)
        if not is_upright:
            normal = np.array([normal[2], normal[1], -normal[0]])
        lasers.append(Laser(f"line{i}", Plane.from_normal(normal, offset)))
    rig = bluerov2_rig() if rng.random() < 0.5 else example_rig()
    return replace(rig, lasers=tuple(lasers))


def _net(rng: np.random.Generator, difficulty: str) -> Net:
    fouling = _LIMITS[difficulty][0]
    meshes: tuple[Mesh, ...] = get_args(Mesh)
    bar, twine = float(rng.uniform(0.015, 0.050)), float(rng.uniform(0.001, 0.004))
    return Net(
        mesh=meshes[int(rng.integers(len(meshes)))],
        bar=bar,
        # Limit the twine so that openings are at least two thirds of the bar.
        twine=min(twine, bar / 3.0),
        roll=float(np.deg2rad(rng.uniform(0.0, 90.0))),
        hanging_ratio=float(rng.uniform(0.5, 0.85)),
        fouling=float(rng.uniform(0.0, fouling)),
        offset=(float(rng.uniform(0.0, 0.1)), float(rng.uniform(0.0, 0.1))),
        seed=int(rng.integers(256)),
    )


def _water(rng: np.random.Generator, difficulty: str) -> WaterOptics:
    *_, glare, spread = _LIMITS[difficulty]
    clear = WaterOptics()
    factor = float(rng.uniform(1.0, spread)) if spread > 1.0 else 1.0
    sunny = rng.random() < glare
    red, green, blue = clear.attenuation
    return WaterOptics(
        attenuation=(red * factor, green * factor, blue * factor),
        sheet_scatter=clear.sheet_scatter * factor**2,
        forward_scatter=clear.forward_scatter * factor,
        caustics=float(rng.uniform(0.2, 0.7)) if sunny else 0.0,
        glare=float(rng.uniform(0.1, 0.5)) if sunny else 0.0,
        snow=int(300 * (factor - 1.0)),
    )
