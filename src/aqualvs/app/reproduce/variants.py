"""The same dive measured in several ways, side by side."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from aqualvs.app.reproduce.experiment import Finding, Series
from aqualvs.app.reproduce.laboratory import Measured
from aqualvs.app.reproduce.style import GREY, OURS, STYLE, new_figure
from aqualvs.geometry.arrays import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

QUANTITIES = ("range (%)", "pitch (degrees)", "yaw (degrees)")
_LEAST = 1e-3


@dataclass(frozen=True, slots=True)
class Variant:
    """One way to measure, over one dive or several.

    Attributes
    ----------
    name : str
    measured : tuple of Measured
    ours : bool
        Whether this is what `aqualvs` does by default.
    """

    name: str
    measured: tuple[Measured, ...]
    ours: bool = False

    @property
    def valid_percent(self) -> float:
        """Share of the frames that have a posture."""
        return 100.0 * float(np.mean(np.concatenate([m.valid for m in self.measured])))

    @property
    def errors(self) -> FloatArray:
        """Errors of each frame, shape (N, 3): range in percent, pitch and yaw in degrees."""
        return np.concatenate([m.errors_told for m in self.measured])

    @property
    def rms(self) -> FloatArray:
        """Root mean square of the errors, shape (3,); NaN where no frame has a posture."""
        found = self.errors[np.isfinite(self.errors[:, 0])]
        return np.asarray(np.sqrt(np.mean(found**2, axis=0))) if len(found) else np.full(3, np.nan)


def findings(variants: Sequence[Variant]) -> tuple[Finding, ...]:
    """Return a row for each variant: root mean square errors, and frames with a posture."""
    return tuple(
        Finding(
            what=f"{one.name}: rms error of range (%), pitch, yaw (degrees); frames with a posture",
            paper="",
            ours=f"{told(one.rms)}; {one.valid_percent:.0f} %",
        )
        for one in variants
    )


def told(values: Sequence[float] | FloatArray) -> str:
    """Return numbers for a table, a dash for those that are not."""
    return ", ".join("-" if not np.isfinite(x) else f"{x:.3g}" for x in values)


def series(name: str, variants: Sequence[Variant]) -> Series:
    """Return what `drawn` shows as columns."""
    rms = np.array([one.rms for one in variants])
    columns: dict[str, FloatArray | list[str]] = {"variant": [one.name for one in variants]}
    for k, what in enumerate(("rms_range_percent", "rms_pitch_deg", "rms_yaw_deg")):
        columns[what] = rms[:, k]
    columns["valid_percent"] = np.array([one.valid_percent for one in variants])
    return Series(name=name, columns=columns)


def drawn(variants: Sequence[Variant]) -> "Figure":
    """Draw rms errors as bars on a logarithmic scale, and the share of frames with a posture."""
    from matplotlib import rc_context

    names = [one.name for one in variants]
    rms = np.array([one.rms for one in variants])
    valid = np.array([one.valid_percent for one in variants])
    with rc_context(dict(STYLE)):
        figure = new_figure(0.9 + 0.3 * len(variants))
        panels = figure.subplots(1, 4, sharey=True)
        for k, axes in enumerate(panels[:3]):
            _bars(axes, variants, rms[:, k], QUANTITIES[k])
            axes.set_xscale("log")
            low = np.nanmin(np.where(rms > 0.0, rms, np.nan)) if np.isfinite(rms).any() else _LEAST
            axes.set_xlim(0.5 * max(low, _LEAST), 4.0 * max(np.nanmax(rms), 2.0 * _LEAST))
        _bars(panels[3], variants, valid, "valid frames (%)")
        panels[3].set_xlim(0.0, 125.0)
        panels[0].set_yticks(range(len(names)), names)
        panels[0].invert_yaxis()
        panels[0].set_title("rms error", loc="left")
    return figure


def _bars(axes: "Axes", variants: Sequence[Variant], values: FloatArray, name: str) -> None:
    colours = [OURS if one.ours else GREY for one in variants]
    shown = np.where(np.isfinite(values), values, 0.0)
    axes.barh(range(len(values)), shown, height=0.6, color=colours)
    for k, value in enumerate(values):
        words = f" {value:.2g}" if value < 1.0 else f" {value:.3g}"
        if np.isfinite(value):
            axes.text(value, k, words, va="center", fontsize=7.0)
        else:
            axes.text(
                0.5, k, "none", va="center", fontsize=7.0, transform=axes.get_yaxis_transform()
            )
    axes.set_xlabel(name)
    axes.grid(visible=False, axis="y")
