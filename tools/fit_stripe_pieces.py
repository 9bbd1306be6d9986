"""Fit the weights with which pieces of stripes are judged (`aqualvs.scanning.stripe_segments`).

    python tools/fit_stripe_pieces.py ../shared/samples/real-laser-lines

Pieces that lie on the lines of real_lines.csv, or on those that pairs with and without laser show,
are lines; what lies beside them, what is found as a line of another colour, and all that is found
in pictures without laser and in the halves without line of tests/data/real-wall, is none. Every
line is also shown once as paint: of the same shape, without colour. A picture's lines count as much
as what else is in it, however many they are. Each picture is also used out of focus, and moved.

Printed is what weights fitted to one half of the pictures find in the other half, as real_lines.py
scores it, and the other way round; then the weights fitted to all. The halves share no scene.
"""

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

import real_lines
from aqualvs.calibrate.uncalibrated_stripes import find_all_segments
from aqualvs.scanning.laser_bands import SearchAxis
from aqualvs.scanning.laser_colour import WHITE
from aqualvs.scanning.scan import Frame, planes_of_image
from aqualvs.scanning.stripe_segments import (
    ACROSS,
    ALONG,
    HALO,
    LENGTH,
    TOP,
    Weights,
    general_evidence,
    learn_lines,
    line_log_odds,
    own_evidence,
)

Array = NDArray[np.float64]

WALL = Path(__file__).parents[1] / "tests/data/real-wall"
WITHOUT_LINE_PX = 700
# A piece is a line, or none, if such a share of its points is, or is not, this near to a line; wide
# lines are traced to a few pixels.
LINE, OTHER, NEAR_PX, NEAR_WIDE_PX = 0.7, 0.3, 1.5, 4.0
# Where lines of the dark pictures were traced: beyond, nobody says what is none (x, x, y in px).
TRACED_DARK = (760.0, 1480.0, 180.0)
# Weight of a picture out of focus, or moved: together they count as much as pictures as they are.
WORSE_WEIGHT = 0.5
# Paint's share of the weight of lines, and how its chroma for each level spreads about none: along
# the colour and across it, and beside the paint.
PAINT_WEIGHT, PAINT_SPREAD = 0.1, (0.03, 0.05, 0.05)
# Pictures of the first half: five of the ten pairs, two of the four bright and of the three dark
# pictures, two of five of the folded board, and one photograph of the wall.
FIRST_HALF = (
    *("sample1-", "sample3-", "sample5-", "sample6-", "sample7-"),
    *("img_1Left", "img_image5", "coral7", "image03", "img_0", "img_1.", "image2.jpg"),
)
# Samples that all weights together count as, and the ridge that keeps the weights small.
N_EFFECTIVE, RIDGE, ROUNDS = 3000.0, 3.0, 40


@dataclass(frozen=True)
class Sample:
    """Pieces of one picture in one format: table, and 1 for lines, 0 for none, NaN if unknown."""

    name: str
    format: str
    width_px: int
    table: Array
    is_line: Array
    has_lines: bool

    @property
    def group(self) -> str:
        """Name of the set."""
        return self.name.split("/")[0]


def samples(folder: Path, formats: list[str]) -> Iterator[Sample]:
    """Find the pieces of all pictures and say which of them are lines."""
    traced = real_lines.traced_lines()
    paths = [*sorted(folder.glob("*/*")), *sorted(WALL.glob("*.jpg"))]
    for path in (p for p in paths if p.suffix in (".png", ".jpg")):
        name = f"{path.parent.name}/{path.name}"
        image = real_lines.read_image(path)
        if path.parent == WALL:
            image = np.ascontiguousarray(image[:, :WITHOUT_LINE_PX])
        lines = None
        if "-b-" in name:
            off = real_lines.read_image(Path(str(path).replace("-b-", "-a-")))
            row = real_lines.pair_line(off, image)
            column = np.flatnonzero(np.isfinite(row))
            lines = np.stack([column, row[column]], axis=-1)
        elif name in traced:
            lines = np.concatenate([real_lines.walk(polyline) for _, polyline in traced[name]])
        own = real_lines.RED_NM if name.startswith("red") else real_lines.GREEN_NM
        for fmt in formats:
            given = real_lines.encoded(image, fmt)
            for nm in (real_lines.GREEN_NM, real_lines.RED_NM):
                yield _sample(name, fmt, given, nm, lines if nm == own else None)


def _sample(
    name: str, fmt: str, given: real_lines.Image | Frame, nm: float, lines: Array | None
) -> Sample:
    frame = given if isinstance(given, Frame) else Frame(0, 0.0, *planes_of_image(given))
    found = find_all_segments(frame, nm)
    table = np.concatenate([segments.table for segments in found], axis=1)
    is_line = np.zeros(table.shape[1])
    if lines is not None and len(is_line):
        dark = name.startswith("green15-dark")
        share, middle = [], []
        for segments in found:
            line = segments.search.line_px * (segments.peaks.line[segments.order] + 0.5) - 0.5
            points = np.stack([line, segments.peaks.position[segments.order]], axis=-1)
            if segments.search.axis is SearchAxis.ALONG_X:
                points = points[:, ::-1]
            distance = np.asarray(cKDTree(lines).query(points)[0])
            near = distance <= (NEAR_WIDE_PX if dark else NEAR_PX)
            first, n = segments.start[:-1], np.diff(segments.start)
            share.append(np.add.reduceat(near.astype(float), first) / n)
            middle.append(np.add.reduceat(points, first) / n[:, None])
        on, (x, y) = np.concatenate(share), np.concatenate(middle).T
        is_line = np.where(on > LINE, 1.0, np.where(on < OTHER, 0.0, np.nan))
        if dark:
            beyond = (x < TRACED_DARK[0]) | (x > TRACED_DARK[1]) | (y < TRACED_DARK[2])
            is_line[(is_line == 0.0) & beyond] = np.nan
    return Sample(name, fmt, frame.luma.shape[1], table, is_line, lines is not None)


def logistic(evidence: Array, is_line: Array, weight: Array) -> Array:
    """Return the weights of a ridge logistic regression, for the evidence as it is."""
    mean, spread = evidence.mean(axis=0), evidence.std(axis=0) + 1e-9
    mean[0], spread[0] = 0.0, 1.0
    scaled, found = (evidence - mean) / spread, np.zeros(evidence.shape[1])
    weight = weight * N_EFFECTIVE / weight.sum()
    for _ in range(ROUNDS):
        expected = 1.0 / (1.0 + np.exp(-np.clip(scaled @ found, -30.0, 30.0)))
        slope = scaled.T @ (weight * (is_line - expected)) - RIDGE * found
        curved = (scaled.T * (weight * expected * (1.0 - expected))) @ scaled
        curved += RIDGE * np.eye(len(found))
        found += np.clip(np.linalg.solve(curved, slope), -2.0, 2.0)
    found = found / spread
    found[0] -= (found * mean)[1:].sum()
    return np.asarray(found)


def _rows(sample: Sample, evidence: Callable[[Array], Array]) -> tuple[Array, Array, Array]:
    """Return evidence, label and weight of a picture's pieces, paint among them."""
    known = np.isfinite(sample.is_line)
    table, is_line = sample.table[:, known], sample.is_line[known]
    length = table[LENGTH]
    of_lines, of_others = length[is_line > 0.0].sum(), length[is_line == 0.0].sum()
    weight = np.where(is_line > 0.0, length / max(of_lines, 1.0), length / max(of_others, 1.0))
    paint = table[:, (is_line > 0.0) & (table[TOP] < WHITE)].copy()
    rng = np.random.default_rng(0)
    for row, spread in zip((ALONG, ACROSS, HALO), PAINT_SPREAD, strict=True):
        paint[row] = rng.normal(0.0, spread, paint.shape[1])
    of_paint = PAINT_WEIGHT * paint[LENGTH] / max(of_lines, 1.0)
    picture = WORSE_WEIGHT if "-" in sample.format else 1.0
    return (
        np.concatenate([evidence(table), evidence(paint)]),
        np.concatenate([is_line, np.zeros(paint.shape[1])]),
        picture * np.concatenate([weight, of_paint]),
    )


def fit(of: list[Sample]) -> Weights:
    """Return the weights of the general evidence and of what the pictures' own lines add."""

    def general(sample: Sample) -> Callable[[Array], Array]:
        return lambda table: general_evidence(table, sample.width_px, has_colour=True)

    rows = [_rows(sample, general(sample)) for sample in of]
    first = logistic(*(np.concatenate(column) for column in zip(*rows, strict=True)))
    rows = []
    for sample in (sample for sample in of if sample.has_lines):
        log_odds = general(sample)(sample.table) @ first
        lines = learn_lines(sample.table, log_odds, sample.width_px, has_colour=True)
        if lines is not None:

            def own(table: Array, sample: Sample = sample, lines=lines) -> Array:  # type: ignore[no-untyped-def]
                return own_evidence(table, lines, sample.width_px, has_colour=True)

            rows.append(_rows(sample, own))
    own_rows = (np.concatenate(column) for column in zip(*rows, strict=True))
    return Weights(first, logistic(*own_rows))


def is_first_half(name: str) -> bool:
    """Return whether a picture belongs to the first half."""
    return any(part in name for part in FIRST_HALF)


def report(weights: Weights, folder: Path, formats: list[str], *, first_half: bool) -> None:
    """Print what weights find in the pictures of one half."""
    defaults = line_log_odds.__kwdefaults__
    assert defaults is not None
    defaults["weights"] = weights
    scores = [
        score
        for shot in real_lines.shots(folder, formats, lambda n: is_first_half(n) == first_half)
        for score in shot.scores
    ]
    print("\n".join(real_lines.text_line(s) for s in scores if s.n_points or s.found == s.found))
    print("\n".join(real_lines.summary(scores)), flush=True)


def main() -> int:
    """Fit to one half of the pictures and to the other, then to all."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("samples", type=Path, help="folder of the photographs")
    states = ("", "soft-", "moved-")
    default = ",".join(state + fmt for state in states for fmt in real_lines.FORMATS)
    parser.add_argument("--formats", default=default, help="such as png,soft-jpg80")
    given = parser.parse_args()
    found = list(samples(given.samples, given.formats.split(",")))
    for first_half in (False, True):
        weights = fit([s for s in found if is_first_half(s.name) != first_half])
        print(f"the {'first' if first_half else 'second'} half, by weights fitted to the other:")
        report(weights, given.samples, given.formats.split(","), first_half=first_half)
    weights = fit(found)
    for name, values in zip(weights._fields, weights, strict=True):
        print(f"{name}: np.array([{', '.join(f'{value:.3g}' for value in values)}])")
    return 0


if __name__ == "__main__":
    sys.exit(main())
