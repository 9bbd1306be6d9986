"""Random nets, measured and compared with the truth: validity, errors, normalised errors.

    python -m benchmarks.random_nets [N] [--first K] [--fans] [--pictures FOLDER]

renders N random scenes (seeds fixed; clean, usual and hard in turn), measures each with the scanner
and prints one table. With --fans each has a rig of its own, with a fan of 4 to 15 lines. With
--pictures the rendered planes are kept in a folder and read from there the next time, so that
another version of the scanner is tried on the same pictures at little cost.
Normalised errors are root mean squares of error over stated sigma; the robust ones are 1.4826 times
the median of their absolute values.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from benchmarks.random_scenes import Difficulty, random_fan_rig, random_scene

from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.rig import Rig
from aqualvs.scanner import Scanner
from aqualvs.scanning.posture import Posture
from aqualvs.scanning.scan import Frame, ImagePlane, planes_of_image
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenarios import example_rig
from aqualvs.simulation.scene import Scene, SurfaceKind
from aqualvs.simulation.truth import visible_fit

DIFFICULTIES: tuple[Difficulty, ...] = ("clean", "usual", "hard")
# A range that is farther off is that of something else.
_WRONG_SHARE = 0.05


class Shot(NamedTuple):
    """A picture of a random scene and the plane of its net (n, d); NaN where little is seen."""

    number: int
    frame: Frame
    plane: FloatArray
    rig: Rig


def shots(n: int, first: int, folder: Path | None, *, fans: bool = False) -> Iterator[Shot]:
    """Yield pictures of random nets, rendered or read."""
    renderer = None
    for index in range(first, first + n):
        path = None if folder is None else folder / f"{'fan' if fans else ''}{index:04d}.npz"
        difficulty = DIFFICULTIES[index % 3]
        rng = np.random.default_rng([77 if fans else 2023, index])
        rig = random_fan_rig(rng) if fans else example_rig()
        if path is None or not path.exists():
            if fans or renderer is None:
                renderer = Renderer(rig, threads=1)
            luma, u, v, plane = _render(renderer, random_scene(rng, difficulty), index)
            if path is not None:
                np.savez_compressed(path, luma=luma, u=u, v=v, plane=plane)
        else:
            with np.load(path) as kept:
                luma, u, v, plane = (kept[name] for name in ("luma", "u", "v", "plane"))
        yield Shot(index, Frame(0, 0.0, luma, (u, v)), plane, rig)


def _render(
    renderer: Renderer, scene: Scene, index: int
) -> tuple[ImagePlane, ImagePlane, ImagePlane, FloatArray]:
    picture = renderer.render(scene, 0.0, np.random.default_rng([7, index]))
    bgr = cv2.cvtColor(picture.image, cv2.COLOR_RGB2BGR).astype(np.uint8, copy=False)
    luma, chroma = planes_of_image(bgr)
    assert chroma is not None
    seen = visible_fit(picture.lit, SurfaceKind.NET)
    plane = np.full(4, np.nan) if seen is None else np.append(seen[0].normal, seen[0].offset)
    return luma, *chroma, plane


def _errors(posture: Posture, plane: FloatArray) -> list[float]:
    """Return errors of range (share), pitch and yaw (deg), then the same over their sigmas."""
    x, y, z, d = plane.tolist()
    error = np.array([posture.range - d, posture.pitch - np.arctan2(z, y)])
    error = np.append(error, posture.yaw - np.arctan2(x, y))
    z_score = error / np.sqrt(np.diag(posture.covariance))
    return [*(error * [1.0 / d, *np.rad2deg([1.0, 1.0])]).tolist(), *z_score.tolist()]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("n", type=int, nargs="?", default=102)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--fans", action="store_true")
    parser.add_argument("--pictures", type=Path)
    asked = parser.parse_args()
    if asked.pictures is not None:
        asked.pictures.mkdir(parents=True, exist_ok=True)
    found, refused, n_seen = [], [], 0
    for shot in shots(asked.n, asked.first, asked.pictures, fans=asked.fans):
        if not np.isfinite(shot.plane).all():
            continue
        n_seen += 1
        posture = Scanner(shot.rig).process(shot.frame).posture
        if isinstance(posture, Posture):
            found.append([shot.number, *_errors(posture, shot.plane)])
        else:
            refused.append(f"{shot.number} {posture.reason}")
    table = np.array(found)
    wrong = table[np.abs(table[:, 1]) > _WRONG_SHARE, 0].astype(int).tolist()
    print(f"{n_seen} nets seen, {len(table)} valid ({100 * len(table) / n_seen:.1f} %)")
    print(f"wrong targets (range off by more than 5 %): {len(wrong)} {wrong}")
    print("refused:", "; ".join(refused) or "-")
    print(f"{'':12}{'median':>9}{'rms':>9}{'p95':>9}{'max':>9}{'z rms':>9}{'z robust':>9}")
    rows = (("range %", 100.0), ("pitch deg", 1.0), ("yaw deg", 1.0))
    for k, (name, scale) in enumerate(rows):
        error, z_score = np.abs(table[:, 1 + k]) * scale, np.abs(table[:, 4 + k])
        figures = [*np.quantile(error, [0.5]), np.sqrt(np.mean(error**2))]
        figures += [*np.quantile(error, [0.95, 1.0]), np.sqrt(np.mean(z_score**2))]
        figures.append(1.4826 * float(np.median(z_score)))
        print(f"{name:12}" + "".join(f"{one:9.3f}" for one in figures))


if __name__ == "__main__":
    main()
