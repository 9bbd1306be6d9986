"""What an experiment is, and what comes out of one."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

from aqualvs.geometry.arrays import FloatArray, IntArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from aqualvs.app.reproduce.laboratory import Laboratory

Column: TypeAlias = FloatArray | IntArray | list[str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One row of an experiment's table.

    Attributes
    ----------
    what : str
        The quantity, with its unit.
    paper : str
        As the paper prints it; empty where it says nothing.
    ours : str
        As measured here.
    bar : str
        What we hold ourselves to; empty where there is no such thing.
    met : bool or None
        Whether it is reached; None without a bar.
    """

    what: str
    paper: str
    ours: str
    bar: str = ""
    met: bool | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """A figure to print.

    Attributes
    ----------
    name : str
        Stem of its files, such as `figure_15`.
    caption : str
        What it shows and which figure of the paper it stands beside.
    figure : matplotlib.figure.Figure
        From `style.new_figure`.
    """

    name: str
    caption: str
    figure: "Figure"


@dataclass(frozen=True, slots=True, kw_only=True)
class Series:
    """The numbers behind a picture, for a CSV: columns of one length with units in their names."""

    name: str
    columns: Mapping[str, Column]


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What an experiment found.

    Attributes
    ----------
    sentence : str
        The result in one sentence, with its numbers.
    findings : tuple of Finding
    pictures : tuple of Picture
    series : tuple of Series
    notes : tuple of str
        What a reader must know to judge it: where it differs from the paper's setting, and why.
    """

    sentence: str
    findings: tuple[Finding, ...]
    pictures: tuple[Picture, ...] = ()
    series: tuple[Series, ...] = ()
    notes: tuple[str, ...] = field(default=())


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """One experiment of the paper, or one that explains a choice of ours.

    Attributes
    ----------
    name : str
        What is typed to run it alone.
    title : str
    paper : str
        Where the paper has it, such as "section 5.3, figure 15"; empty for our own.
    about : str
        The setting, in one or two sentences.
    run : callable
        Takes the laboratory, gives the outcome. It must depend on nothing else, so that the same
        version gives the same numbers on every machine.
    """

    name: str
    title: str
    paper: str
    about: str
    run: "Callable[[Laboratory], Outcome]"
