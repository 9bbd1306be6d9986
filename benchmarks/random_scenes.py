"""Random scenes of nets, for statistics over conditions rather than over one dive."""

from typing import Literal, TypeAlias, get_args

import numpy as np

from aqualvs.errors import OptionError
from aqualvs.simulation.scenario import dome_from_target, random_bubbles, random_fish
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
        fish=random_fish(rng, int(rng.integers(0, n_fish + 1)), 0.2, behind),
        bubbles=random_bubbles(rng, int(rng.integers(0, n_bubbles + 1)), 0.2, behind),
        target="net",
        water=_water(rng, difficulty),
    )


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
