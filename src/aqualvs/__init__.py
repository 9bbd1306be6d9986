"""Underwater laser vision: posture to a net or wall from a camera behind a dome and line lasers.

The names below are the interface for programs; each is imported when it is first used, so that
`import aqualvs` itself costs nothing.
"""

import os

# As of `typing`, whose import would take longer than all that a command does before it listens to
# Ctrl-C.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from aqualvs.calibrate.camera import calibrate_camera as calibrate_camera
    from aqualvs.calibrate.common import Calibration as Calibration
    from aqualvs.calibrate.dome import calibrate_dome as calibrate_dome
    from aqualvs.calibrate.lasers import calibrate_lasers as calibrate_lasers
    from aqualvs.calibrate.water import calibrate_water as calibrate_water
    from aqualvs.errors import AqualvsError as AqualvsError
    from aqualvs.optics.rig import Rig as Rig
    from aqualvs.optics.rigfile import load_rig as load_rig
    from aqualvs.optics.rigfile import save_rig as save_rig
    from aqualvs.pipeline import RunResult as RunResult
    from aqualvs.pipeline import run as run
    from aqualvs.results.net_survey import read_run as read_run
    from aqualvs.results.run_request import RunRequest as RunRequest
    from aqualvs.scanner import Scanner as Scanner
    from aqualvs.scanner import ScannerOptions as ScannerOptions
    from aqualvs.scanning.posture import Posture as Posture
    from aqualvs.scanning.posture import Reason as Reason
    from aqualvs.scanning.posture import Refusal as Refusal
    from aqualvs.scanning.scan import Frame as Frame
    from aqualvs.scanning.scan import Label as Label
    from aqualvs.scanning.scan import Scan as Scan
    from aqualvs.scanning.scan import ScanPoints as ScanPoints
    from aqualvs.scanning.scan import planes_of_image as planes_of_image
    from aqualvs.simulation.calibration_set import CalibrationFiles as CalibrationFiles
    from aqualvs.simulation.calibration_set import SetSize as SetSize
    from aqualvs.simulation.calibration_set import simulate_calibration as simulate_calibration
    from aqualvs.sources import open_source as open_source

__version__ = "0.1.0"

_NAMES = {
    "calibrate.camera": ["calibrate_camera"],
    "calibrate.common": ["Calibration"],
    "calibrate.dome": ["calibrate_dome"],
    "calibrate.lasers": ["calibrate_lasers"],
    "calibrate.water": ["calibrate_water"],
    "errors": ["AqualvsError"],
    "optics.rig": ["Rig"],
    "optics.rigfile": ["load_rig", "save_rig"],
    "pipeline": ["RunResult", "run"],
    "results.net_survey": ["read_run"],
    "results.run_request": ["RunRequest"],
    "scanner": ["Scanner", "ScannerOptions"],
    "scanning.posture": ["Posture", "Reason", "Refusal"],
    "scanning.scan": ["Frame", "Label", "Scan", "ScanPoints", "planes_of_image"],
    "simulation.calibration_set": ["CalibrationFiles", "SetSize", "simulate_calibration"],
    "sources": ["open_source"],
}
_MODULES = {name: f"aqualvs.{module}" for module, names in _NAMES.items() for name in names}

__all__ = sorted(_MODULES)

# Pixels of a picture that OpenCV decodes, read when it is imported: a file of a few kilobytes can
# claim 60,000 x 60,000. The largest cameras have 150 million.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(160_000_000))


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    found = getattr(importlib.import_module(_MODULES[name]), name)
    # Kept, so that Python does not ask again.
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
