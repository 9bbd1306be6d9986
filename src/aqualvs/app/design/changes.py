"""Which change of a design helps most: each is tried, with the lasers tilted anew."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from aqualvs.app.design.best import best_angles
from aqualvs.app.design.judge import score
from aqualvs.app.design.mount import Mount, tangential
from aqualvs.app.design.predict import predict
from aqualvs.app.design.settings import Design
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.lens import Lens
from aqualvs.scanning.plane_fit import SharedError

# Lasers are not put nearer to each other than this, in metres.
_ROOM = 0.03


@dataclass(frozen=True, slots=True)
class Change:
    """What a change would do; all numbers are shares of what is now, 1 is no change.

    Attributes
    ----------
    words : str
        What is changed.
    score : float
        Root mean square of all errors, in goals, on walls and nets.
    noise_range, noise_angle : float
        Errors of a single frame on a wall, from noise alone, root mean square over the range.
    systematic_range, systematic_angle : float
        Errors from the tolerances of lasers and water.
    """

    words: str
    score: float
    noise_range: float
    noise_angle: float
    systematic_range: float
    systematic_angle: float


def changes(design: Design) -> list[Change]:
    """Try every change and return them, the most helpful first.

    Parameters
    ----------
    design : Design
        With its lasers tilted as they will be. Those that are free to turn are turned again.
    """
    now = _measures(design)
    tried = ((words, change(design)) for words, change in _CHANGES.items())
    found = [
        Change(words, *(_measures(best_angles(new, quick=True)) / now).tolist())
        for words, new in tried
        if new is not None
    ]
    return sorted(found, key=lambda change: change.score)


def _measures(design: Design) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Score, then noise and tolerances for range (as a share) and angles."""
    told = predict(design)
    parts = [score(design).error]
    for sigma in (told.wall, told.systematic_total):
        parts.append(_rms(sigma[:, 0] / told.ranges))
        parts.append(_rms(np.hypot(sigma[:, 1], sigma[:, 2])))
    return np.array(parts)


def _rms(values: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _moved(design: Design, move: Callable[[Mount], Mount]) -> Design:
    return design.with_mounts([move(mount) for mount in design.mounts])


def _wider_baseline(design: Design) -> Design:
    def move(mount: Mount) -> Mount:
        x, y, z = mount.position
        return replace(mount, position=(1.2 * x, y, 1.2 * z))

    return _moved(design, move)


def _finer(design: Design) -> Design:
    rig = design.rig
    lens, (width, height) = rig.lens, rig.size_px
    # The centre of the top-left pixel is (0, 0), its corner (-0.5, -0.5).
    finer = Lens(
        model=lens.model,
        fx=2.0 * lens.fx,
        fy=2.0 * lens.fy,
        cx=2.0 * lens.cx + 0.5,
        cy=2.0 * lens.cy + 0.5,
        distortion=lens.distortion,
    )
    return replace(design, rig=replace(rig, lens=finer, size_px=(2 * width, 2 * height)))


def _longer_lens(share: float) -> Callable[[Design], Design]:
    def change(design: Design) -> Design:
        lens = design.rig.lens
        longer = Lens(
            model=lens.model,
            fx=share * lens.fx,
            fy=share * lens.fy,
            cx=lens.cx,
            cy=lens.cy,
            distortion=lens.distortion,
        )
        return replace(design, rig=replace(design.rig, lens=longer))

    return change


def _one_more(design: Design) -> Design | None:
    """Add a laser across the axis from one that has room there: where it helps most."""
    tried = [
        best_angles(design.with_mounts([*design.mounts, _new_mount(design, place)]), quick=True)
        for place in _free_places(design)
    ]
    return min(tried, key=lambda one: score(one).total, default=None)


def _new_mount(design: Design, place: tuple[float, float, float]) -> Mount:
    names = {mount.name for mount in design.mounts}
    name = next(name for name in (f"extra_{i}" for i in range(1, 99)) if name not in names)
    tilt, fan = design.mounts[0].tilt, design.mounts[0].fan
    return Mount(name=name, position=place, stripe=tangential(place), tilt=tilt, fan=fan)


def _free_places(design: Design) -> Iterator[tuple[float, float, float]]:
    places = [mount.position for mount in design.mounts]
    for x, y, z in places:
        across = (-x, y, -z)
        if all(math.dist(across, other) > _ROOM for other in places):
            yield across


def _turned(design: Design) -> Design | None:
    if all(mount.free_stripe for mount in design.mounts):
        return None
    return _moved(design, lambda mount: replace(mount, free_stripe=True))


def _crossing(design: Design) -> Design | None:
    return replace(design, avoid_crossings=False) if design.avoid_crossings else None


def _centred(design: Design) -> Design | None:
    pose = design.rig.dome_from_cam
    if design.rig.dome is None or float(np.linalg.norm(pose.translation)) < 1e-4:
        return None
    centred = SE3(pose.rotation, np.zeros(3))
    return replace(design, rig=replace(design.rig, dome_from_cam=centred))


def _averaged(design: Design) -> Design:
    """Four frames in which stripes have moved over the target: all noise halves."""
    noise = design.noise
    wall, net = (
        SharedError(0.5 * one.shift_px, 0.5 * one.tilt_px) for one in (noise.wall, noise.net)
    )
    halved = replace(noise, point=0.5 * noise.point, strand=0.5 * noise.strand, wall=wall, net=net)
    return replace(design, noise=halved)


def _better_known(*names: str) -> Callable[[Design], Design]:
    def change(design: Design) -> Design:
        halved = {name: 0.5 * getattr(design.tolerances, name) for name in names}
        return replace(design, tolerances=replace(design.tolerances, **halved))

    return change


def _nearer(design: Design) -> Design | None:
    near, far = design.rig.working_range
    if 0.8 * far <= near:
        return None
    return replace(design, rig=replace(design.rig, working_range=(near, 0.8 * far)))


_CHANGES: dict[str, Callable[[Design], Design | None]] = {
    "baseline 20 % longer": _wider_baseline,
    "twice the pixels, each way": _finer,
    "focal length 25 % longer": _longer_lens(1.25),
    "focal length 20 % shorter": _longer_lens(0.8),
    "one more laser": _one_more,
    "stripes turned to their best directions": _turned,
    "stripes may cross": _crossing,
    "fan of 90 degrees": lambda design: _moved(
        design, lambda mount: replace(mount, fan=math.radians(90.0))
    ),
    "lens in the dome's centre": _centred,
    "mean of four frames": _averaged,
    "lasers known twice as well": _better_known("laser_angle", "laser_offset"),
    "water's index known twice as well": _better_known("n_water"),
    "working range ends 20 % nearer": _nearer,
}
