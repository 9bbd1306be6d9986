"""Put printed targets on pages: paper, ruler, words."""

import re
from dataclasses import dataclass

import numpy as np

from aqualvs.app.pdf import Page, Text
from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray

PAPERS_MM: dict[str, tuple[float, float]] = {
    "a4": (210.0, 297.0),
    "a3": (297.0, 420.0),
    "a2": (420.0, 594.0),
    "a1": (594.0, 841.0),
    "a0": (841.0, 1189.0),
    "letter": (215.9, 279.4),
}
"""Width and height of papers, upright."""

FIT = "fit"
"""Paper that is cut to what is printed on it."""

_EDGE_MM = 8.0
"""What printers leave white around a page."""
_STRIP_MM = 14.0
"""Below what is printed: ruler and words."""
_RULER_MM = 100.0
_TEXT_MM = 3.2
_HAIR_MM = 0.2


@dataclass(frozen=True, slots=True)
class Paper:
    """Paper, in one of its two orientations.

    Attributes
    ----------
    size_mm : (float, float) or None
        Width and height; None for paper that fits.
    name : str
        How messages call it.
    """

    size_mm: tuple[float, float] | None
    name: str

    @property
    def room_mm(self) -> tuple[float, float]:
        """Width and height that can be printed on, less the ruler's strip."""
        if self.size_mm is None:
            return np.inf, np.inf
        return self.size_mm[0] - 2.0 * _EDGE_MM, self.size_mm[1] - 2.0 * _EDGE_MM - _STRIP_MM

    def page_mm(self, width: float, height: float) -> tuple[float, float]:
        """Return the page's size for something of this size."""
        if self.size_mm is not None:
            return self.size_mm
        wide = max(width, _RULER_MM + 60.0)
        return wide + 2.0 * _EDGE_MM, height + 2.0 * _EDGE_MM + _STRIP_MM


def papers(word: str) -> tuple[Paper, Paper]:
    """Return a paper upright and across.

    Parameters
    ----------
    word : str
        "a4", "a3" and so on, "fit", or width x height in millimetres, such as "600x400".

    Raises
    ------
    OptionError
        If it is none of these.
    """
    key = word.strip().lower()
    if key == FIT:
        return Paper(None, FIT), Paper(None, FIT)
    if key in PAPERS_MM:
        width, height = PAPERS_MM[key]
        return Paper((width, height), key.upper()), Paper((height, width), f"{key.upper()} across")
    match = re.fullmatch(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)", key)
    if match is None:
        raise OptionError(
            f"--paper {word}: not known; use {', '.join(PAPERS_MM)}, {FIT}, or millimetres such as "
            "600x400"
        )
    width, height = float(match[1]), float(match[2])
    if min(width, height) < _RULER_MM + 2.0 * _EDGE_MM:
        raise OptionError(
            f"--paper {word}: too small for the ruler of 100 mm; take at least 116x116"
        )
    return Paper((width, height), word), Paper((height, width), f"{height:g}x{width:g}")


def best_paper(word: str, width: float, height: float, what: str) -> Paper:
    """Return the orientation that has room for something of this size, in millimetres.

    Raises
    ------
    OptionError
        If neither has.
    """
    for paper in papers(word):
        room = paper.room_mm
        if width <= room[0] + 1e-6 and height <= room[1] + 1e-6:
            return paper
    raise OptionError(
        f"--paper {word}: {what} measures {width:g} x {height:g} mm and does not fit with its "
        f"ruler; take larger paper, '--paper {FIT}' for a print shop, or smaller squares"
    )


def sheet(paper: Paper, rectangles: FloatArray, size: tuple[float, float], words: str) -> Page:
    """Return a page with something in its middle, a ruler to check the scale, and words.

    Parameters
    ----------
    paper : Paper
        With room for it.
    rectangles : array, shape (N, 4)
        x, y, width, height of what is black, from its own top left, millimetres.
    size : (float, float)
        Width and height of the whole, light border included, in millimetres.
    words : str
        What it is, in small print.
    """
    width, height = paper.page_mm(*size)
    left, top = 0.5 * (width - size[0]), _EDGE_MM
    if paper.size_mm is not None:
        top = 0.5 * (height - _STRIP_MM - size[1])
    placed = rectangles + np.array([left, top, 0.0, 0.0])
    ruler_y = height - _EDGE_MM - 8.0
    scale = "the line above measures exactly 100 mm: print at 100 %, without fitting to the page"
    texts = (
        Text(_EDGE_MM, height - _EDGE_MM - 4.2, _TEXT_MM, words),
        Text(_EDGE_MM, height - _EDGE_MM, _TEXT_MM, scale),
    )
    return Page(width, height, np.concatenate([placed, ruler(_EDGE_MM, ruler_y)]), texts)


def ruler(x: float, y: float) -> FloatArray:
    """Return the rectangles (N, 4) of a ruler of 100 mm, with a tick every 10 mm."""
    ticks = np.arange(0.0, _RULER_MM + 1.0, 10.0)
    high = np.where(ticks % 50.0 == 0.0, 4.0, 2.5)
    # The outer edges of the first and the last tick are 100 mm apart.
    lefts = x + ticks - _HAIR_MM * ticks / _RULER_MM
    marks = np.stack([lefts, y - high, np.full_like(ticks, _HAIR_MM), high], axis=-1)
    return np.concatenate([marks, [[x, y - _HAIR_MM, _RULER_MM, _HAIR_MM]]])


def outline(x: float, y: float, width: float, height: float) -> FloatArray:
    """Return the rectangles (4, 4) of a hairline along which to cut; its middle is the cut."""
    half = 0.5 * _HAIR_MM
    return np.array(
        [
            [x - half, y - half, width + _HAIR_MM, _HAIR_MM],
            [x - half, y + height - half, width + _HAIR_MM, _HAIR_MM],
            [x - half, y + half, _HAIR_MM, height - _HAIR_MM],
            [x + width - half, y + half, _HAIR_MM, height - _HAIR_MM],
        ]
    )
