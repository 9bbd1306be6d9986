"""Matplotlib figures written to files without a display, in the style of a journal.

Figures are one or two columns wide.
"""

import importlib.util
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from aqualvs.errors import OptionError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def check_matplotlib(purpose: str) -> None:
    """Raise `OptionError` if Matplotlib is not installed, which `purpose` needs."""
    if importlib.util.find_spec("matplotlib") is None:
        raise OptionError(f"{purpose} needs matplotlib; pip install 'aqualvs[plots]'")


def new_canvas(width_in: float, height_in: float) -> "Figure":
    """Return an empty figure of a size in inches, which needs no display."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), layout="constrained")


BLUE, ORANGE, GREEN, PURPLE = "#0b5c7d", "#d55e00", "#1a8f5a", "#8a4fbf"
DARK, GREY, PALE, PINK = "#14222c", "#8796a0", "#dfe5e8", "#f06fae"
"""Blue is the accent of all pages, and dark their ink (`colours.css`)."""
OURS, PAPER, TRUTH = BLUE, ORANGE, DARK
"""The same three everywhere: what we measure, the paper's way, and the truth."""

WIDTH_IN: Mapping[str, float] = {"column": 3.5, "page": 7.2}

# Its keys are a type of their own in some versions of Matplotlib.
STYLE: dict[Any, Any] = {
    "font.size": 8.5,
    "text.color": DARK,
    "axes.titlesize": 9.0,
    "axes.edgecolor": GREY,
    "axes.labelcolor": DARK,
    "axes.linewidth": 0.7,
    "xtick.color": DARK,
    "ytick.color": DARK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": PALE,
    "grid.linewidth": 0.6,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "lines.linewidth": 1.1,
    "pdf.fonttype": 42,
    "savefig.dpi": 200,
}


@contextmanager
def new_figure(height_in: float, width: Literal["column", "page"] = "page") -> Iterator["Figure"]:
    """Yield an empty figure that needs no display, as wide as a journal's column or page.

    What is drawn inside the `with` block has the style of all figures.
    """
    from matplotlib import rc_context

    with rc_context(STYLE):
        yield new_canvas(WIDTH_IN[width], height_in)


def save_figures(figures: "Mapping[str, Figure]", folder: Path, dpi: float) -> list[Path]:
    """Write figures as `NAME.png` into a folder that exists, and return their paths.

    Raises `OSError` if a picture cannot be written.
    """
    paths = [folder / f"{name}.png" for name in figures]
    for path, figure in zip(paths, figures.values(), strict=True):
        figure.savefig(path, dpi=dpi)
    return paths
