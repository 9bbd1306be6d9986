"""A frame gives the same bits every time, wherever its arrays happen to lie in memory."""

from dataclasses import astuple

import numpy as np

from aqualvs.demo import bundled_dive
from aqualvs.optics.rigfile import load_rig
from aqualvs.scanner import Scanner
from aqualvs.sources import open_source

ROUNDS = 12


def bits(scan):
    """Everything that was found, as bytes."""
    posture = scan.posture
    numbers = astuple(posture) if posture else ()
    flat = [np.asarray(value, np.float64).ravel() for value in numbers if value is not None]
    points = scan.points
    arrays = [points.points_in_dome, points.sigma, points.quality, points.label, points.used]
    return b"".join(np.ascontiguousarray(one).tobytes() for one in [*flat, *arrays])


def test_the_same_frames_give_the_same_bits():
    """Loops whose path depends on where arrays lie must not sum in another order on the other."""
    folder = bundled_dive()
    rig = load_rig(folder / "rig.yaml")
    with open_source(str(folder / "dive.mp4")) as source:
        frames = list(source)[::6]
    rng = np.random.default_rng(0)
    first = None
    for _ in range(ROUNDS):
        # What is allocated in between moves what the scanner allocates.
        kept = [np.empty(int(rng.integers(1, 4000)), np.uint8) for _ in range(200)]
        scanner = Scanner(rig)
        found = [bits(scanner.process(frame)) for frame in frames]
        first = first or found
        assert [i for i, (a, b) in enumerate(zip(first, found, strict=True)) if a != b] == []
        del kept
