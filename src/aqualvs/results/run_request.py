"""Request of `aqualvs run`, checked before anything is written, and `run.yaml`, its record.

`run.yaml` holds source, rig, options, versions, status and summary of a run.
"""

import functools
import platform
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from enum import StrEnum
from importlib import metadata
from pathlib import Path
from typing import Any

from aqualvs import __version__
from aqualvs.errors import OptionError, SourceError
from aqualvs.nets.target_file import NetRequest, target_dict
from aqualvs.optics.rig import Rig, common_wavelength
from aqualvs.optics.rigfile import load_rig
from aqualvs.optics.water import index_in_seawater, water_fault
from aqualvs.results.files import replace_text
from aqualvs.scanner import ScannerOptions
from aqualvs.scanning.detection import DETECTORS, detector_word
from aqualvs.scanning.posture_estimator import FitMethod
from aqualvs.sources import FrameSource
from aqualvs.yamlfile import read_yaml, yaml_text

_LIBRARIES = ("numpy", "numba", "opencv-python-headless", "av")


class Status(StrEnum):
    """Status of a run, as `run.yaml` states it in `status`."""

    RUNNING = "running"
    """Under way, or killed before it could say otherwise."""
    FINISHED = "finished"
    INTERRUPTED = "interrupted"
    """Stopped by the user or the system."""
    FAILED = "failed"


@dataclass(slots=True)
class RunFile:
    """Content of `run.yaml`."""

    path: Path
    # Facts that do not change during the run, ready for YAML.
    source: Mapping[str, Any]
    rig: Mapping[str, Any]
    options: Mapping[str, Any]
    # ISO 8601 with the time zone.
    started: str = field(default_factory=lambda: now())

    def write(
        self, status: Status, *, error: str = "", summary: Mapping[str, Any] | None = None
    ) -> None:
        """Write the file, whole or not at all.

        Raises `OSError` as the system says it.
        """
        content: dict[str, Any] = {"status": status.value, "started": self.started}
        if status is not Status.RUNNING:
            content["ended"] = now()
        if error:
            content["error"] = error
        if summary is not None:
            content["summary"] = dict(summary)
        content |= {"source": dict(self.source), "options": dict(self.options)}
        write_yaml(self.path, content | {"versions": versions(), "rig": dict(self.rig)})


def write_yaml(path: Path, content: Mapping[str, Any]) -> None:
    """Write a mapping as YAML in its own order; the old file stays until the new one is whole."""
    replace_text(path, yaml_text(content))


def read_run_yaml(folder: Path) -> dict[str, Any]:
    """Return the content of a run's `run.yaml`.

    Raises `SourceError` if it cannot be read, or holds no keys.
    """
    path = folder / "run.yaml"
    content = read_yaml(path, "the run.yaml of a run", SourceError)
    if not isinstance(content, dict):
        raise SourceError(f"{path}: holds no keys; run the dive again")
    return content


def versions() -> dict[str, str]:
    """Return the versions of this package, of Python and of the numerical packages."""
    found = {"aqualvs": __version__, "python": platform.python_version(), "system": sys.platform}
    return found | {name: _installed(name) for name in _LIBRARIES}


@functools.cache
def _installed(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "unknown"


def now() -> str:
    """Return the time, with its zone, to the second."""
    return datetime.now(UTC).astimezone().isoformat(timespec="seconds")


@dataclass(frozen=True, slots=True, kw_only=True)
class Water:
    """Medium as stated by the user; all None leaves the rig's own index."""

    n_water: float | None = None  # Refractive index relative to vacuum.
    # Degrees Celsius and per mille; only together.
    temperature_c: float | None = None
    salinity: float | None = None

    def __post_init__(self) -> None:
        """Refuse numbers that are none of water.

        Raises `OptionError` naming the option and its value.
        """
        if self.n_water is not None:
            checked_index(self.n_water, "--water-n")
        name, remedy = water_fault(self.temperature_c, self.salinity)
        if name:
            option = f"--{name.replace('_', '-')}"
            raise OptionError(f"{option} {getattr(self, name):g}: {remedy}")

    @property
    def seawater(self) -> tuple[float, float] | None:
        """Temperature and salinity; None without them.

        Raises `OptionError` if one is missing.
        """
        if self.temperature_c is None and self.salinity is None:
            return None
        if self.temperature_c is None or self.salinity is None:
            missing = "--salinity" if self.salinity is None else "--temperature-c"
            raise OptionError(f"{missing}: missing; the index of water needs both")
        return self.temperature_c, self.salinity

    def applied_to(self, rig: Rig) -> Rig:
        """Return the rig in this water.

        Raises `OptionError` if the values contradict each other or lie outside of what water can
        be.
        """
        if self.n_water is not None:
            if (self.temperature_c, self.salinity) != (None, None):
                raise OptionError("--water-n: give the index or temperature and salinity, not both")
            return rig.in_water(self.n_water)
        if self.seawater is None:
            return rig
        light_nm = common_wavelength(rig.lasers)
        return rig.in_water(index_in_seawater(*self.seawater, light_nm, rig.n_air))


@dataclass(frozen=True, slots=True)
class FrameWindow:
    """Frames `first` to `stop` (not included) of a source; `stop` None means to its end."""

    first: int = 0
    stop: int | None = None

    def __post_init__(self) -> None:
        """Refuse frames before the first: raises `OptionError`."""
        if self.first < 0:
            raise OptionError(f"FrameWindow: first is {self.first}; frames count from 0")

    @classmethod
    def parse(cls, text: str) -> "FrameWindow":
        """Return the window that "A:B", "A:" or ":B" means.

        Raises `OptionError` if the text is none of these, or the window is empty.
        """
        first, colon, stop = text.partition(":")
        remedy = "give A:B with frame numbers from 0, such as 100:200, 100: or :200"
        if not colon or not all(part.isdecimal() or not part for part in (first, stop)):
            raise OptionError(f"--frames {text}: not understood; {remedy}")
        window = cls(int(first or 0), int(stop) if stop else None)
        if window.stop is not None and window.stop <= window.first:
            raise OptionError(f"--frames {text}: holds no frame; {remedy}")
        return window

    def n_frames(self, n_source: int | None) -> int | None:
        """Return how many frames of a source of `n_source` lie in the window, if known."""
        ends = [end for end in (self.stop, n_source) if end is not None]
        return max(0, min(ends) - self.first) if ends else None


@dataclass(frozen=True, slots=True, kw_only=True)
class RunRequest:
    """Request for a run: its inputs, outputs and options.

    Attributes
    ----------
    source : str
        Path or address, as `open_source` takes it, or a recording.
    rig : Path or None
        None takes that of a recording; other sources need one.
    out : Path
        Folder to write.
    overwrite : bool
        Whether a run that is already there may be replaced.
    water : Water
        Of `aqualvs.results.run_request`, such as `Water(temperature_c=12.0, salinity=35.0)`.
    no_dome : bool
        Leave refraction at the dome out, for comparison.
    frames : FrameWindow
        Of `aqualvs.results.run_request`, such as `FrameWindow(100, 200)`; the whole source by
        default.
    fps : float or None
        Frame rate of image folders.
    scanner : ScannerOptions
    chosen : frozenset of str or None
        Fields of `scanner` that count for a recording, whose own options apply otherwise.
        None: all of them.
    mcap : bool
        Whether to write `dive.mcap`.
    rerun : Path or None
        File of Rerun to write, if any.
    overlay, report : bool
        Whether to write `overlay.mp4` and `report.html`.
    truth : Path or None
        Truth to compare with.
    index_target : Path or None
        Markers on the vehicle that show the water's index, tracked frame by frame.
    net : NetRequest or None
        What to find out about the net on the way, if anything.
    target : str
        As the command line has it: a file may say what the net is, which is then checked.
    n_processes : int
        Processes that measure, where the dive can be shared; what is found is the same. A program
        that asks for several must be safe to import, as `multiprocessing` wants it.
    """

    source: str
    rig: Path | None
    out: Path
    overwrite: bool = False
    water: Water = field(default_factory=Water)
    no_dome: bool = False
    frames: FrameWindow = field(default_factory=FrameWindow)
    fps: float | None = None
    scanner: ScannerOptions = field(default_factory=ScannerOptions)
    chosen: frozenset[str] | None = None
    mcap: bool = False
    rerun: Path | None = None
    overlay: bool = False
    report: bool = True
    truth: Path | None = None
    index_target: Path | None = None
    net: NetRequest | None = None
    target: str = "auto"
    n_processes: int = 1

    def __post_init__(self) -> None:
        """Take paths in any form that `Path` takes.

        Raises `OptionError` if an option is of another type than stated.
        """
        kinds = {"water": Water, "frames": FrameWindow, "scanner": ScannerOptions}
        for name, kind in kinds.items():
            if not isinstance(value := getattr(self, name), kind):
                raise OptionError(
                    f"RunRequest: {name} is {value!r}; give a {kind.__name__} of {kind.__module__}"
                )
        if not isinstance(self.n_processes, int) or self.n_processes < 1:
            raise OptionError(f"RunRequest: n_processes is {self.n_processes!r}; use 1 or more")
        object.__setattr__(self, "source", str(self.source))
        for name in ("rig", "out", "rerun", "truth", "index_target"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, Path(value))

    def to_dict(self) -> dict[str, Any]:
        """Return the options as `run.yaml` holds them."""
        rig_file = None if self.rig is None else str(self.rig)
        found: dict[str, Any] = {"rig_file": rig_file, "no_dome": self.no_dome}
        found |= asdict(self.water)
        found |= {"first_frame": self.frames.first, "stop_frame": self.frames.stop}
        found["index_target"] = None if self.index_target is None else str(self.index_target)
        if self.truth is not None:
            # Whole, as the source's path: other commands read it from elsewhere.
            found["truth"] = str(self.truth.absolute())
        return found | {"scanner": scanner_dict(self.scanner)}


def scanner_options(target: str, detector: str, mesh_filter: str, fit: str) -> ScannerOptions:
    """Return the scanner's options from the words of the command line.

    `target`: "auto", "net", "solid" or the path of a target file, see `target_file`. `detector`:
    "ridge" or "threshold". `mesh_filter`: "none" or "paper". `fit`: "robust" or "pseudo_inverse".
    """
    facts = target_dict(target)
    return ScannerOptions(
        target=facts.kind,
        detector=DETECTORS[detector](),
        mesh_filter=facts.mesh_filter if mesh_filter == "paper" else None,
        fit=FitMethod(fit),
    )


def scanner_dict(options: ScannerOptions) -> dict[str, Any]:
    """Return the scanner's options as `run.yaml` holds them."""
    found: dict[str, Any] = asdict(options)
    found["detector"] = {"kind": detector_word(options.detector), **found["detector"]}
    found["target"] = options.target.value
    found["fit"] = options.fit.value
    return found


def prepared_rig(path: Path | None, water: Water, *, no_dome: bool) -> Rig:
    """Load a rig and put it into the water it is used in.

    Raises `RigError` if the file cannot be used, or the rig has no lasers. Raises `OptionError` if
    there is no path, or the water makes no sense.
    """
    if path is None:
        raise OptionError("--rig: missing; give the rig file (only a recording brings its own)")
    return in_water(load_rig(path), water, no_dome=no_dome)


def in_water(rig: Rig, water: Water, *, no_dome: bool) -> Rig:
    """Put a rig into the water it is used in.

    Raises `OptionError` if the water makes no sense.
    """
    rig = water.applied_to(rig)
    return replace(rig, housing=None) if no_dome else rig


def check_fits(source: FrameSource, rig: Rig) -> None:
    """Raise `SourceError` if the pictures are not of the size that the rig was calibrated for."""
    if source.size_px != rig.size_px:
        have, need = ("x".join(map(str, size)) for size in (source.size_px, rig.size_px))
        raise SourceError(
            f"{source.name}: pictures of {have} px, but the rig {rig.name!r} has {need} px; "
            "use the rig of this camera in this video mode"
        )


def source_dict(source: FrameSource) -> dict[str, Any]:
    """Return data that identify a source without reading all of it."""
    found: dict[str, Any] = {"name": source.name}
    path = Path(source.name)
    if path.exists():
        found["path"] = str(path.resolve())
    if path.is_file():
        found["size_bytes"] = path.stat().st_size
    found["width_px"], found["height_px"] = source.size_px
    found["fps"] = source.fps
    found["n_frames"] = source.n_frames
    return found


def checked_index(n: float, option: str) -> float:
    """Return an index that the user gave by an option.

    Raises `OptionError` if it is that of no medium one dives in.
    """
    # Air is 1.0003, the densest brine about 1.39.
    low, high = 1.0, 1.5
    if not low <= n <= high:
        raise OptionError(f"{option} {n:g}: no water; give a value from {low} to {high}")
    return n
