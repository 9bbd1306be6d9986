"""From simulated pictures to a rig file, through the real command line."""

import contextlib
import io
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

import aqualvs
from aqualvs.calibration.water_index.state import IndexPrior
from aqualvs.cli.main import main
from aqualvs.experiments.simulate import calibration_commands
from aqualvs.geometry.transforms import SE3, rotvec_from_rotation
from aqualvs.optics.flat_port import FlatPort
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL
from aqualvs.optics.rigfile import load_rig, save_rig
from aqualvs.optics.solved import rig_uncertainty
from aqualvs.results.summary import compare_with_truth
from aqualvs.simulation.calibration_set import SetSize, simulate_calibration
from dome_cases import leave_bare_lenses_out
from panel_cases import small_rig
from whole import WHOLE

N_BOARDS = 6
SIZE = SetSize(camera=N_BOARDS, dome=N_BOARDS, box=2, index=1, dive=0)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """A simulated set, what every command said, and where the rig is."""
    out = tmp_path_factory.mktemp("calibration")
    files = simulate_calibration(small_rig(), out, size=SIZE)
    commands = calibration_commands(files, out, small_rig())
    # The camera's, dome's and lasers' steps; one picture does not tell the water's index.
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        codes = [main(command) for command in commands[:3]]
    (out / "said.txt").write_text(said.getvalue(), encoding="utf-8")
    return out, files, commands, codes


def test_every_step_succeeds_and_writes_its_page(calibrated):
    out, _, _, codes = calibrated
    assert codes == [0, 0, 0]
    for step in ("camera", "dome", "lasers"):
        page = (out / f"rig.{step}.html").read_text(encoding="utf-8")
        assert page.lstrip().lower().startswith("<!doctype html")
        assert "</html>" in page
        # One file that opens anywhere: nothing is fetched.
        assert not re.search(r"""(src|href)=["']?https?://(?!doi\.org)""", page)


def test_every_step_says_what_it_used(calibrated):
    """Pictures, corners and the residual: of the camera, then of the dome."""
    out, _, _, _ = calibrated
    said = (out / "said.txt").read_text(encoding="utf-8")
    words = rf"^{N_BOARDS} pictures, (\d+) corners, residual (0\.\d+) px \(rms\)$"
    told = re.findall(words, said, re.M)
    assert len(told) == 2
    for n_corners, rms_px in told:
        assert int(n_corners) > 100
        assert 0.0 < float(rms_px) < 0.3


def test_the_camera_is_the_true_one(calibrated):
    out, files, _, _ = calibrated
    rig, truth = load_rig(out / "rig.yaml"), load_rig(files.rig)
    # 360 pixels and six pictures: 0.2 px of 408 is three of the sigmas that the solve states.
    assert rig.lens.fx == pytest.approx(truth.lens.fx, rel=1e-3)
    assert rig.lens.fy == pytest.approx(truth.lens.fy, rel=1e-3)


def test_the_lens_is_where_it_is_in_the_dome(calibrated):
    out, files, _, _ = calibrated
    rig, truth = load_rig(out / "rig.yaml"), load_rig(files.rig)
    apart = rig.dome_from_cam.translation - truth.dome_from_cam.translation
    # Distances only, to a tenth of a millimetre each; the page states 0.2 mm.
    assert np.linalg.norm(apart) < 1e-3
    turn = rig.dome_from_cam.rotation @ truth.dome_from_cam.rotation.T
    # Found from the boards that are square to the rail, and those only to 0.1 degrees.
    assert np.rad2deg(np.linalg.norm(rotvec_from_rotation(turn))) < 0.3


def test_the_planes_of_the_lasers_are_the_true_ones(calibrated):
    """Seen from the camera: what its rotation is off turns all planes with it, and no range."""
    out, files, _, _ = calibrated
    assert_true_planes(load_rig(out / "rig.yaml"), load_rig(files.rig))


def assert_true_planes(rig, truth, offset_mm=0.5):
    assert len(rig.lasers) == 3
    for true in truth.lasers:
        expected = true.plane.normal @ truth.dome_from_cam.rotation
        found = [laser.plane.normal @ rig.dome_from_cam.rotation for laser in rig.lasers]
        alike = [abs(float(normal @ expected)) for normal in found]
        i = int(np.argmax(alike))
        assert np.rad2deg(np.arccos(min(alike[i], 1.0))) < 0.1
        offset = abs(rig.lasers[i].plane.offset)
        assert offset == pytest.approx(abs(true.plane.offset), abs=1e-3 * offset_mm)


def test_the_rig_is_sane_and_has_not_moved_from_the_truth(calibrated, capsys):
    out, _, commands, _ = calibrated
    assert main(["check", str(out / "rig.yaml")]) == 0
    assert "This rig is sane" in capsys.readouterr().out
    compare = next(command for command in commands if command[0] == "check")
    assert main(compare) == 0
    assert "lens_x_mm" in capsys.readouterr().out


# Channels as OpenCV has them (blue, green, red) of which two change places.
_SWAPPED = {650.0: [0, 2, 1], 450.0: [1, 0, 2]}


@pytest.fixture(scope="module", params=_SWAPPED)
def in_colour(request, calibrated, tmp_path_factory):
    """The box with its green lasers turned red or blue, calibrated without word of lasers."""
    out, files, commands, _ = calibrated
    folder = tmp_path_factory.mktemp("colour")
    for path in sorted(files.box.glob("*.png")):
        swapped = cv2.imread(str(path))[..., _SWAPPED[request.param]]
        cv2.imwrite(str(folder / path.name), np.ascontiguousarray(swapped))
    command = [str(folder) if part == str(files.box) else part for part in commands[2]]
    before = replace(load_rig(out / "rig.yaml"), lasers=(), solved_from={})
    save_rig(before, folder / "before.yaml")
    place = command.index(str(out / "rig.yaml"))
    command[place] = str(folder / "before.yaml")
    command[command.index(str(out / "rig.yaml"))] = str(folder / "rig.yaml")
    return folder, command, request.param


def test_red_and_blue_lasers_are_calibrated_and_keep_their_wavelength(in_colour, calibrated):
    folder, command, wavelength = in_colour
    assert main([*command, f"--wavelength-nm={wavelength:g}", "--names=a,b,c"]) == 0
    found = load_rig(folder / "rig.yaml")
    assert [laser.name for laser in found.lasers] == ["a", "b", "c"]
    assert [laser.wavelength_nm for laser in found.lasers] == [wavelength] * 3
    # Red and blue are half made of chroma of half the size; the worst laser's sigma is 0.5 mm.
    assert_true_planes(found, load_rig(calibrated[1].rig), offset_mm=1.0)
    assert main(["check", str(folder / "rig.yaml"), "--against", str(folder / "rig.yaml")]) == 0
    if WHOLE or wavelength == 650.0:
        # A second time the rig knows, and the wavelength stays.
        command[command.index(str(folder / "before.yaml"))] = str(folder / "rig.yaml")
        assert main(command) == 0
        again = [laser.wavelength_nm for laser in load_rig(folder / "rig.yaml").lasers]
        assert again == [wavelength] * 3


def test_lasers_of_which_nothing_is_said_stay_so(calibrated):
    assert [laser.wavelength_nm for laser in load_rig(calibrated[0] / "rig.yaml").lasers] == [
        None
    ] * 3


def test_a_damaged_set_changes_the_result(calibrated, tmp_path):
    """Squares said to be larger than their markers allow are noticed: refused, or another lens."""
    out, files, _, _ = calibrated
    text = files.board.read_text().replace("square_mm: 24.0", "square_mm: 30.0")
    (tmp_path / "board.yaml").write_text(text)
    wrong = tmp_path / "rig.yaml"
    arguments = [str(files.camera), "--board", str(tmp_path / "board.yaml"), "-o", str(wrong)]
    code = main(["calibrate", "camera", *arguments])
    assert code == 2 or load_rig(wrong, need_lasers=False).lens != load_rig(out / "rig.yaml").lens


def test_the_functions_find_what_the_commands_find(calibrated):
    """The same rig, from pixels in memory, with residuals and reasons by picture."""
    out, files, _, _ = calibrated
    rig = load_rig(out / "rig.yaml")
    paths = sorted(files.camera.glob("view_*"))
    pictures = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths]
    blank = np.full_like(pictures[0], 128)
    camera = aqualvs.calibrate_camera([*pictures, blank], files.board, nominal=files.nominal)
    with pytest.MonkeyPatch.context() as patch:
        # The command compares, and finds the same rig.
        leave_bare_lenses_out(patch)
        dome = aqualvs.calibrate_dome(
            sorted(files.dome.glob("view_*")), files.rail_board, camera.rig, poses=files.poses
        )
    lasers = aqualvs.calibrate_lasers(
        sorted(files.box.glob("view_*")), dome.rig, box=files.box_file, n_lasers=3, medium="air"
    )
    # A rig file rounds, and the commands hand files on.
    assert lasers.rig.lens.fx == pytest.approx(
        rig.lens.fx, abs=0.1 * camera.uncertainty.sigmas["fx"]
    )
    for found, figures, written in zip(
        lasers.rig.lasers, lasers.solution.lasers, rig.lasers, strict=True
    ):
        off = np.linalg.norm(found.plane.normal - written.plane.normal)
        assert off < 0.1 * figures.sigma_normal
        assert found.plane.offset == pytest.approx(
            written.plane.offset, abs=0.1 * figures.sigma_offset
        )
    assert list(camera.left_out) == [f"picture {N_BOARDS}"]
    assert camera.left_out[f"picture {N_BOARDS}"]
    assert list(camera.residuals_px) == [f"picture {i}" for i in range(N_BOARDS)]
    assert 0.0 < camera.rms_px < 0.3
    for one in (camera, dome, lasers):
        n = len(one.uncertainty.names)
        assert one.uncertainty.covariance.shape == (n, n)
        assert np.linalg.eigvalsh(one.uncertainty.covariance).min() > -1e-12
    assert {"fx", "cx"} < set(camera.uncertainty.names)
    assert "lens_x" in dome.uncertainty.names


def test_the_function_of_the_water_says_what_it_needs(calibrated):
    out, files, _, _ = calibrated
    pictures = sorted(files.index.rglob("*.png"))
    with pytest.raises(aqualvs.AqualvsError, match="the index is known to") as refused:
        aqualvs.calibrate_water(pictures, files.target, load_rig(out / "rig.yaml"))
    assert str(refused.value).endswith("or give --temperature-c and --salinity")
    prior = IndexPrior.seawater(15.0, 35.0, n_air=1.0003)
    done = aqualvs.calibrate_water(pictures, files.target, out / "rig.yaml", prior=prior)
    assert "n_water" in done.uncertainty.names
    assert done.rms_px < 1.0
    assert len(done.residuals_px) == len(pictures)


def test_the_whole_way_behind_a_flat_port_ends_at_the_true_range(tmp_path, monkeypatch):
    # The range tells what the comparison would.
    leave_bare_lenses_out(monkeypatch)
    pose, port = SE3(DOME_FROM_CAM_NOMINAL, np.zeros(3)), FlatPort(0.012, 0.005, 1.49, 0.01, -0.01)
    truth = replace(small_rig(), housing=port, dome_from_cam=pose)
    size = SetSize(camera=6, dome=6, box=2, index=1, dive=2)
    files = simulate_calibration(truth, tmp_path, size=size)
    for command in calibration_commands(files, tmp_path, truth)[:3]:
        assert main(command) == 0
    rig = load_rig(tmp_path / "rig.yaml")
    sigmas = rig_uncertainty(rig).sigmas
    off = abs(rig.flat_port.distance - port.distance)
    assert off < 3.0 * sigmas["port_distance"] < 4e-3
    dive = [str(files.dive), "--rig", str(tmp_path / "rig.yaml"), "-o", str(tmp_path / "run")]
    assert main(["run", *dive, "--no-report"]) == 0
    found = compare_with_truth(tmp_path / "run" / "posture.csv", files.dive_truth)
    # Without the port the range would be 0.8 % off.
    assert found.n_compared == 2
    assert found.range_percent.max < 0.2
    assert max(found.pitch_deg.max, found.yaw_deg.max) < 0.4
