"""Words and colours that several outputs share: pages, pictures and messages.

Colours are those of Okabe and Ito (https://jfly.uni-koeln.de/color/), which remain distinct under
the common forms of colour blindness.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Self

from aqualvs.scanning.posture import Reason
from aqualvs.scanning.scan import Label


class Severity(StrEnum):
    """Severity of a finding."""

    OK = "ok"
    WARN = "warn"
    BAD = "bad"
    """It does not work as it is."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing found about a rig, the machine or the vehicle."""

    severity: Severity
    sentence: str  # What was found, with the value, and the remedy where one is needed.

    @classmethod
    def ok(cls, sentence: str) -> Self:
        """Return a finding that nothing is wrong."""
        return cls(Severity.OK, sentence)

    @classmethod
    def warn(cls, sentence: str) -> Self:
        """Return a warning."""
        return cls(Severity.WARN, sentence)

    @classmethod
    def bad(cls, sentence: str) -> Self:
        """Return a finding of what does not work as it is."""
        return cls(Severity.BAD, sentence)


REASON_WORDS: dict[str, str] = {
    Reason.NO_STRIPES: "no stripes seen",
    Reason.TOO_FEW_POINTS: "too few points on the target",
    Reason.ONE_LASER: "only one laser on the target",
    Reason.COLLINEAR: "points lie on one line",
    Reason.NOT_A_PLANE: "stripes share no plane",
    Reason.AMBIGUOUS: "stripes fit two planes",
    Reason.NO_TARGET: "no target of the kind asked for",
    Reason.BLURRED: "blurred by motion",
    Reason.OUT_OF_RANGE: "target outside the working range",
    Reason.CORRUPT_FRAME: "frame could not be decoded",
    Reason.WRONG_SIZE: "picture of another size",
    Reason.NO_FRAMES: "stream silent",
    Reason.FROZEN: "picture stands still",
}

_LABELS = {
    Label.NET: ("net", "#009E73"),
    Label.SOLID: ("solid", "#E69F00"),
    Label.FISH: ("fish", "#D55E00"),
    Label.BUBBLE: ("bubble", "#56B4E9"),
    Label.BACKGROUND: ("behind the target", "#0072B2"),
    Label.CLUTTER: ("clutter", "#555555"),
    Label.AMBIGUOUS: ("ambiguous", "#CC79A7"),
    Label.OUT_OF_RANGE: ("out of range", "#999999"),
}
LABEL_WORDS = {label: words for label, (words, _) in _LABELS.items()}
LABEL_COLOURS = {label: colour for label, (_, colour) in _LABELS.items()}

# The first colours are visible on a dark green picture and on white paper.
LASER_COLOURS = ("#E69F00", "#56B4E9", "#CC79A7", "#D55E00", "#0072B2", "#009E73", "#F0E442")


def reason_text(reason: str) -> str:
    """Return a refusal as text; an unknown reason is returned in readable form."""
    key, _, detail = reason.partition(":")
    words = REASON_WORDS.get(key.strip(), key.strip().replace("_", " ")) or "no reason given"
    return f"{words} ({detail.strip()})" if detail.strip() else words


def laser_colour(index: int) -> str:
    """Return the colour, as #RRGGBB, of laser `index` in every chart and picture."""
    return LASER_COLOURS[index % len(LASER_COLOURS)]


def bgr(colour: str) -> tuple[int, int, int]:
    """Return #RRGGBB as OpenCV's (blue, green, red)."""
    value = int(colour.removeprefix("#"), 16)
    return value & 255, (value >> 8) & 255, value >> 16


def clock(seconds: float) -> str:
    """Return a time since the start as m:ss, or h:mm:ss from one hour on; short ones as 7.3 s."""
    if seconds < 60.0:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def count_text(n: int, word: str, *, commas: bool = False) -> str:
    """Return a number of things: "1 fault", "2000 faults", or "2,000 faults" with commas."""
    number = f"{n:,}" if commas else str(n)
    return f"{number} {word}" if n == 1 else f"{number} {word}s"


def are_holes_searched(n_holes: int, area_m2: float | None) -> bool:
    """Return whether holes were searched for, by their number and the area that was looked at.

    A net whose mesh is not known has no place for them. Of older files the area may be unknown.
    """
    return n_holes > 0 or area_m2 != 0.0


def hole_count(n_holes: int, area_m2: float) -> str:
    """Return the number of holes on an area of net as text: none of no area is no finding."""
    if not are_holes_searched(n_holes, area_m2):
        return "not searched for holes"
    return "no hole" if not n_holes else "1 hole" if n_holes == 1 else f"{n_holes} holes"


def sentence(words: str) -> str:
    """Return words with a capital letter and a full stop, if they do not ask."""
    return f"{words[:1].upper()}{words[1:]}{'' if words.endswith('?') else '.'}"


def with_sign(value: float, digits: int) -> str:
    """Return a number with its sign: "+1.2", "-1.2"; what rounds to zero has none."""
    text = f"{value:+.{digits}f}"
    return text if float(text) else text[1:]


def signed(text: str) -> str:
    """Return text with a true minus sign before its negative numbers."""
    return text.replace("-", "−")
