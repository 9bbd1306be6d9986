"""Imports go one way, and the guard that says so can fail."""

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from repository import ROOT

LINT = (
    "import sys; from importlinter.cli import lint_imports; sys.exit(lint_imports(no_cache=True))"
)


def lint_imports(folder: Path) -> subprocess.CompletedProcess[str]:
    """Run the contracts of `folder`/pyproject.toml on `folder`/src."""
    path = os.pathsep.join([str(folder / "src"), os.environ.get("PYTHONPATH", "")])
    return subprocess.run(
        [sys.executable, "-c", LINT],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path, "NO_COLOR": "1", "COLUMNS": "120"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """Return a copy of the project's sources, to be spoilt."""
    source_only = shutil.ignore_patterns("__pycache__", "assets")
    shutil.copytree(ROOT / "src", tmp_path / "src", ignore=source_only)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


def test_imports_go_one_way() -> None:
    result = lint_imports(ROOT)
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("geometry/planes.py", "from aqualvs.optics import rig"),
        ("scanning/posture.py", "from aqualvs.simulation import scene"),
        ("optics/rig.py", "from aqualvs.cli import main"),
        ("geometry/planes.py", "import scipy"),
    ],
)
def test_the_guard_fails_on_a_wrong_import(copy: Path, module: str, line: str) -> None:
    file = copy / "src" / "aqualvs" / module
    file.write_text(f"{file.read_text()}\n{line}\n")
    result = lint_imports(copy)
    assert result.returncode == 1, result.stdout + result.stderr
    assert "BROKEN" in result.stdout


def test_every_package_has_its_layer() -> None:
    config = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    layers = next(c["layers"] for c in config["contracts"] if c["type"] == "layers")
    placed = {name.strip(" ()") for layer in layers for name in layer.split("|")}
    packages = {f"aqualvs.{p.parent.name}" for p in (ROOT / "src/aqualvs").glob("*/__init__.py")}
    assert packages <= placed


def test_help_needs_no_numerical_package() -> None:
    """`aqualvs --help` must answer at once."""
    heavy = ("numpy", "numba", "cv2", "scipy", "pyarrow", "plotly", "av")
    code = f"import sys, aqualvs.cli.main; print([m for m in {heavy} if m in sys.modules])"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True
    )
    assert result.stdout.strip() == "[]"
