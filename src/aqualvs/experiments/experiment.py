"""Experiments and their results, and the catalogue of experiments by name.

An experiment is a function that returns findings, figures and series. All figures have one style.
The catalogue has the paper's order; each experiment is imported when it is run.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal, Self, TypeAlias

from matplotlib.axes import Axes
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


def draw_dots(
    axes: Axes,
    x: FloatArray,
    y: FloatArray,
    bars: FloatArray,
    colour: str,
    *,
    bar_width: float = 0.6,
    label: str | None = None,
) -> None:
    """Draw a dot with an error bar for each frame."""
    axes.errorbar(
        x, y, bars, fmt=".", color=colour, markersize=3.5, elinewidth=bar_width, label=label
    )


MODULES: Mapping[str, tuple[str, float]] = MappingProxyType(
    {
        "rig": ("rig_table:EXPERIMENT", 2.0),
        "dome": ("dome_boards:EXPERIMENT", 9.0),
        "index": ("water_index:EXPERIMENT", 14.0),
        "box": ("laser_box:EXPERIMENT", 10.0),
        "mesh": ("mesh_filter:EXPERIMENT", 45.0),
        "distance": ("tank:DISTANCE", 31.0),
        "angles": ("tank:ANGLES", 47.0),
        "dome-or-not": ("dome_or_not:EXPERIMENT", 14.0),
        "sea": ("sea:SEA", 32.0),
        "control": ("sea:CONTROL", 2.0),
        "failures": ("growth_and_sun:EXPERIMENT", 58.0),
        "stripes": ("ablation_stages:STRIPES", 1.0),
        "filters": ("ablation_stages:FILTERS", 1.0),
        "fits": ("ablation_stages:FITS", 1.0),
        "sheets": ("ablation_inputs:SHEETS", 11.0),
        "beliefs": ("ablation_inputs:BELIEFS", 2.0),
        "video": ("ablation_inputs:VIDEO", 17.0),
    }
)
"""By name: module and constant of each experiment, and its typical seconds, of which only ratios
matter once some are done."""


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
    module, constant = MODULES[name][0].split(":")
    found: Experiment = getattr(import_module(f"aqualvs.experiments.{module}"), constant)
    return found
