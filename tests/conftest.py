"""Shared fixtures."""

import os
from pathlib import Path

import pytest

# As the command line does it, and before any test imports NumPy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


@pytest.fixture(scope="session")
def samples() -> Path:
    """Folder of the independently rendered samples; skips where they are absent."""
    default = Path(__file__).resolve().parents[2] / "shared" / "samples"
    folder = Path(os.environ.get("AQUALVS_SAMPLES", default))
    if not folder.is_dir():
        pytest.skip(f"no independent samples at {folder} (set AQUALVS_SAMPLES)")
    return folder
