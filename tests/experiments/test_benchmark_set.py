"""Plain CSV of any system: what is read, and what is said when it makes no sense."""

from pathlib import Path

import numpy as np
import pytest

from aqualvs.errors import AqualvsError, SourceError
from aqualvs.experiments.benchmark_set import (
    BenchmarkSet,
    DiveTruth,
    load_set,
    read_dive,
    read_system,
)


def truth(name, n=3):
    posture = np.column_stack([np.linspace(0.4, 0.6, n), np.zeros(n), np.zeros(n)])
    return DiveTruth(name, name.split("_")[0], np.arange(n), posture, np.full(n, 100))


@pytest.fixture
def benchmark():
    dives = (truth("clear_near"), truth("sun_near"))
    return BenchmarkSet("bench", "abc", True, Path("bench"), dives)


def write(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


MINIMAL = "frame,range_m,pitch_deg,yaw_deg\n0,0.4,1,2\n2,0.6,3,4\n"


def test_the_least_is_frame_range_pitch_and_yaw(benchmark, tmp_path):
    write(tmp_path / "clear_near.csv", MINIMAL)
    system = read_system(f"mine={tmp_path}", benchmark)
    assert (system.name, system.missing) == ("mine", ("sun_near",))
    found = system.answers["clear_near"]
    assert found.valid.tolist() == [True, False, True]
    assert found.posture[2].tolist() == [0.6, 3.0, 4.0]
    assert np.isnan(found.sigma).all()
    assert not system.answers["sun_near"].valid.any()


def test_validity_sigmas_and_millimetres_are_read_in_any_order(benchmark, tmp_path):
    write(
        tmp_path / "sun_near" / "posture.csv",
        "yaw_deg, sigma_range_mm ,sigma_yaw_deg,sigma_pitch_deg,frame,valid,range_mm,pitch_deg,x\n"
        "2,1.5,0.3,0.2,1,1,500,1,hello\n"
        "9,9,9,9,2,0,999,9,\n",
    )
    found = read_system(str(tmp_path), benchmark).answers["sun_near"]
    assert found.valid.tolist() == [False, True, False]
    assert found.posture[1].tolist() == [0.5, 1.0, 2.0]
    assert found.sigma[1] == pytest.approx([0.0015, 0.2, 0.3])


def test_one_file_may_hold_all_dives(benchmark, tmp_path):
    path = write(
        tmp_path / "theirs.csv",
        "dive,frame,range_m,pitch_deg,yaw_deg\nsun_near,1,0.5,0,0\nclear_near,0,0.4,0,0\n",
    )
    system = read_system(str(path), benchmark)
    assert (system.name, system.missing) == ("theirs", ())
    assert system.answers["sun_near"].valid.tolist() == [False, True, False]
    assert system.answers["clear_near"].valid.tolist() == [True, False, False]


HEAD = "frame,range_m,pitch_deg,yaw_deg\n"
FAULTS = {
    "no column yaw_deg": "frame,range_m,pitch_deg\n0,0.4,1\n",
    "no column range_m or range_mm": "frame,distance,pitch_deg,yaw_deg\n0,0.4,1,2\n",
    "range_m is 400 in the first row, which is another unit": f"{HEAD}0,400,1,2\n",
    "holds no rows": HEAD,
    "line 3: range_m is '0,4 m'": f'{HEAD}0,0.4,1,2\n1,"0,4 m",1,2\n',
    "frame '7' is not in clear_near; its frames are 0 to 2": f"{HEAD}7,0.4,1,2\n",
    "frame '1.5' is not in": f"{HEAD}1.5,0.4,1,2\n",
    "line 3: frame 0 is there twice": f"{HEAD}0,0.4,1,2\n0,0.4,1,2\n",
    "valid is 'maybe'": "frame,range_m,pitch_deg,yaw_deg,valid\n0,0.4,1,2,maybe\n",
    "a valid row with the range -0.4": f"{HEAD}0,-0.4,1,2\n",
    "a valid row with the range nan": "frame,range_m,pitch_deg,yaw_deg,valid\n0,,1,2,1\n",
}


@pytest.mark.parametrize("words", FAULTS)
def test_a_wrong_file_gives_one_line(words, benchmark, tmp_path):
    path = write(tmp_path / "clear_near.csv", FAULTS[words])
    with pytest.raises(SourceError) as caught:
        read_system(str(tmp_path), benchmark)
    said = str(caught.value)
    assert words in said
    assert str(path) in said
    assert "\n" not in said


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("x.csv", "dive,frame,range_m,pitch_deg,yaw_deg\nsea,0,1,0,0\n", "dive 'sea' is not in"),
        ("x.csv", MINIMAL, "no column dive"),
        ("x/other.csv", MINIMAL, "name the files clear_near.csv"),
    ],
)
def test_results_that_fit_no_dive_are_refused(name, content, words, benchmark, tmp_path):
    path = write(tmp_path / name, content)
    place = path if path.parent == tmp_path else path.parent
    with pytest.raises(AqualvsError, match=words):
        read_system(str(place), benchmark)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "no such file"),
        ("[1, 2", "not YAML"),
        ("name: x\n", "not a benchmark set"),
        ("aqualvs_benchmark: 1\nname: x\n", "'checksum' is missing"),
        ("aqualvs_benchmark: 1\nname: x\nchecksum: y\nwhole: true\ndives: {}\n", "names no dive"),
    ],
)
def test_a_folder_without_a_set_is_refused(content, words, tmp_path):
    if content is not None:
        write(tmp_path / "benchmark.yaml", content)
    with pytest.raises(SourceError, match=words):
        load_set(tmp_path)


def test_a_truth_with_a_frame_twice_is_refused(tmp_path):
    row = "1,0.5,1,2,300\n"
    path = write(tmp_path / "truth.csv", "frame,range_m,pitch_deg,yaw_deg,n_visible\n" + row)
    assert len(read_dive(path, "a", "near").frames) == 1
    path.write_text(path.read_text() + row)
    with pytest.raises(SourceError, match="a frame is there twice"):
        read_dive(path, "a", "near")
