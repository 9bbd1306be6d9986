"""The notebook among the examples runs, and keeps no output in the repository."""

import json
import os
import subprocess
import sys

import pytest

from repository import ROOT
from whole import WHOLE

NOTEBOOK = ROOT / "examples" / "tour.ipynb"
CELLS = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
# Rendering the pictures of a calibration, and looking for the board in them, is most of the time.
MANY, FEW = "camera=8", "camera=8" if WHOLE else "camera=4"
CODE = ["".join(cell["source"]) for cell in CELLS if cell["cell_type"] == "code"]


def run(cells, folder):
    """Run cells as one program, without a window; most of the time is the kernels' compilation."""
    program = folder / "notebook.py"
    program.write_text("\n".join(cells), encoding="utf-8")
    environment = {**os.environ, "MPLBACKEND": "Agg"}
    return subprocess.run(
        [sys.executable, str(program)],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
    )


def test_every_cell_runs(tmp_path):
    assert MANY in "".join(CODE)
    done = run([cell.replace(MANY, FEW) for cell in CODE], tmp_path)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    n_frames, n_postures = [int(word) for word in lines[1].split() if word.isdigit()]
    assert n_postures > 0.9 * n_frames > 0
    residual_px = float(next(line for line in lines if line.startswith("residual")).split()[1])
    assert 0.0 < residual_px < 0.3


def test_a_cell_that_fails_is_noticed(tmp_path):
    assert run(["import aqualvs", "aqualvs.load_rigg('rig.yaml')"], tmp_path).returncode != 0


@pytest.mark.parametrize("cell", CELLS, ids=lambda cell: cell["id"])
def test_cells_keep_no_output(cell):
    assert not cell.get("outputs")
    assert cell.get("execution_count") is None


def test_only_the_interface_is_used():
    assert "from aqualvs." not in "\n".join(CODE)
