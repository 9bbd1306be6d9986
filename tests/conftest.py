"""Shared fixtures."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def samples() -> Path:
    """Folder of the independently rendered samples; skips where they are absent."""
    default = Path(__file__).resolve().parents[2] / "shared" / "samples"
    folder = Path(os.environ.get("AQUALVS_SAMPLES", default))
    if not folder.is_dir():
        pytest.skip(f"no independent samples at {folder} (set AQUALVS_SAMPLES)")
    return folder
