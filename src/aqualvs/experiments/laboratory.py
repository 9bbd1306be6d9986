"""Simulated water tank of the experiments: rendered dives with truth, and measurements of them.

A dive is rendered once and can be measured several times; `Variant` compares several methods on the
same dives. `calibrated_rig` is calibrated from pictures by the commands that a user would run.
"""

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from aqualvs.calibrate.camera import CameraRequest, run_camera
from aqualvs.calibrate.dome import DomeRequest, run_dome
from aqualvs.calibrate.lasers import LasersRequest, run_lasers
from aqualvs.experiments.experiment import (
    DataColumns,
    ExperimentFigure,
    ExperimentResult,
    ExperimentRow,
    drawn,
)
from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import load_rig, rig_to_mapping, save_rig
from aqualvs.report.figure_style import GREY, OURS
from aqualvs.results.summary import read_truth
from aqualvs.scanner import Scanner, ScannerOptions
from aqualvs.scanning.posture import Posture
from aqualvs.scanning.scan import Frame, Scan
from aqualvs.simulation.calibration_set import CalibrationFiles, SetSize, simulate_calibration
from aqualvs.simulation.dive import simulate_dive
from aqualvs.simulation.scenario import Scenario
from aqualvs.simulation.scenarios import example_rig
from aqualvs.simulation.video import Compression
from aqualvs.sources import open_source

_DEG = 180.0 / np.pi
_VIDEO, _TRUTH, _RIG, _READY = "dive.mp4", "truth.csv", "rig.yaml", "ready.json"


@dataclass(frozen=True, slots=True)
class RenderedDive:
    """Rendered dive on disk."""

    # With `dive.mp4`, `truth.csv` and `rig.yaml`, and `points_FFFF.npz` of the requested frames.
    folder: Path
    rig: Rig  # True rig.
    scenario: Scenario

    @property
    def video(self) -> Path:
        """Path of the video."""
        return self.folder / _VIDEO

    @property
    def truth(self) -> Path:
        """Path of the truth, for `read_truth`."""
        return self.folder / _TRUTH


@dataclass(frozen=True, slots=True)
class MeasuredDive:
    """Dive measured by one scanner, N frames, with the truth."""

    scans: list[Scan]
    truth: FloatArray  # Shape (N, 3): range in m, pitch and yaw in radians; NaN if unknown.

    @property
    def time_s(self) -> FloatArray:
        """Time of each frame, shape (N,)."""
        return np.array([scan.time_s for scan in self.scans])

    @property
    def postures(self) -> list[Posture | None]:
        """Posture of each frame, None where it was refused."""
        return [s.posture if isinstance(s.posture, Posture) else None for s in self.scans]

    @property
    def valid(self) -> BoolArray:
        """True for frames that have a posture, shape (N,)."""
        return np.array([posture is not None for posture in self.postures], np.bool_)

    @property
    def values(self) -> FloatArray:
        """Range (m), pitch and yaw (rad) of each frame, NaN where refused; shape (N, 3)."""
        nothing = (np.nan,) * 3
        rows = [nothing if p is None else (p.range, p.pitch, p.yaw) for p in self.postures]
        return np.array(rows).reshape(-1, 3)

    @property
    def sigmas(self) -> FloatArray:
        """One standard deviation of `values`, shape (N, 3)."""
        nothing = np.full(3, np.nan)
        rows = [nothing if p is None else np.diag(p.covariance) for p in self.postures]
        return np.asarray(np.sqrt(np.array(rows).reshape(-1, 3)))

    @property
    def valid_percent(self) -> float:
        """Share of the frames that have a posture."""
        return 100.0 * float(np.mean(self.valid))

    def columns(self, k: int) -> dict[str, FloatArray]:
        """Return truth, value and sigma of range (0), pitch (1) or yaw (2) as columns."""
        name, scale = (("range_m", 1.0), ("pitch_deg", _DEG), ("yaw_deg", _DEG))[k]
        tables = {"true_": self.truth, "": self.values, "sigma_": self.sigmas}
        return {f"{what}{name}": scale * table[:, k] for what, table in tables.items()}

    @property
    def errors(self) -> FloatArray:
        """Errors, shape (N, 3): range in percent of the true one, pitch and yaw in degrees."""
        return self._in_units(self.values - self.truth)

    @property
    def error_sigmas(self) -> FloatArray:
        """`sigmas` in the units of `errors`, shape (N, 3)."""
        return self._in_units(self.sigmas)

    @property
    def largest(self) -> FloatArray:
        """Largest magnitudes of the errors, shape (3,)."""
        return np.asarray(np.nanmax(np.abs(self.errors), axis=0))

    @property
    def rms(self) -> FloatArray:
        """Root mean square of the errors, shape (3,); NaN if no frame has a posture."""
        found = self.errors[np.isfinite(self.errors[:, 0])]
        return np.asarray(np.sqrt(np.mean(found**2, axis=0))) if len(found) else np.full(3, np.nan)

    def _in_units(self, table: FloatArray) -> FloatArray:
        percent = 100.0 * table[:, 0] / self.truth[:, 0]
        return np.column_stack([percent, np.degrees(table[:, 1:])])


class Laboratory:
    """Simulated tank that renders dives and measures them; repeated calls reuse the results.

    `work`: folder for the dives, which later runs reuse. `tick`: called with the number of frames
    rendered since the last call.
    """

    def __init__(self, work: Path, tick: Callable[[int], None] | None = None) -> None:
        self._work = work
        self._tick = tick or (lambda _n: None)
        self._measured: dict[tuple[str, str], MeasuredDive] = {}
        # Seconds of the scanner for each frame measured with its default options.
        self.frame_s: list[float] = []

    @cached_property
    def rig(self) -> Rig:
        """The rig of the experiments, after the paper's Table 1."""
        return example_rig()

    def rendered(self, _done: int, _all: int) -> None:
        """Count a rendered picture; the `progress` callback of renderers."""
        self._tick(1)

    def folder(self, name: str) -> Path:
        """Return a folder for the files of an experiment; create it if needed."""
        folder = self._work / name
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def dive(
        self,
        scenario: Scenario,
        rig: Rig | None = None,
        *,
        recording: Compression | None = None,
        point_frames: tuple[int, ...] = (),
    ) -> RenderedDive:
        """Return a dive with its truth, by default with `self.rig`; render it on the first call.

        The folder is named by the scenario and a digest of everything that affects the pictures.
        `recording` and `point_frames` are those of `simulate_dive`.
        """
        rig = rig or self.rig
        facts = {
            "scenario": repr(scenario),
            "rig": rig_to_mapping(rig),
            "video": [repr(recording or Compression()), list(point_frames)],
        }
        folder = self._work / "dives" / f"{scenario.name}-{_digest(facts)}"
        if not (folder / _READY).exists():
            simulate_dive(
                scenario,
                rig,
                folder,
                progress=self.rendered,
                point_frames=point_frames,
                recording=recording,
            )
            save_rig(rig, folder / _RIG)
            (folder / _READY).write_text(json.dumps(facts, default=str), encoding="utf-8")
        return RenderedDive(folder, rig, scenario)

    def measure(
        self, dive: RenderedDive, options: ScannerOptions | None = None, *, rig: Rig | None = None
    ) -> MeasuredDive:
        """Measure every frame of a dive.

        `rig`: rig of the scanner; the true rig by default.
        """
        assumed = rig or dive.rig
        options = options or ScannerOptions()
        key = (dive.folder.name, _digest([repr(options), rig_to_mapping(assumed)]))
        if key not in self._measured:
            frame_s = self.frame_s if options == ScannerOptions() else []
            self._measured[key] = _measured(dive, Scanner(assumed, options), frame_s)
        return self._measured[key]


def frames_of(dive: RenderedDive) -> list[Frame]:
    """Return the decoded frames of a dive."""
    with open_source(str(dive.video)) as source:
        return list(source)


def _measured(dive: RenderedDive, scanner: Scanner, frame_s: list[float]) -> MeasuredDive:
    """Measure all frames of a dive; append the scanner's times to `frame_s`."""
    scans = []
    with open_source(str(dive.video)) as source:
        for frame in source:
            start = time.perf_counter()
            scans.append(scanner.process(frame))
            frame_s.append(time.perf_counter() - start)
    truth = read_truth(dive.truth)
    rows = np.full((len(scans), 3), np.nan)
    for i, scan in enumerate(scans):
        if scan.index in truth:
            metres, pitch_deg, yaw_deg = truth[scan.index]
            rows[i] = metres, np.deg2rad(pitch_deg), np.deg2rad(yaw_deg)
    return MeasuredDive(scans, rows)


def _digest(facts: Mapping[str, Any] | list[Any]) -> str:
    text = json.dumps(facts, sort_keys=True, default=repr)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


QUANTITIES = ("range (%)", "pitch (degrees)", "yaw (degrees)")


@dataclass(frozen=True, slots=True)
class Variant:
    """Measurements of a dive by one method."""

    name: str
    measured: MeasuredDive
    ours: bool = False  # Whether this is the default of `aqualvs`.


def numbers_text(values: Sequence[float] | FloatArray) -> str:
    """Return numbers for a table, with a dash for those that are not finite."""
    return ", ".join("-" if not np.isfinite(x) else f"{x:.3g}" for x in values)


def variants_picture(name: str, caption: str, variants: Sequence[Variant]) -> ExperimentFigure:
    """Draw rms errors as bars on a logarithmic scale, and the share of frames with a posture."""
    height_in = 0.9 + 0.3 * len(variants)
    return drawn(name, caption, height_in, lambda figure: _draw_variants(figure, variants))


def _draw_variants(figure: Figure, variants: Sequence[Variant]) -> None:
    rms = np.array([one.measured.rms for one in variants])
    valid = np.array([one.measured.valid_percent for one in variants])
    least = 1e-3
    panels = figure.subplots(1, 4, sharey=True)
    for k, axes in enumerate(panels[:3]):
        _bars(axes, variants, rms[:, k], QUANTITIES[k])
        axes.set_xscale("log")
        low = np.nanmin(np.where(rms > 0.0, rms, np.nan)) if np.isfinite(rms).any() else least
        axes.set_xlim(0.5 * max(low, least), 4.0 * max(np.nanmax(rms), 2.0 * least))
    _bars(panels[3], variants, valid, "valid frames (%)")
    panels[3].set_xlim(0.0, 125.0)
    panels[0].set_yticks(range(len(variants)), [one.name for one in variants])
    panels[0].invert_yaxis()
    panels[0].set_title("rms error", loc="left")


def compared(
    name: str,
    caption: str,
    variants: Sequence[Variant],
    *,
    sentence: str,
    more_findings: Sequence[ExperimentRow] = (),
    notes: tuple[str, ...] = (),
) -> ExperimentResult:
    """Return the result of a comparison: a row for each variant, a figure of all, and its data.

    `name` and `caption` are those of the figure; the other parameters are as in `ExperimentResult`.
    """
    rms = np.array([one.measured.rms for one in variants])
    columns: dict[str, FloatArray | list[str]] = {"variant": [one.name for one in variants]}
    for k, what in enumerate(("rms_range_percent", "rms_pitch_deg", "rms_yaw_deg")):
        columns[what] = rms[:, k]
    columns["valid_percent"] = np.array([one.measured.valid_percent for one in variants])
    rows = (
        ExperimentRow(
            what=f"{one.name}: rms error of range (%), pitch, yaw (degrees); frames with a posture",
            ours=f"{numbers_text(one.measured.rms)}; {one.measured.valid_percent:.0f} %",
        )
        for one in variants
    )
    return ExperimentResult(
        sentence=sentence,
        findings=(*rows, *more_findings),
        pictures=(variants_picture(name, caption, variants),),
        series=(DataColumns(name=name, columns=columns),),
        notes=notes,
    )


def _bars(axes: Axes, variants: Sequence[Variant], values: FloatArray, name: str) -> None:
    colours = [OURS if one.ours else GREY for one in variants]
    shown = np.where(np.isfinite(values), values, 0.0)
    axes.barh(range(len(values)), shown, height=0.6, color=colours)
    for k, value in enumerate(values):
        words = f" {value:.2g}" if value < 1.0 else f" {value:.3g}"
        if np.isfinite(value):
            axes.text(value, k, words, va="center", fontsize=7.0)
        else:
            aside = axes.get_yaxis_transform()
            axes.text(0.5, k, "none", va="center", fontsize=7.0, transform=aside)
    axes.set_xlabel(name)
    axes.grid(visible=False, axis="y")


# Numbers of pictures for the calibration.
_SIZE = SetSize(camera=12, dome=10, box=4, index=1, dive=0)
_CALIBRATED_RIG, _DRAFT, _RIG_READY = "rig.yaml", "draft.yaml", "pictures.json"


def calibration_pictures(laboratory: Laboratory) -> CalibrationFiles:
    """Return rendered pictures for a calibration of the laboratory's rig; render them once.

    All are in air: 12 of a board for the camera, 10 of a board at known distances for the dome, and
    4 of the box for the lasers.
    """
    folder = laboratory.folder("calibration")
    if not (folder / _RIG_READY).exists():
        files = simulate_calibration(
            laboratory.rig, folder, size=_SIZE, progress=laboratory.rendered
        )
        stored = {
            name: str(value.relative_to(folder)) if isinstance(value, Path) else value
            for name, value in asdict(files).items()
        }
        (folder / _RIG_READY).write_text(json.dumps(stored), encoding="utf-8")
    known: dict[str, Any] = json.loads((folder / _RIG_READY).read_text(encoding="utf-8"))
    paths = {key: folder / one for key, one in known.items() if isinstance(one, str)}
    return CalibrationFiles(**known | paths)


def calibrated_rig(laboratory: Laboratory) -> Rig:
    """Return the laboratory's rig as calibrated from these pictures, in the tank's water.

    It has its covariance, and the working range of `aqualvs calibrate`.
    """
    folder = laboratory.folder("calibration")
    if not (folder / _CALIBRATED_RIG).exists():
        _calibrate(
            calibration_pictures(laboratory), folder / _CALIBRATED_RIG, len(laboratory.rig.lasers)
        )
    return load_rig(folder / _CALIBRATED_RIG).in_water(laboratory.rig.n_water)


def rig_without_lasers(laboratory: Laboratory) -> Rig:
    """Return the rig before the calibration of the lasers: camera and dome, with covariance."""
    calibrated_rig(laboratory)
    draft = laboratory.folder("calibration") / _DRAFT
    return load_rig(draft, need_lasers=False).in_water(laboratory.rig.n_water)


def _calibrate(files: CalibrationFiles, rig: Path, n_lasers: int) -> None:
    """Calibrate camera, dome and lasers by the commands, and write `rig`."""
    # The last step writes `rig`, which exists only if all steps have succeeded.
    draft = rig.with_name(_DRAFT)
    camera = CameraRequest(
        images=(str(files.camera),), board=files.board, out=draft, nominal=files.nominal
    )
    run_camera(camera, _discard)
    dome = DomeRequest(
        images=(str(files.dome),), board=files.rail_board, rig=draft, out=draft, poses=files.poses
    )
    run_dome(dome, _discard)
    lasers = LasersRequest(
        images=(str(files.box),), rig=draft, out=rig, box=files.box_file, n_lasers=n_lasers
    )
    run_lasers(lasers, _discard)


def _discard(_line: str) -> None:
    """Discard a line for the user; the experiment reports its own result."""
