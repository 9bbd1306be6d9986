"""Tracking of the water's refractive index during a run, by a target on the vehicle (paper, 2.2).

Calibration modules are imported where they are used, because every run imports this module and few
track the water.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from aqualvs.errors import OptionError
from aqualvs.optics.rig import Rig
from aqualvs.optics.solved import rig_uncertainty
from aqualvs.results.run_request import Water
from aqualvs.scanner import Scanner, ScannerOptions
from aqualvs.scanning.scan import Frame, Scan

if TYPE_CHECKING:
    from aqualvs.calibration.water_index.state import IndexPrior, IndexReading


# Reading the target's markers takes longer than measuring a frame; the index hardly changes.
_FIRST_FRAMES, _EVERY_S = 5, 0.4
# Smaller changes of the index change the range by less than 0.003 % and need no new scanner.
_WORTH = 2e-4
_MIN_SIGMA_TO_FOLLOW = 4e-3
# Accuracy of a user's measurement of the plate's place; only the index is tracked.
_PLACE_MM, _TURN_DEG = 0.2, 0.1


class WaterFollowingScanner:
    """Scanner that measures each frame in the water as tracked by the index target.

    Parameters
    ----------
    rig : Rig
        In the water to begin with.
    options : ScannerOptions
    target : Path
        Markers on the vehicle (target.yaml).
    water : Water
        Temperature and salinity, if given, are a prior.

    Attributes
    ----------
    scanner : Scanner
        For the water as it is known.

    Raises
    ------
    CalibrationError
        If the target's file cannot be used.
    OptionError
        If the camera is interlaced.
    """

    def __init__(self, rig: Rig, options: ScannerOptions, target: Path, water: Water) -> None:
        from aqualvs.calibration.targets.target_files import load_target
        from aqualvs.calibration.water_index.estimator import IndexEstimator
        from aqualvs.calibration.water_index.state import IndexOptions

        self._rig, self._options, self._target = rig, options, target
        if rig.shutter.is_interlaced:
            raise OptionError(
                "--index-target: markers are not looked for in fields of an interlaced camera; "
                "leave it out, and give --water-n or --temperature-c and --salinity"
            )
        self.scanner = Scanner(rig, options)
        self._markers = load_target(target)
        self._estimator = IndexEstimator(
            rig,
            uncertainty=rig_uncertainty(rig),
            prior=_prior(water, rig),
            options=IndexOptions.of_target(_PLACE_MM, _TURN_DEG),
        )
        self._next_s = -np.inf
        self._n_read = 0
        self._last: IndexReading | None = None

    def process(self, frame: Frame) -> Scan:
        """Measure a frame in the water as presently known."""
        if self.is_due(frame):
            self.look(frame)
        return self.scanner.process(frame)

    @property
    def sigma_n_water(self) -> float:
        """Standard deviation of the index; NaN until the target has been seen."""
        return float("nan") if self._last is None else self._last.sigma

    def lines(self) -> list[str]:
        """Return the lines of the run's summary about the water."""
        last = self._last
        if last is None:
            return [
                f"{self._target}: the target was never seen; measured with index "
                f"{self._rig.n_water:.4f}"
            ]
        found = [f"water index {last.n:.5f} ± {last.sigma:.5f} from {self._n_read} frames"]
        if not last.observable:
            found.append("the pictures alone cannot tell the index; see aqualvs check")
        return found + [step.text() for step in self._estimator.steps]

    def is_due(self, frame: Frame) -> bool:
        """Return whether the target should be read in this frame."""
        return self._n_read < _FIRST_FRAMES or frame.time_s >= self._next_s

    def look(self, frame: Frame) -> None:
        """Read the target in a frame; makes another scanner if the water has changed."""
        from aqualvs.calibration.detection.detection import detect_markers
        from aqualvs.calibration.targets.targets import View

        self._next_s = frame.time_s + _EVERY_S
        grey = np.ascontiguousarray(frame.luma)
        view = detect_markers(grey, self._markers, f"frame {frame.index}")
        if not isinstance(view, View):
            return
        reading = self._estimator.add(frame.time_s, view)
        if not reading:
            return
        self._last, self._n_read = reading, self._n_read + 1
        trusted = reading.sigma < _MIN_SIGMA_TO_FOLLOW
        if trusted and abs(reading.n - self.scanner.rig.n_water) > _WORTH:
            self.scanner = Scanner(self._rig.in_water(max(reading.n, 1.0)), self._options)


def _prior(water: Water, rig: Rig) -> "IndexPrior | None":
    from aqualvs.calibration.water_index.state import IndexPrior

    if water.temperature_c is None or water.salinity is None:
        return None
    return IndexPrior.seawater(water.temperature_c, water.salinity, n_air=rig.n_air)
