"""`aqualvs benchmark` and `aqualvs score`: a set for strangers, and their answers in plain CSV."""

import csv
import json
import shutil

import pytest
import yaml

from aqualvs.cli.main import main
from aqualvs.experiments.benchmark_score import BARE_LENS, OWN_SYSTEMS
from aqualvs.simulation.benchmark import LEVELS


@pytest.fixture(scope="module")
def small_set(tmp_path_factory):
    """Two dives of two frames each."""
    folder = tmp_path_factory.mktemp("bench") / "set"
    arguments = ["clear_wall", "empty_open", "--frames", "2", "-o", str(folder)]
    assert main(["benchmark", *arguments]) == 0
    return folder


def test_the_list_names_every_level(capsys):
    assert main(["benchmark", "--list"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(LEVELS)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["benchmark"], "--out"),
        (["benchmark", "murky", "-o", "x"], "murky"),
        (["benchmark", "--frames", "1", "-o", "x"], "--frames 1"),
        (["score", "--truth", "x"], "RESULTS"),
        (["score", "mine=x", "--truth", "x"], "benchmark.yaml"),
    ],
)
def test_bad_input_gives_one_line(arguments, words, refused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert words in refused(*arguments)
    assert list(tmp_path.iterdir()) == []


def test_a_set_holds_all_that_a_stranger_needs(small_set, refused):
    names = {path.name for path in (small_set / "clear_wall").iterdir()}
    assert names == {"dive.mp4", "rig.yaml", "target.yaml", "truth.csv"}
    assert "frame,range_m,pitch_deg,yaw_deg" in (small_set / "README.md").read_text("utf-8")
    facts = yaml.safe_load((small_set / "benchmark.yaml").read_text("utf-8"))
    assert facts["whole"] is False
    assert list(facts["dives"]) == ["clear_wall", "empty_open"]
    with (small_set / "clear_wall" / "truth.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    # Three stripes across a picture of 720 x 576.
    assert all(1500 < int(row["n_visible"]) <= 3 * 720 for row in rows)
    assert "--overwrite" in refused("benchmark", "clear_wall", "-o", small_set)


def test_the_truth_itself_scores_perfectly_and_is_set_beside_another(small_set, tmp_path, capsys):
    exact, poor = tmp_path / "exact", tmp_path / "poor.csv"
    (exact / "clear_wall").mkdir(parents=True)
    shutil.copyfile(small_set / "clear_wall" / "truth.csv", exact / "clear_wall" / "posture.csv")
    poor.write_text(
        "dive,frame,range_m,pitch_deg,yaw_deg\nclear_wall,0,0.9,0,0\nempty_open,1,0.5,0,0\n"
    )
    out = tmp_path / "scores"
    systems = [f"exact={exact}", str(poor)]
    assert main(["score", *systems, "--truth", str(small_set), "-o", str(out)]) == 0
    said = capsys.readouterr().out
    assert "a PART of the set" in said
    assert "exact: no file for empty_open" in said
    with (out / "scores.csv").open(encoding="utf-8") as file:
        rows = {(row["system"], row["name"]): row for row in csv.DictReader(file)}
    best, worst = rows["exact", "clear"], rows["poor", "total"]
    assert float(best["available_percent"]) == 100.0
    assert float(best["range_percent_max"]) == 0.0
    assert best["n_false"] == "0"
    assert best["z_range"] == ""
    assert float(worst["available_percent"]) == 50.0
    assert (worst["n_wrong"], worst["n_false"]) == ("1", "1")
    content = json.loads((out / "scores.json").read_text("utf-8"))
    assert content["set"].startswith("aqualvs-bench-1 (checksum ")
    assert len(content["scores"]) == len(rows)
    assert "| total | poor | 2/4 | 50.0 |" in (out / "scores.md").read_text("utf-8")


def test_scores_of_others_stay(small_set, tmp_path, refused):
    (tmp_path / "scores.md").write_text("precious")
    command = ["score", "--truth", str(small_set), "-o", str(tmp_path), "--overwrite", "a=x"]
    assert "scores.md: exists, and 'aqualvs score' did not" in refused(*command)
    assert (tmp_path / "scores.md").read_text() == "precious"


def test_two_systems_need_two_names(small_set, tmp_path, refused):
    shutil.copyfile(small_set / "clear_wall" / "truth.csv", tmp_path / "clear_wall.csv")
    one = f"a={tmp_path}"
    assert "two systems of this name" in refused("score", one, one, "--truth", small_set)


def test_aqualvs_and_its_baselines_are_scored_by_one_command(small_set, tmp_path, capsys):
    own, out = tmp_path / "own", tmp_path / "scores"
    arguments = ["--truth", str(small_set), "--own", str(own), "-o", str(out), "--dives"]
    assert main(["score", *arguments]) == 0
    assert "clear_wall  aqualvs" in capsys.readouterr().out
    with (out / "scores.csv").open(encoding="utf-8") as file:
        rows = {(row["system"], row["name"]): row for row in csv.DictReader(file)}
    assert {system for system, _ in rows} == {BARE_LENS, *(system.name for system in OWN_SYSTEMS)}
    mine, bare = rows["aqualvs", "clear_wall"], rows[BARE_LENS, "clear_wall"]
    assert mine["available_percent"] == "100.0"
    # What is promised of clear scenes is 0.5 %; a lens taken for bare is off by nine times that.
    assert float(mine["range_percent_max"]) < 0.5
    assert float(bare["range_percent_median"]) > 4.5
    assert rows["aqualvs", "empty_open"]["n_false"] == "0"
