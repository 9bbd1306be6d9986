"""The water tank of the experiments: dives with truth, rendered once, and measured at will."""

import hashlib
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from aqualvs.app.truth import read_truth
from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.live.sources import open_source
from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import rig_to_mapping, save_rig
from aqualvs.scanning.pipeline import Scanner, ScannerOptions
from aqualvs.scanning.posture import Posture
from aqualvs.scanning.scan import Frame, Scan
from aqualvs.simulation.dive import simulate_dive
from aqualvs.simulation.example_rigs import example_rig
from aqualvs.simulation.scenario import Scenario
from aqualvs.simulation.video import Recording

_VIDEO, _TRUTH, _RIG, _READY = "dive.mp4", "truth.csv", "rig.yaml", "ready.json"


@dataclass(frozen=True, slots=True)
class Dive:
    """A rendered dive on disk.

    Attributes
    ----------
    name : str
    folder : Path
        Holds `dive.mp4`, `truth.csv` and `rig.yaml`, and `points_FFFF.npz` of the frames asked for.
    rig : Rig
        The true one.
    scenario : Scenario
    """

    name: str
    folder: Path
    rig: Rig
    scenario: Scenario

    @property
    def video(self) -> Path:
        """The video."""
        return self.folder / _VIDEO

    @property
    def truth(self) -> Path:
        """The truth, as `read_truth` takes it."""
        return self.folder / _TRUTH


@dataclass(frozen=True, slots=True)
class Measured:
    """A dive as one scanner saw it, frame by frame, N of them, beside the truth.

    Attributes
    ----------
    scans : list of Scan
    truth : float array, shape (N, 3)
        Range in m, pitch and yaw in radians; NaN where there is none.
    """

    scans: list[Scan]
    truth: FloatArray

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
        """Whether each frame has a posture, shape (N,)."""
        return np.array([posture is not None for posture in self.postures], np.bool_)

    @property
    def values(self) -> FloatArray:
        """Range (m), pitch and yaw (rad) of each frame, NaN where refused; shape (N, 3)."""
        nothing = (np.nan,) * 3
        return np.array(
            [nothing if p is None else (p.range, p.pitch, p.yaw) for p in self.postures]
        ).reshape(-1, 3)

    @property
    def sigmas(self) -> FloatArray:
        """One standard deviation of `values`, shape (N, 3)."""
        variances = [
            np.full(3, np.nan) if p is None else np.diag(p.covariance) for p in self.postures
        ]
        return np.asarray(np.sqrt(np.array(variances).reshape(-1, 3)))

    @property
    def errors(self) -> FloatArray:
        """`values` less `truth`, shape (N, 3)."""
        return self.values - self.truth

    @property
    def range_percent(self) -> FloatArray:
        """Error of the range in percent of the true range, shape (N,)."""
        return np.asarray(100.0 * self.errors[:, 0] / self.truth[:, 0])

    @property
    def errors_told(self) -> FloatArray:
        """Errors for people, shape (N, 3): range in percent, pitch and yaw in degrees."""
        return np.column_stack([self.range_percent, np.degrees(self.errors[:, 1:])])


class Laboratory:
    """Renders dives and measures in them; the same call twice costs once.

    Parameters
    ----------
    work : Path
        Folder for the dives; kept, so that another run finds them.
    tick : callable, optional
        Called with the number of frames rendered since the last call.

    Attributes
    ----------
    frame_s : list of float
        How long the scanner took for each frame that it measured with its own options, in seconds.
    """

    def __init__(self, work: Path, tick: Callable[[int], None] | None = None) -> None:
        self._work = work
        self._tick = tick or (lambda _n: None)
        self._measured: dict[tuple[str, str], Measured] = {}
        self.frame_s: list[float] = []

    @cached_property
    def rig(self) -> Rig:
        """The rig of the experiments, after the paper's Table 1."""
        return example_rig()

    def rendered(self, _done: int, _all: int) -> None:
        """Count a rendered picture; what renderers take as `progress`."""
        self._tick(1)

    def folder(self, name: str) -> Path:
        """Return a folder for the files of an experiment, made if it is not there."""
        folder = self._work / name
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def dive(
        self,
        scenario: Scenario,
        rig: Rig | None = None,
        *,
        recording: Recording | None = None,
        point_frames: tuple[int, ...] = (),
    ) -> Dive:
        """Return a dive with its truth, rendered where it has not been yet.

        Parameters
        ----------
        scenario : Scenario
            Its name, with a digest of everything that shapes the pictures, names the folder.
        rig : Rig, optional
            `self.rig` by default.
        recording, point_frames
            As in `simulate_dive`.
        """
        rig = rig or self.rig
        facts = {
            "scenario": repr(scenario),
            "rig": rig_to_mapping(rig),
            "video": [repr(recording or Recording()), list(point_frames)],
        }
        digest = _digest(facts)
        folder = self._work / "dives" / f"{scenario.name}-{digest}"
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
        return Dive(folder.name, folder, rig, scenario)

    def measure(
        self,
        dive: Dive,
        options: ScannerOptions | None = None,
        *,
        rig: Rig | None = None,
        no_dome: bool = False,
    ) -> Measured:
        """Measure every frame of a dive.

        Parameters
        ----------
        dive : Dive
        options : ScannerOptions, optional
        rig : Rig, optional
            What the scanner believes; the true rig by default.
        no_dome : bool
            Leave refraction out, as `aqualvs run --no-dome` does.
        """
        believed = rig or dive.rig
        options = options or ScannerOptions()
        key = (dive.name, _digest([repr(options), rig_to_mapping(believed), no_dome]))
        if key not in self._measured:
            camera = believed.bare_camera() if no_dome else None
            own = options == ScannerOptions() and camera is None
            scanner = Scanner(believed, options, camera)
            self._measured[key] = _measured(dive, scanner, self.frame_s if own else [])
        return self._measured[key]


def frames_of(dive: Dive) -> list[Frame]:
    """Return the decoded frames of a dive."""
    with open_source(str(dive.video)) as source:
        return list(source)


def _measured(dive: Dive, scanner: Scanner, frame_s: list[float]) -> Measured:
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
    return Measured(scans, rows)


def _digest(facts: Mapping[str, Any] | list[Any]) -> str:
    text = json.dumps(facts, sort_keys=True, default=repr)
    return hashlib.sha256(text.encode()).hexdigest()[:12]
