"""Photographs of laser lines that no rig describes: the search over whole pictures.

The truth is traced by hand, or the difference of a picture with lines and one without.
"""

from pathlib import Path

import pytest

import real_lines
from whole import WHOLE

# JPEG lies between the pictures as they are and H.264, and moved ones are like those out of focus.
SHARP = ("png", "jpg80", "crf23") if WHOLE else ("png", "crf23")
BLURRED = ("soft-png", "soft-crf23", "moved-png", "moved-crf23") if WHOLE else ()
FORMATS = SHARP + BLURRED
# Pairs of ten of which the red line is found; 9, 10 and 9 are reached, and 9, 7, 9 and 9.
MIN_PAIRS = {"png": 9, "jpg80": 9, "crf23": 8, "soft-crf23": 5}


@pytest.fixture(scope="module")
def line_scores(samples: Path) -> dict[str, list[real_lines.Score]]:
    scores: dict[str, list[real_lines.Score]] = {fmt: [] for fmt in FORMATS}
    folder = samples / "real-laser-lines"
    traced, names = real_lines.traced_lines(), real_lines.pictures_of(folder)
    dark = [name for name in names if not real_lines.shows_laser(name, traced)]
    left_out = [] if WHOLE else dark[1::2]
    for shot in real_lines.shots(folder, FORMATS, lambda name: name not in left_out):
        for score in shot.scores:
            scores[score.format].append(score)
    return scores


@pytest.mark.samples
@pytest.mark.parametrize("fmt", FORMATS)
def test_green_lines_without_a_rig(line_scores, fmt: str) -> None:
    bright = [s for s in line_scores[fmt] if s.picture.startswith("green15-bright")]
    dark = [
        s for s in line_scores[fmt] if s.picture.startswith("green15-dark") and s.group == "line"
    ]
    assert (len(bright), len(dark)) == (4, 3)
    # Blur costs a line some of its length: 0.78 of the weakest is left, or more.
    least, weakest, least_dark = (0.9, 0.7, 0.7) if fmt in BLURRED else (0.95, 0.95, 0.85)
    assert {s.picture: s.found for s in bright if s.found < least} == {}
    assert {s.picture: s.weakest for s in bright if s.weakest < weakest} == {}
    assert {s.picture: s.found for s in dark if s.found < least_dark} == {}


@pytest.mark.samples
@pytest.mark.parametrize("fmt", FORMATS)
def test_nothing_is_found_without_laser(line_scores, fmt: str) -> None:
    off = [s for s in line_scores[fmt] if s.group.startswith("off")]
    # Searched for lasers of either colour.
    assert len(off) == 2 * (14 if WHOLE else 7)
    assert {(s.picture, s.group): s.n_points for s in off if s.n_points > 0} == {}


@pytest.mark.samples
@pytest.mark.parametrize("fmt", FORMATS)
def test_red_lines_of_pairs(line_scores, fmt: str) -> None:
    """Compression takes what colour a line of a pixel has left."""
    pairs = [s for s in line_scores[fmt] if s.group == "pair"]
    assert len(pairs) == 10
    assert sum(s.found >= 0.9 for s in pairs) >= MIN_PAIRS.get(fmt, 8)
