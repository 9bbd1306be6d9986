"""Fish and bubbles at random, so placed that the camera meets them."""

import numpy as np

from aqualvs.simulation.scene import Bubble, Fish

_IN_FRONT = 0.10
_SIDE, _HEIGHT = 0.20, 0.13


def random_fish(
    rng: np.random.Generator, count: int, duration: float, behind: float
) -> tuple[Fish, ...]:
    """Return fish that cross the view some time in the dive.

    Parameters
    ----------
    rng : Generator
        Source of chance.
    count : int
        How many.
    duration : float
        Of the dive, in seconds.
    behind : float
        Room behind the target plane, in metres; fish keep clear of a wall there.
    """
    return tuple(_fish(rng, duration, behind) for _ in range(count))


def _fish(rng: np.random.Generator, duration: float, behind: float) -> Fish:
    length = float(rng.uniform(0.12, 0.34))
    depth = float(rng.uniform(-_IN_FRONT, max(behind - 0.3 * length, -0.05)))
    side = float(rng.choice([-1.0, 1.0]))
    speed = side * float(rng.uniform(0.05, 0.30))
    middle, when = float(rng.uniform(-_SIDE, _SIDE)), float(rng.uniform(0.0, duration))
    height, climb = float(rng.uniform(-_HEIGHT, _HEIGHT)), float(rng.normal(0.0, 0.01))
    return Fish(
        position=(middle - speed * when, depth, height - climb * when),
        velocity=(speed, 0.0, climb),
        length=length,
        beat=float(rng.uniform(0.8, 2.5)),
    )


def random_bubbles(
    rng: np.random.Generator, count: int, duration: float, behind: float
) -> tuple[Bubble, ...]:
    """Return bubbles that rise through the view some time in the dive.

    Parameters
    ----------
    rng, count, duration, behind
        As for `random_fish`.
    """
    return tuple(_bubble(rng, duration, behind) for _ in range(count))


def _bubble(rng: np.random.Generator, duration: float, behind: float) -> Bubble:
    rise, when = float(rng.uniform(0.10, 0.25)), float(rng.uniform(0.0, duration))
    place = (
        float(rng.uniform(-_SIDE, _SIDE)),
        float(rng.uniform(-_IN_FRONT, max(behind, 0.0))),
        float(rng.uniform(-_HEIGHT, _HEIGHT)) - rise * when,
    )
    drift = (float(rng.normal(0.0, 0.01)), float(rng.normal(0.0, 0.01)), rise)
    radius = float(np.clip(rng.lognormal(np.log(2.2e-3), 0.45), 0.8e-3, 7e-3))
    return Bubble(position=place, velocity=drift, radius=radius)
