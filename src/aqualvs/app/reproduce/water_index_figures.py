"""The figures of the index experiment: the number on the screen, and where it can be had."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from aqualvs.app.reproduce.drawing import drawn
from aqualvs.app.reproduce.experiment import Picture
from aqualvs.app.reproduce.style import BLUE, GREY, OURS, PAPER, TRUTH
from aqualvs.geometry.arrays import BoolArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Numbers:
    """What the index is said to be after each frame, F of them, shape (F,) each.

    Attributes
    ----------
    truth : array
    ours, sigma : array
        Joint estimate and its standard deviation.
    paper : array
        The paper's way: each frame by itself, everything but the index held.
    """

    truth: FloatArray
    ours: FloatArray
    sigma: FloatArray
    paper: FloatArray

    def after(self, start: int, every: int = 1) -> "Numbers":
        """Return frame `start` and every so-many-th after it."""
        part = slice(start, None, every)
        return Numbers(self.truth[part], self.ours[part], self.sigma[part], self.paper[part])


@dataclass(frozen=True, slots=True)
class Decentred:
    """How well an index is known by how far the lens is off the dome's centre, shape (L,) each.

    Attributes
    ----------
    lens_mm : array
    noise, placed : array
        Standard deviation of the index, target's place known exactly, or as well as one measures.
    observable : bool array
        Whether the system believes the latter.
    """

    lens_mm: FloatArray
    noise: FloatArray
    placed: FloatArray
    observable: BoolArray


def index_picture(wet: Numbers, n_each: int) -> Picture:
    """Return the estimates in the waters, `n_each` frames of each."""
    return drawn(
        "index",
        "The number on the screen, frame by frame, through six waters: the truth, ours with two "
        "standard deviations, and the paper's way. Below: what both are off. A change is believed "
        "with its fourth frame; until then ours stays.",
        2.8,
        lambda figure: _draw_numbers(figure, wet, n_each),
    )


def target_picture(
    example: "NDArray[np.uint8]", spread: Decentred, largest_sigma: float
) -> Picture:
    """Return the target in view, and the standard deviation by the lens's place."""
    return drawn(
        "figure_5",
        "Beside figure 5: the target in the camera's view, and how well ten frames of it tell the "
        "index, by how far the lens sits off the dome's centre.",
        2.7,
        lambda figure: _draw_target(figure, example, spread, largest_sigma),
    )


def _draw_numbers(figure: "Figure", wet: Numbers, n_each: int) -> None:
    number = np.arange(1, len(wet.truth) + 1)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(1.5, 1.0))
    upper.step(number, wet.truth, where="mid", color=TRUTH, linewidth=0.9, label="truth")
    for axes, minus in ((upper, 0.0), (lower, wet.truth)):
        low, high = (wet.ours + k * wet.sigma - minus for k in (-2.0, 2.0))
        axes.fill_between(number, low, high, step="mid", color=OURS, alpha=0.18, linewidth=0.0)
        axes.plot(number, wet.ours - minus, "o", color=OURS, markersize=2.6, label="ours, ± 2 σ")
        axes.plot(
            number, wet.paper - minus, "x", color=PAPER, markersize=3.5, label="the paper's way"
        )
        axes.grid(axis="x", visible=False)
    lower.axhline(0.0, color=TRUTH, linewidth=0.9)
    upper.set(ylabel="index of the water", ylim=(wet.truth.min() - 4e-3, wet.truth.max() + 14e-3))
    upper.legend(loc="upper left", ncols=3)
    lower.set(ylabel="error", xlabel=f"frame, {n_each} in each water", ylim=(-5e-3, 10e-3))
    lower.set_xticks(number[::n_each])


def _draw_target(
    figure: "Figure", example: "NDArray[np.uint8]", spread: Decentred, largest_sigma: float
) -> None:
    picture, chart = figure.subplots(1, 2, width_ratios=(1.0, 1.25))
    picture.imshow(example)
    picture.set(xticks=[], yticks=[])
    picture.grid(visible=False)
    picture.spines[:].set_visible(False)
    off = spread.lens_mm > 0.0
    lens = spread.lens_mm[off]
    for sigma, colour, name in (
        (spread.placed[off], GREY, "target's place known to 0.2 mm and 0.1°"),
        (spread.noise[off], BLUE, "target's place known exactly"),
    ):
        chart.loglog(lens, sigma, "o-", color=colour, markersize=3, label=name)
    chart.axhspan(largest_sigma, 1.0, color=PAPER, alpha=0.12, linewidth=0.0)
    chart.text(12.0, 0.03, "called unobservable", color=PAPER, fontsize=7.5)
    chart.set(ylim=(5e-6, 0.1), xlabel="lens off the dome's centre (mm)", ylabel="σ of the index")
    chart.set_xticks([1, 2, 5, 10, 20, 40], ["1", "2", "5", "10", "20", "40"])
    chart.minorticks_off()
    chart.legend(loc="lower left")
