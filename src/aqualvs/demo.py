"""The command `aqualvs demo`: the bundled dive, measured and compared with its truth."""

import importlib.resources
from importlib.resources.abc import Traversable
from pathlib import Path

from aqualvs.errors import SourceError
from aqualvs.pipeline import run_and_print
from aqualvs.results.run_request import RunRequest
from aqualvs.terminal import Echo


def demo(out: Path, echo: Echo, *, overwrite: bool = False) -> int:
    """Run the bundled dive, print posture and error, and return the exit code.

    Raises `AqualvsError` if the installation lacks the dive, or `out` cannot be written.
    """
    with importlib.resources.as_file(bundled_dive()) as folder:
        dive, rig, truth = (folder / name for name in ("dive.mp4", "rig.yaml", "truth.csv"))
        for path in (dive, rig, truth):
            if not path.is_file():
                raise SourceError(f"{path}: missing from this installation; install aqualvs again")
        request = RunRequest(source=str(dive), rig=rig, truth=truth, out=out, overwrite=overwrite)
        return run_and_print(request, echo)


def bundled_dive() -> Traversable:
    """Return the folder with the dive that comes with the package."""
    return importlib.resources.files("aqualvs") / "data" / "demo"
