"""`aqualvs net-change`, from the files of runs, or from two dives along a net, to its own files."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import yaml

from aqualvs.cli.main import main
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.rigfile import rig_to_mapping
from aqualvs.results.folder import RunOutputs
from aqualvs.simulation.scenarios import example_rig
from aqualvs.simulation.scene import Net, Scene
from net_app_cases import leave_maps_blank
from net_cases import passing
from net_change_cases import Cage, dive, write
from net_dives import Dive, true_solidity

SPEED, FPS, N_FRAMES, RADIUS_M = 0.08, 8.0, 94, 1.8
KEPT = ((0.12, 0.02, 0.06), (0.32, -0.02, 0.05), (0.52, 0.02, 0.055))
NEW = (0.74, 0.0, 0.06)
HEADING_DEG, DEPTH_M, DISTANCE, YAW_DEG = 80.0, 7.0, 0.5, 5.0


def rows(path):
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))


def run_of(folder, net, *, heading_off=0.0, depth_off=0.0):
    """A run along a net, and its state; the log's heading turns as along a round net."""
    folder.mkdir()
    rig = example_rig()
    scans = passing(
        net, distance=DISTANCE, speed=(SPEED, 0.0), n_frames=N_FRAMES, fps=FPS, yaw_deg=YAW_DEG
    )
    source = {"name": "dive.mp4"}
    with RunOutputs(folder, source=source, rig=rig_to_mapping(rig), options={}) as outputs:
        for scan in scans:
            outputs.write(scan)
    times = np.arange(-1.0, N_FRAMES / FPS + 1.0, 0.1)
    heading = HEADING_DEG + heading_off + np.rad2deg(SPEED / RADIUS_M) * times
    lines = [
        f"{t + 1:.1f},{DEPTH_M + depth_off:.2f},{h:.2f}\n"
        for t, h in zip(times, heading, strict=True)
    ]
    log = folder / "vehicle.csv"
    log.write_text("time_s,depth_m,heading_deg\n" + "".join(lines))
    arguments = ["--log", str(log), "--log-offset-s", "1", "--stretch-m", "0.25"]
    assert main(["net", str(folder), *arguments]) == 0
    return folder


def true_of(net):
    """Share of the area that strands and growth cover on the way."""
    scene = Scene(dome_from_scene=SE3.identity(), nets=(net,))
    way = Dive(
        scene,
        FPS,
        N_FRAMES,
        (DISTANCE,) * 2,
        (0.0,) * 2,
        (0.0,) * 2,
        (0.0,) * 2,
        np.array([SPEED, 0.0]),
    )
    return true_solidity(way)


def test_from_two_dives_to_what_changed(tmp_path, capsys, monkeypatch):
    leave_maps_blank(monkeypatch)
    clean = Net(mesh="square", bar=0.025, twine=0.0025, roll=0.3, holes=KEPT)
    fouled = replace(clean, holes=(*KEPT, NEW), fouling=0.6, growth=1.0)
    before = run_of(tmp_path / "2026-05-01", clean)
    after = run_of(tmp_path / "2026-05-22", fouled, heading_off=3.0, depth_off=0.2)
    out = tmp_path / "out"
    assert main(["net-change", str(before), str(after), "-o", str(out), "--cell-m", "0.5"]) == 0
    said = capsys.readouterr().out
    assert "2 dives on 2 dates, 2026-05-01 to 2026-05-22 (21 days)" in said
    assert "fouling has grown" in said
    holes = {row["state"]: row for row in rows(out / "holes_change.csv")}
    assert sorted(row["state"] for row in rows(out / "holes_change.csv")) == [
        "new",
        "same",
        "same",
        "same",
    ]
    # Through which compass and depth sensor a place is told is up to the first dive.
    bearing = HEADING_DEG + YAW_DEG + np.rad2deg(NEW[0] / RADIUS_M)
    sigma = float(holes["new"]["sigma_bearing_deg"])
    assert float(holes["new"]["bearing_deg"]) == pytest.approx(bearing, abs=3.0 * sigma)
    assert float(holes["new"]["diameter_after_mm"]) == pytest.approx(2e3 * NEW[2], abs=40.0)
    truth = true_of(fouled) - true_of(clean)
    for row in rows(out / "net_change.csv"):
        sigma = float(row["sigma_difference"])
        assert float(row["difference"]) == pytest.approx(truth, abs=3.0 * sigma)
        assert sigma < 0.6 * truth
    assert "the same" in (out / "net_change.html").read_text(encoding="utf-8")
    assert (out / "net_change.png").stat().st_size > 10_000


@pytest.fixture
def cage():
    rng = np.random.default_rng(4)
    places = zip(rng.uniform(5.0, 70.0, 4), rng.uniform(3.05, 3.95, 4), strict=True)
    return Cage(rng, holes=[(bearing, depth, 0.12, 0, 99) for bearing, depth in places])


def written(cage, folder, day, **options):
    return write(dive(cage, day, bearings=(0.0, 80.0), depths=(3.0, 3.4, 3.8), **options), folder)


def test_a_season_in_the_folder_of_a_batch(cage, tmp_path, capsys):
    """Runs of a batch count one by one; what has no state of its net is no part of it."""
    dives = tmp_path / "batch" / "dives"
    for day, name in ((0, "d_20260501"), (21, "d_2026-05-22_pm"), (40, "d_20260610")):
        written(cage, dives / name, day)
    (dives / "d_20260620").mkdir()
    (dives / "d_20260620" / "posture.csv").write_text("frame\n")
    assert main(["net-change", str(tmp_path / "batch"), "-o", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert "3 dives on 3 dates, 2026-05-01 to 2026-06-10 (40 days)" in said
    assert "holes the same: 4" in said
    assert "1 dive whose net has not been evaluated is left out: d_20260620" in said
    assert all(row["n_dates"] in {"2", "3"} for row in rows(tmp_path / "out" / "net_change.csv"))


def test_without_a_log_whole_dives_are_compared_and_it_says_so(cage, tmp_path, capsys):
    before = written(cage, tmp_path / "a", 0, log=False)
    after = written(cage, tmp_path / "b", 21, log=False)
    dates = ["--date", "2026-05-01", "--date", "2026-05-22"]
    out = tmp_path / "out"
    assert main(["net-change", str(before), str(after), *dates, "-o", str(out)]) == 0
    said = capsys.readouterr().out
    assert (
        "only whole dives: depth and bearing are known on fewer than two dates, of 3 stretches"
        in said
    )
    assert "--log" in said
    (row,) = rows(out / "net_change.csv")
    assert (row["cell"], row["depth_from_m"]) == ("all", "")
    assert {row["state"] for row in rows(out / "holes_change.csv")} == {"not compared"}
    assert "without positions it is unknown" in (out / "net_change.html").read_text(
        encoding="utf-8"
    )


def test_a_net_that_was_not_searched_has_no_number_of_holes(cage, tmp_path, capsys):
    """Its mesh was not found on one date: no hole of it is known, and none is denied."""
    before = dive(replace(cage, holes=[]), 0, log=False)
    blind = {**before.facts, "summary": {**before.facts["summary"], "area_m2": 0.0}}
    write(replace(before, facts=blind), tmp_path / "2026-05-01")
    written(cage, tmp_path / "2026-05-22", 21, log=False)
    runs = [str(tmp_path / name) for name in ("2026-05-01", "2026-05-22")]
    assert main(["net-change", *runs, "-o", str(tmp_path / "out")]) == 0
    assert "holes: 2026-05-01: not searched for, 2026-05-22: 4;" in capsys.readouterr().out
    page = (tmp_path / "out" / "net_change.html").read_text(encoding="utf-8")
    assert "not searched for</td>" in page


def test_the_page_names_the_folder_of_a_warning_as_it_is(cage, tmp_path, capsys, monkeypatch):
    """A slipped track: the warning begins with the folder, in whatever letters it is written."""
    one = dive(cage, 0, bearings=(0.0, 80.0))
    facts = {**one.facts, "summary": {**one.facts["summary"], "track_slip_m": 1.2}}
    write(replace(one, facts=facts), tmp_path / "cage 2026-05-01")
    write(dive(cage, 21, bearings=(0.0, 80.0)), tmp_path / "cage 2026-05-22")
    monkeypatch.chdir(tmp_path)
    assert main(["net-change", "cage 2026-05-01", "cage 2026-05-22", "-o", "out"]) == 0
    assert "warning: cage 2026-05-01: " in capsys.readouterr().out
    page = (tmp_path / "out" / "net_change.html").read_text(encoding="utf-8")
    assert "<li>cage 2026-05-01: " in page


def test_dives_without_any_solidity_are_no_fault(cage, tmp_path, capsys):
    """Too few strands in every stretch: there is no mean to draw for any date."""
    runs = []
    for day in (0, 21):
        one = dive(cage, day, bearings=(0.0, 80.0))
        unknown = np.full(len(one.stretches.solidity), np.nan)
        one = replace(one, stretches=replace(one.stretches, solidity=unknown))
        runs.append(str(write(one, tmp_path / f"2026-05-{1 + day:02d}")))
    out = tmp_path / "out"
    assert main(["net-change", *runs, "-o", str(out)]) == 0
    assert "places are not compared, only whole dives" in capsys.readouterr().out
    assert rows(out / "net_change.csv") == []
    assert (out / "net_change.png").stat().st_size > 1000


def test_the_date_is_told_by_the_user_the_names_or_the_video(cage, tmp_path, capsys):
    runs = [
        written(cage, tmp_path / name, 7 * i) for i, name in enumerate(["x", "y", "2026-07-01"])
    ]
    (runs[1] / "run.yaml").write_text(yaml.safe_dump({"source": {"path": "/gone/20260608_a.mp4"}}))
    dates = ["--date", "2026-06-01", "--date", "auto", "--date", "auto"]
    arguments = [*map(str, runs), *dates, "-o", str(tmp_path / "out")]
    assert main(["net-change", *arguments]) == 0
    said = capsys.readouterr().out
    assert f"{runs[0]}: 2026-06-01 (given with --date)" in said
    assert f"{runs[1]}: 2026-06-08 (the video's name)" in said
    assert f"{runs[2]}: 2026-07-01 (the folder's name)" in said


def test_faults_in_one_line_and_files_of_others_stay(cage, tmp_path, refused):
    a, b = (written(cage, tmp_path / name, 0) for name in ("2026-05-01", "plain"))
    out, run, empty = tmp_path / "out", tmp_path / "run", tmp_path / "batch"
    run.mkdir()
    (run / "posture.csv").write_text("frame\n")
    (empty / "dives").mkdir(parents=True)
    assert f"run: aqualvs net {run} --log" in refused("net-change", a, run, "-o", out)
    assert "in which no net has been evaluated" in refused("net-change", a, empty, "-o", out)
    assert "no run is there" in refused("net-change", a, tmp_path / "nowhere", "-o", out)
    assert "add --date" in refused("net-change", a, b, "-o", out)
    assert "once for every RUN" in refused("net-change", a, b, "--date", "2026-05-01", "-o", out)
    assert "--date May: is not a date" in refused(
        "net-change", a, b, "--date", "May", "--date", "auto", "-o", out
    )
    assert "one run cannot be compared" in refused("net-change", a, "-o", out)
    assert "is named twice" in refused("net-change", a, a, "-o", out)
    both = ["--date", "2026-05-01", "--date", "2026-05-01"]
    assert "name runs of another date too" in refused("net-change", a, b, *both, "-o", out)
    assert "--cell-m 0" in refused("net-change", a, b, "--cell-m", "0", "-o", out)
    assert not out.exists()
    other = ["--date", "2026-05-01", "--date", "2026-05-22"]
    (b / "net.geojson").write_text("{}")
    assert f"aqualvs net {b} --overwrite" in refused("net-change", a, b, *other, "-o", out)
    write(dive(cage, 1, depths=(3.0,)), tmp_path / "one")
    (b / "net.geojson").write_bytes((tmp_path / "one" / "net.geojson").read_bytes())
    assert "do not belong together" in refused("net-change", a, b, *other, "-o", out)
    content = json.loads((written(cage, b, 21) / "net.geojson").read_text())
    content["aqualvs_net"]["summary"]["n_holes"] = 9
    (b / "net.geojson").write_text(json.dumps(content))
    assert "of 9 holes" in refused("net-change", a, b, *other, "-o", out)
    out.mkdir()
    (out / "net_change.csv").write_text("precious")
    written(cage, b, 21)
    assert "did not write it" in refused("net-change", a, b, *other, "-o", out, "--overwrite")
    assert (out / "net_change.csv").read_text() == "precious"
