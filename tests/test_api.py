"""`import aqualvs` is the library: light to import, and its names are what they say."""

import importlib
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

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


@pytest.mark.parametrize(
    ("image", "said"),
    [
        (np.zeros((576, 720, 3)), "float64 of shape (576, 720, 3)"),
        (np.zeros((576, 720, 3), np.uint16), "uint16 of shape"),
        (np.zeros((3, 576, 720), np.uint8), "uint8 of shape (3, 576, 720)"),
        (np.zeros((576, 720, 1), np.uint8), "(576, 720, 1)"),
        (np.zeros((0, 0, 3), np.uint8), "(0, 0, 3)"),
        ([[0]], "list"),
    ],
)
def test_an_array_that_is_no_image_is_refused(image, said) -> None:
    with pytest.raises(aqualvs.AqualvsError) as fault:
        aqualvs.planes_of_image(image)
    assert said in str(fault.value)
    assert "expected uint8" in str(fault.value)


@pytest.mark.parametrize("image", [np.zeros((576, 720, 3), np.uint8), None])
def test_what_is_no_frame_is_refused_by_the_scanner(image) -> None:
    scanner = aqualvs.Scanner(aqualvs.load_rig(files("aqualvs") / "data" / "demo" / "rig.yaml"))
    with pytest.raises(aqualvs.AqualvsError, match="make one of an image"):
        scanner.process(image)
    with pytest.raises(aqualvs.AqualvsError, match="planes_of_image"):
        scanner.process(aqualvs.Frame(0, 0.0, np.zeros((576, 720, 3), np.uint8)))


@pytest.mark.parametrize("words", [{"detector": "threshold"}, {"mesh_filter": "paper"}])
def test_a_word_in_place_of_options_is_refused(words) -> None:
    with pytest.raises(aqualvs.AqualvsError, match="give its options"):
        aqualvs.ScannerOptions(**words)


def test_words_of_the_scanners_options_are_checked() -> None:
    options = aqualvs.ScannerOptions(target="net", fit="pseudo_inverse")
    assert options.target.value == "net"
    assert options.fit.value == "pseudo_inverse"
    with pytest.raises(aqualvs.AqualvsError, match="target is 'nets'; give one of auto, net, sol"):
        aqualvs.ScannerOptions(target="nets")
    with pytest.raises(aqualvs.AqualvsError, match="fit is 'robst'; give one of robust, pseudo"):
        aqualvs.ScannerOptions(fit="robst")


def test_a_request_takes_paths_as_text(tmp_path) -> None:
    demo = files("aqualvs") / "data" / "demo"
    window = importlib.import_module("aqualvs.results.run_request").FrameWindow(0, 2)
    request = aqualvs.RunRequest(
        source=demo / "dive.mp4",
        rig=str(demo / "rig.yaml"),
        out=str(tmp_path / "run"),
        frames=window,
        report=False,
    )
    assert aqualvs.run(request).summary.n_frames == 2
    assert (tmp_path / "run" / "posture.csv").is_file()


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"water": 1.34}, "water is 1.34; give a Water of aqualvs.results.run_request"),
        ({"frames": slice(0, 9)}, "frames is slice"),
        ({"scanner": "ridge"}, "give a ScannerOptions of aqualvs.scanner"),
        ({"n_processes": 0}, "n_processes is 0; use 1 or more"),
        ({"n_processes": 1.5}, "n_processes is 1.5"),
    ],
)
def test_options_of_another_type_are_refused_in_one_line(wrong, words) -> None:
    with pytest.raises(aqualvs.AqualvsError, match=words) as refused:
        aqualvs.RunRequest(source="dive.mp4", rig="rig.yaml", out="out", **wrong)
    assert "\n" not in str(refused.value)


def test_a_window_of_frames_begins_at_the_first() -> None:
    window = importlib.import_module("aqualvs.results.run_request").FrameWindow
    with pytest.raises(aqualvs.AqualvsError, match="first is -3; frames count from 0"):
        window(-3, 2)


def test_a_frame_that_does_not_fit_is_a_fault_of_input() -> None:
    scanner = aqualvs.Scanner(aqualvs.load_rig(files("aqualvs") / "data" / "demo" / "rig.yaml"))
    for luma in (np.zeros((10, 20), np.uint8), np.zeros((10, 20), np.float32)):
        frame = aqualvs.Frame(index=0, time_s=0.0, luma=luma)
        for kind in (aqualvs.AqualvsError, ValueError):
            with pytest.raises(kind, match=r"^frame 0 "):
                scanner.process(frame)


def test_a_picture_that_opencv_could_not_read_is_named() -> None:
    board = Path(__file__).parent / "data" / "real-wall" / "board.yaml"
    with pytest.raises(aqualvs.AqualvsError, match="picture 1: None; cv2"):
        aqualvs.calibrate_camera([np.zeros((576, 720), np.uint8), None], board)


CHROMA = (np.full((288, 360), 100, np.uint8), np.full((288, 360), 90, np.uint8))


@pytest.mark.parametrize(
    "chroma",
    [
        np.stack(CHROMA),
        CHROMA[0],
        (None, None),
        (CHROMA[0],),
        (CHROMA[0][::2, ::2], CHROMA[1][::2, ::2]),
        (CHROMA[0].repeat(2, 0), CHROMA[1].repeat(2, 0)),
        (CHROMA[0][..., None], CHROMA[1][..., None]),
        (CHROMA[0].astype(np.float32), CHROMA[1]),
    ],
)
def test_chroma_that_does_not_fit_is_refused(chroma) -> None:
    scanner = aqualvs.Scanner(aqualvs.load_rig(files("aqualvs") / "data" / "demo" / "rig.yaml"))
    luma = np.zeros((576, 720), np.uint8)
    with pytest.raises(aqualvs.AqualvsError, match=r"frame 3 has chroma .* shape \(288, 360\)"):
        scanner.process(aqualvs.Frame(3, 0.0, luma, chroma))


@pytest.mark.parametrize("luma", [None, [[0]]])
def test_luma_that_is_no_array_is_refused(luma) -> None:
    scanner = aqualvs.Scanner(aqualvs.load_rig(files("aqualvs") / "data" / "demo" / "rig.yaml"))
    with pytest.raises(aqualvs.AqualvsError, match=r"^frame 0 holds .*planes_of_image"):
        scanner.process(aqualvs.Frame(0, 0.0, luma))


def test_an_unknown_model_of_a_lens_is_refused() -> None:
    board = Path(__file__).parent / "data" / "real-wall" / "board.yaml"
    with pytest.raises(aqualvs.AqualvsError, match="model is 'fish'; give one of opencv, fisheye"):
        aqualvs.calibrate_camera([np.zeros((576, 720), np.uint8)], board, model="fish")
