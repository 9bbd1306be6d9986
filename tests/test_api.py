"""`import aqualvs` is the library: light to import, and its names are what they say."""

import importlib
import subprocess
import sys
from importlib.resources import files

import numpy as np
import pytest

import aqualvs


@pytest.mark.parametrize("name", aqualvs.__all__)
def test_a_name_is_that_of_its_module(name: str) -> None:
    found = getattr(aqualvs, name)
    assert found is getattr(importlib.import_module(found.__module__), name)
    assert name in dir(aqualvs)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'load_rigg'"):
        _ = aqualvs.load_rigg


def test_the_import_itself_reads_no_numerical_package() -> None:
    code = "import sys, aqualvs; print(*{'numpy', 'numba', 'cv2', 'scipy'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_a_run_is_read_as_it_was_measured(tmp_path) -> None:
    demo = files("aqualvs") / "data" / "demo"
    window = importlib.import_module("aqualvs.results.run_request").FrameWindow(0, 4)
    request = aqualvs.RunRequest(
        source=str(demo / "dive.mp4"),
        rig=demo / "rig.yaml",
        out=tmp_path / "run",
        frames=window,
        report=False,
    )
    result = aqualvs.run(request)
    scanner = aqualvs.Scanner(aqualvs.load_rig(demo / "rig.yaml"))
    with aqualvs.open_source(request.source) as source:
        measured = [scanner.process(frame) for frame, _ in zip(source, range(4), strict=False)]
    stored = list(aqualvs.read_run(str(request.out)))
    assert result.summary.n_frames == len(stored) == 4
    for one, other in zip(stored, measured, strict=True):
        assert isinstance(one.posture, aqualvs.Posture)
        # The table keeps micrometres.
        assert one.posture.range == pytest.approx(other.posture.range, abs=1e-6)
        np.testing.assert_allclose(one.points.pixels, other.points.pixels, rtol=1e-6)
