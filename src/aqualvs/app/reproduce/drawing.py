"""A figure in the style of all experiments, from what draws it."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from aqualvs.app.reproduce.experiment import Picture
from aqualvs.app.reproduce.style import STYLE, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def drawn(name: str, caption: str, height_in: float, draw: "Callable[[Figure], None]") -> Picture:
    """Return a picture of a page's width.

    Parameters
    ----------
    name, caption : str
        As in `Picture`.
    height_in : float
        Height in inches.
    draw : callable
        Fills the figure.
    """
    from matplotlib import rc_context

    with rc_context(dict(STYLE)):
        figure = new_figure(height_in)
        draw(figure)
    return Picture(name=name, caption=caption, figure=figure)
