"""A dive on disk."""

import csv
from dataclasses import replace

import av
import numpy as np
import pytest

from aqualvs.errors import OptionError, OutputError
from aqualvs.simulation.dive import simulate_dive
from aqualvs.simulation.scenario import Course, Trajectory
from aqualvs.simulation.scenarios import example_rig, load_scenario

# As in the independently rendered samples.
_COLUMNS = (
    "frame,time_s,range_mm,pitch_deg,yaw_deg,medium,n_outside,target,lasers_on,nx,ny,nz,d_mm,"
    "visible_fit_range_mm,visible_fit_pitch_deg,visible_fit_yaw_deg,visible_fit_max_resid_mm,"
    "pts_net,pts_wall,pts_fish,pts_bubble,pts_solid"
)


def _small_rig():
    """The example rig at a quarter of its resolution."""
    rig = example_rig()
    lens = replace(rig.lens, fx=204.0, fy=219.5, cx=92.0, cy=70.5)
    return replace(rig, size_px=(180, 144), lens=lens)


def _rows(path):
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def net_dive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dive") / "new" / "folder"
    scenario = replace(load_scenario("net_square"), duration=0.2)
    told = []
    files = simulate_dive(
        scenario,
        _small_rig(),
        folder,
        progress=lambda done, of: told.append((done, of)),
        point_frames=(0, 3),
    )
    return files, told, scenario


def test_video_and_truth_have_every_frame(net_dive):
    files, told, _ = net_dive
    with av.open(str(files.video)) as container:
        frames = list(container.decode(video=0))
    rows = _rows(files.truth)
    assert len(frames) == len(rows) == files.n_frames == 5
    assert (frames[0].width, frames[0].height) == (180, 144)
    assert told == [(i + 1, 5) for i in range(5)]
    assert ",".join(rows[0]) == _COLUMNS
    assert [float(row["time_s"]) for row in rows] == pytest.approx([0.0, 0.04, 0.08, 0.12, 0.16])


def test_truth_is_the_posture_that_was_asked_for(net_dive):
    files, _, scenario = net_dive
    for i, row in enumerate(_rows(files.truth)):
        path = scenario.trajectory
        assert float(row["range_mm"]) == pytest.approx(1e3 * path.distance.at(i / 25, 0.2))
        assert float(row["pitch_deg"]) == pytest.approx(np.rad2deg(path.pitch.at(i / 25, 0.2)))
        assert float(row["yaw_deg"]) == pytest.approx(np.rad2deg(path.yaw.at(i / 25, 0.2)))
        normal = np.array([float(row[key]) for key in ("nx", "ny", "nz")])
        assert np.linalg.norm(normal) == pytest.approx(1.0)
        assert float(row["d_mm"]) == float(row["range_mm"])
        assert (row["target"], row["medium"], row["lasers_on"]) == ("net", "water", "1")
        assert float(row["n_outside"]) == 1.3333
        # The plane through the lit front of the twine lies up to a (grown) radius before the axes.
        nearer = float(row["range_mm"]) - float(row["visible_fit_range_mm"])
        assert 0.2 < nearer < 3.0
        assert int(row["pts_net"]) > 20
        assert int(row["pts_wall"]) == 0


def test_points_are_those_of_the_frame(net_dive):
    files, _, scenario = net_dive
    points = sorted(files.video.parent.glob("points_*.npz"))
    assert [path.name for path in points] == ["points_0000.npz", "points_0003.npz"]
    rows = _rows(files.truth)
    camera = _small_rig().camera()
    for path, row in zip(points, (rows[0], rows[3]), strict=True):
        with np.load(path) as data:
            assert set(data) == {"xyz", "px", "laser", "label", "labels"}
            on_net = data["label"] == list(data["labels"]).index("net")
            assert on_net.sum() == int(row["pts_net"])
            pixels, _ = camera.project(data["xyz"] / 1e3)
            # Metres to millimetres and back.
            assert np.allclose(pixels, data["px"], atol=1e-9)
            normal = np.array([float(row[key]) for key in ("nx", "ny", "nz")])
            before = float(row["d_mm"]) - data["xyz"][on_net] @ normal
            grown = 1e3 * scenario.nets[0].twine / 2 * (1.45 + 2 * scenario.nets[0].growth)
            assert np.all(before < grown)
            assert np.all(before > -1.0)


def test_lasers_off_and_open_water_leave_the_right_cells_empty(tmp_path):
    off = replace(load_scenario("lasers_off"), duration=0.04)
    row = _rows(simulate_dive(off, _small_rig(), tmp_path / "off").truth)[0]
    assert (row["lasers_on"], row["range_mm"], row["pts_wall"]) == ("0", "600.0", "0")
    assert row["visible_fit_range_mm"] == ""
    empty = replace(load_scenario("empty"), duration=0.04)
    row = _rows(simulate_dive(empty, _small_rig(), tmp_path / "empty").truth)[0]
    assert (row["target"], row["range_mm"], row["nx"], row["d_mm"]) == ("none", "", "", "")


def test_the_same_scenario_gives_the_same_dive(tmp_path):
    scenario = replace(
        load_scenario("turbid"),
        duration=0.08,
        trajectory=Trajectory(distance=Course(values=(0.5,))),
    )
    one, two = (simulate_dive(scenario, _small_rig(), tmp_path / name) for name in "ab")
    assert one.truth.read_bytes() == two.truth.read_bytes()
    pictures = []
    for files in (one, two):
        with av.open(str(files.video)) as container:
            pictures.append([f.to_ndarray(format="rgb24") for f in container.decode(video=0)])
    assert np.array_equal(pictures[0], pictures[1])


def test_a_size_that_no_video_holds_leaves_no_files(tmp_path):
    rig = replace(_small_rig(), size_px=(181, 144))
    with pytest.raises(OptionError, match=r"rig example: image is 181x144 px.*write 182x144"):
        simulate_dive(load_scenario("wall"), rig, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_file_in_the_way_of_the_folder_is_named(tmp_path):
    (tmp_path / "out").write_text("in the way", encoding="utf-8")
    with pytest.raises(OutputError, match="out"):
        simulate_dive(load_scenario("wall"), _small_rig(), tmp_path / "out")
