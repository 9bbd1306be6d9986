"""Which dives a batch is about, with which rigs, and how they are called."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aqualvs.batch.dives import find_dives, name_dives, read_list, safe_name
from aqualvs.errors import OptionError, RigError, SourceError
from aqualvs.results.run_request import Water


@pytest.fixture
def season(tmp_path):
    """Two folders with dives of the same name, and a rig in each."""
    for place in ("north", "south"):
        folder = tmp_path / place
        folder.mkdir()
        (folder / "rig.yaml").touch()
        for name in ("dive10.mp4", "dive2.mp4"):
            (folder / name).touch()
    return tmp_path


def found(*wanted, rig=None, water=None, out=Path("out")):
    return find_dives([str(one) for one in wanted], rig=rig, water=water or Water(), out=out)


def test_a_folder_is_searched_in_natural_order(season):
    dives = found(season)
    assert [dive.source.relative_to(season).as_posix() for dive in dives] == [
        "north/dive2.mp4",
        "north/dive10.mp4",
        "south/dive2.mp4",
        "south/dive10.mp4",
    ]
    assert {dive.rig for dive in dives} == {season / "north/rig.yaml", season / "south/rig.yaml"}


def test_hidden_files_and_folders_of_a_folder_are_no_dives(season):
    """As macOS leaves them on the disks of other systems."""
    (season / "north" / "._dive2.mp4").write_bytes(b"\x00\x05\x16\x07")
    trash = season / ".Trashes" / "501"
    trash.mkdir(parents=True)
    (trash / "dive3.mp4").touch()
    (trash / "rig.yaml").touch()
    names = [dive.source.name for dive in found(season)]
    assert names == ["dive2.mp4", "dive10.mp4"] * 2
    for dive in found(season):
        dive.source.unlink()
    (season / "south" / "._a.png").touch()
    (trash / "a.png").touch()
    with pytest.raises(SourceError, match="holds no dive"):
        found(season)
    (season / "south" / "a.png").touch()
    assert [dive.source.name for dive in found(season)] == ["south"]


def test_a_pattern_and_a_file_name_a_dive_once(season):
    dives = found(season / "*" / "dive2.mp4", season / "north" / "dive2.mp4")
    assert [dive.source.parent.name for dive in dives] == ["north", "south"]


def test_the_rig_of_a_dive_is_the_most_special_one(season):
    dive = season / "north" / "dive2.mp4"
    own = dive.with_name("dive2.rig.yaml")
    own.touch()
    assert found(dive)[0].rig == own
    given_rig = season / "better.yaml"
    assert found(dive, rig=given_rig)[0].rig == given_rig
    (season / "list.csv").write_text("dive,rig\nnorth/dive2.mp4,listed.yaml\n")
    assert found(season / "list.csv", rig=given_rig)[0].rig == season / "listed.yaml"


def test_a_dive_without_a_rig_is_refused_with_the_remedy(tmp_path):
    (tmp_path / "dive.mp4").touch()
    with pytest.raises(RigError, match=r"dive\.rig\.yaml or rig\.yaml beside it, or give --rig"):
        found(tmp_path / "dive.mp4")


@pytest.mark.parametrize("suffix", ["csv", "yaml"])
def test_a_list_tells_rig_name_and_water_of_each_dive(season, suffix):
    path = season / f"list.{suffix}"
    path.write_text(
        "dive,rig,name,water_n,temperature_c,salinity\n"
        "north/dive2.mp4,,april,,6.5,34\nsouth/dive2.mp4,r.yaml,,1.34,,\n"
        if suffix == "csv"
        else "dives:\n- {dive: north/dive2.mp4, name: april, temperature_c: 6.5, salinity: 34}\n"
        "- {dive: south/dive2.mp4, rig: r.yaml, water_n: 1.34}\n"
    )
    common = Water(n_water=1.33)
    first, second = found(path, water=common)
    assert (first.name, first.rig) == ("april", season / "north" / "rig.yaml")
    assert first.water == Water(temperature_c=6.5, salinity=34.0)
    assert (second.name, second.rig) == ("", season / "r.yaml")
    assert second.water == Water(n_water=1.34)


def test_a_list_tells_the_log_of_each_dive(season):
    path = season / "list.csv"
    path.write_text("dive,log,log_offset_s\nnorth/dive2.mp4,april.tlog,-3.2\nsouth/dive2.mp4,,\n")
    with pytest.raises(SourceError, match=r"april\.tlog: no such log, which the list names for"):
        found(path)
    (season / "april.tlog").touch()
    first, second = found(path)
    assert (first.log, first.log_offset_s) == (season / "april.tlog", -3.2)
    assert (second.log, second.log_offset_s) == (None, None)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("dive,camera\na.mp4,b\n", "unknown key 'camera'"),
        ("rig\nr.yaml\n", "row 1 names no dive"),
        ("dive,water_n\na.mp4,wet\n", "water_n is 'wet'"),
        ("dive,water_n\na.mp4,3\n", "row 1: water_n 3: no water"),
        ("dive,salinity\na.mp4,0.035\n", "row 1: salinity 0.035: give per mille"),
        ("dive\n", "lists no dive"),
        ("dive,log_offset_s\na.mp4,late\n", "log_offset_s is 'late'"),
    ],
)
def test_a_list_that_is_not_understood_is_refused(tmp_path, text, words):
    (tmp_path / "list.csv").write_text(text)
    with pytest.raises(OptionError, match=words):
        found(tmp_path / "list.csv")


def test_what_is_not_there_is_refused(season):
    with pytest.raises(SourceError, match="no such file or folder"):
        found(season / "west.mp4")
    with pytest.raises(SourceError, match="matches no file"):
        found(season / "*.avi")
    (season / "empty").mkdir()
    with pytest.raises(SourceError, match="holds no dive"):
        found(season / "empty")


def test_results_are_no_dives(season):
    out = season / "out"
    run_folder = season / "north" / "run"
    for folder in (out, run_folder):
        folder.mkdir()
        (folder / "overlay.mp4").touch()
    (run_folder / "run.yaml").touch()
    assert len(found(season, out=out)) == 4


def test_folders_of_images_are_dives_where_there_is_no_video(tmp_path):
    (tmp_path / "rig.yaml").touch()
    for name in ("b", "a"):
        (tmp_path / name).mkdir()
        cv2.imwrite(str(tmp_path / name / "1.png"), np.zeros((4, 4), np.uint8))
    dives = found(tmp_path)
    assert [dive.source.name for dive in dives] == ["a", "b"]
    assert {dive.rig for dive in dives} == {tmp_path / "rig.yaml"}


def test_dives_of_the_same_name_are_called_after_their_folders(season):
    sources = [(dive.source, "") for dive in found(season)]
    names = name_dives(sources, {})
    assert names == ["north_dive2", "north_dive10", "south_dive2", "south_dive10"]
    assert name_dives(sources[:1], {}) == ["dive2"]


def test_a_name_once_given_stays(season):
    sources = [(dive.source, "") for dive in found(season)]
    known = {str(sources[0][0]): "dive2"}
    assert name_dives(sources, known)[0] == "dive2"
    assert name_dives(sources, known)[2] == "south_dive2"


def test_two_dives_of_one_given_name_are_refused(season):
    sources = [(dive.source, "May") for dive in found(season)[:2]]
    with pytest.raises(OptionError, match="that of another dive"):
        name_dives(sources, {})
    with pytest.raises(OptionError, match="that of another dive"):
        name_dives(sources[:1], {"/elsewhere.mp4": "may"})


def test_names_are_no_numbers_or_dates():
    """Readers guess the type of a partition; a name must stay a text."""
    assert safe_name("2026-04-12") == "dive_2026-04-12"
    assert safe_name("0012") == "dive_0012"
    assert safe_name("../a=b/%41 ") == "a_b_41"
    assert safe_name("Ålesund øst") == "Ålesund_øst"


paths = st.lists(
    st.lists(st.text("abAB1._= ", min_size=1, max_size=3), min_size=1, max_size=4), max_size=8
)


@given(paths)
@settings(max_examples=60, deadline=None)
def test_names_are_unique_whatever_the_paths(parts):
    sources = list(dict.fromkeys(Path(f"/{'/'.join(one)}.mp4") for one in parts))
    names = name_dives([(path, "") for path in sources], {})
    assert len({name.casefold() for name in names}) == len(sources)
    assert all(name == safe_name(name) for name in names if "-" not in name)


@pytest.mark.parametrize("value", ["nan", "inf", ".inf", "x", "[1]"])
def test_a_number_of_a_list_must_be_one(tmp_path, value):
    path = tmp_path / "list.yaml"
    path.write_text(f"- {{dive: a.mp4, salinity: {value}}}\n")
    with pytest.raises(OptionError, match=r"row 1: salinity is .*; give a number"):
        read_list(path)
