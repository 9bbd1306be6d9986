"""`run.yaml`: what was run, on what, with what, and how it went."""

import functools
import platform
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml

from aqualvs import __version__
from aqualvs.app.disk import replace_text
from aqualvs.errors import SourceError
from aqualvs.optics.rigtext import TidyDumper
from aqualvs.yamlfile import read_yaml

# A list stays on one line, however many digits it has.
_WIDTH = 1000
_LIBRARIES = ("numpy", "numba", "opencv-python-headless", "av")


class Status(StrEnum):
    """How a run stands; the value is what `run.yaml` says in `status`."""

    RUNNING = "running"
    """Under way, or killed before it could say otherwise."""
    FINISHED = "finished"
    INTERRUPTED = "interrupted"
    """Stopped by the user or the system."""
    FAILED = "failed"


@dataclass(slots=True)
class RunFile:
    """Content of `run.yaml`.

    Attributes
    ----------
    path : Path
    source, rig, options : mapping
        Facts that do not change during the run, ready for YAML.
    started : str
        ISO 8601 with the time zone.
    """

    path: Path
    source: Mapping[str, Any]
    rig: Mapping[str, Any]
    options: Mapping[str, Any]
    started: str = field(default_factory=lambda: now())

    def write(
        self, status: Status, *, error: str = "", summary: Mapping[str, Any] | None = None
    ) -> None:
        """Write the file, whole or not at all.

        Raises
        ------
        OSError
            As the system says it.
        """
        content: dict[str, Any] = {"status": status.value, "started": self.started}
        if status is not Status.RUNNING:
            content["ended"] = now()
        if error:
            content["error"] = error
        if summary is not None:
            content["summary"] = dict(summary)
        content["source"] = dict(self.source)
        content["options"] = dict(self.options)
        content["versions"] = versions()
        content["rig"] = dict(self.rig)
        write_yaml(self.path, content)


def write_yaml(path: Path, content: Mapping[str, Any]) -> None:
    """Write a mapping as YAML in its own order; the old file stays until the new one is whole."""
    text = yaml.dump(
        dict(content), Dumper=TidyDumper, sort_keys=False, allow_unicode=True, width=_WIDTH
    )
    replace_text(path, text)


def read_run_yaml(folder: Path) -> dict[str, Any]:
    """Return the content of a run's `run.yaml`.

    Raises
    ------
    SourceError
        If it cannot be read, or holds no keys.
    """
    path = folder / "run.yaml"
    content = read_yaml(path, "the run.yaml of a run", SourceError)
    if not isinstance(content, dict):
        raise SourceError(f"{path}: holds no keys; run the dive again")
    return content


def versions() -> dict[str, str]:
    """Return the versions of this package, of Python and of what computes the numbers."""
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
