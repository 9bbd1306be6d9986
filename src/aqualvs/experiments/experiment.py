"""Experiments and their results, and the catalogue of experiments by name.

An experiment is a function that returns findings, figures and series. All figures have one style.
The catalogue has the paper's order; each experiment is imported when it is run.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal, Self, TypeAlias

from matplotlib.figure import Figure

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.report.figure_style import new_figure

if TYPE_CHECKING:
    from aqualvs.experiments.laboratory import Laboratory


Column: TypeAlias = FloatArray | IntArray | list[str]


@dataclass(frozen=True, slots=True, kw_only=True)
class ExperimentRow:
    """One row of an experiment's table."""

    what: str  # The quantity, with its unit.
    paper: str = ""  # Value in the paper; empty if it has none.
    ours: str  # Value measured here.
    bar: str = ""  # Criterion; empty if there is none.
    met: bool | None = None  # Whether the criterion is met; None without one.

    @classmethod
    def at_most(
        cls,
        what: str,
        value: float,
        limit: float,
        *,
        digits: int,
        paper: str = "",
        valid: bool = True,
    ) -> Self:
        """Return the row of a value that must not exceed a limit; not met if not `valid`."""
        return cls(
            what=what,
            paper=paper,
            ours=f"{value:.{digits}f}",
            bar=f"<= {limit:g}",
            met=valid and bool(value <= limit),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ExperimentFigure:
    """Figure of an experiment."""

    name: str  # Stem of its files, such as `figure_15`.
    caption: str  # With the figure of the paper to compare it with.
    figure: Figure  # From `figure_style.new_figure`.


@dataclass(frozen=True, slots=True, kw_only=True)
class DataColumns:
    """Data of a figure, for a CSV file: columns of one length with units in their names."""

    name: str
    columns: Mapping[str, Column]


@dataclass(frozen=True, slots=True, kw_only=True)
class ExperimentResult:
    """Results of an experiment."""

    sentence: str  # The result in one sentence, with its numbers.
    findings: tuple[ExperimentRow, ...]
    pictures: tuple[ExperimentFigure, ...] = ()
    series: tuple[DataColumns, ...] = ()
    # Differences from the paper's setting and their reasons, and other limits of the result.
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """Experiment of the paper, or an ablation."""

    name: str  # On the command line.
    title: str
    paper: str = ""  # Section and figure of the paper; empty for an ablation.
    about: str  # The setting, in one or two sentences.
    # It must depend on nothing but the laboratory, so that a version gives the same numbers on
    # every machine.
    run: "Callable[[Laboratory], ExperimentResult]"


def listed(values: FloatArray, digits: int) -> str:
    """Return numbers for a table, with a number of decimals."""
    return ", ".join(f"{value:.{digits}f}" for value in values)


def drawn(
    name: str,
    caption: str,
    height_in: float,
    draw: Callable[[Figure], None],
    width: Literal["column", "page"] = "page",
) -> ExperimentFigure:
    """Return a figure of a height in inches, which `draw` fills."""
    with new_figure(height_in, width) as figure:
        draw(figure)
    return ExperimentFigure(name=name, caption=caption, figure=figure)


_PACKAGE = "aqualvs.experiments"

MODULES: Mapping[str, str] = MappingProxyType(
    {
        "rig": "rig_table:EXPERIMENT",
        "dome": "dome_boards:EXPERIMENT",
        "index": "water_index:EXPERIMENT",
        "box": "laser_box:EXPERIMENT",
        "mesh": "mesh_filter:EXPERIMENT",
        "distance": "tank:DISTANCE",
        "angles": "tank:ANGLES",
        "dome-or-not": "dome_or_not:EXPERIMENT",
        "sea": "sea:SEA",
        "control": "sea:CONTROL",
        "failures": "growth_and_sun:EXPERIMENT",
        "stripes": "ablation_stages:STRIPES",
        "filters": "ablation_stages:FILTERS",
        "fits": "ablation_stages:FITS",
        "sheets": "ablation_inputs:SHEETS",
        "beliefs": "ablation_inputs:BELIEFS",
        "video": "ablation_inputs:VIDEO",
    }
)
"""By name: module and constant of each experiment."""


def ordered(names: Sequence[str]) -> list[str]:
    """Return these names in the catalogue's order, without repetition; all names for none.

    Raises `OptionError` if a name is not in the catalogue.
    """
    for name in names:
        if name not in MODULES:
            raise OptionError(f"{name}: no such experiment; choose from {', '.join(MODULES)}")
    return [name for name in MODULES if not names or name in names]


def experiment(name: str) -> Experiment:
    """Return an experiment of the catalogue."""
    module, constant = MODULES[name].split(":")
    found: Experiment = getattr(import_module(f"{_PACKAGE}.{module}"), constant)
    return found
