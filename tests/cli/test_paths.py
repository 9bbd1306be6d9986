"""Paths that are empty, not there, or one too many."""

import pytest

EMPTY = "is empty; give a value, or set the variable of the shell that should hold it"


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (["run", "", "--rig", "rig.yaml"], "SOURCE"),
        (["run", "dive.mp4", "--rig", "rig.yaml", "-o", ""], "--out"),
        (["run", "dive.mp4", "--rig", "rig.yaml", "--out="], "--out"),
        (["net", ""], "SOURCE"),
        (["report", ""], "FOLDER"),
        (["check", ""], "RIG"),
        (["batch", "dive.mp4", "", "-o", "out"], "DIVES"),
        (["live", "", "--rig", "rig.yaml"], "SOURCE"),
        (["calibrate", "camera", "", "--board", "b.yaml", "-o", "rig.yaml"], "IMAGES"),
        (["simulate", "wall", "-o", ""], "--out"),
    ],
)
def test_an_empty_path_is_not_the_folder_one_is_in(arguments, name, refused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert refused(*arguments) == f"{name} '': {EMPTY}"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", ["run", "net"])
def test_a_mistyped_path_is_missing_before_its_rig(command, refused, tmp_path):
    path = tmp_path / "NOPE"
    assert refused(command, path) == f"{path}: no such file or folder; check the path"


def test_several_recordings_are_for_a_batch(refused):
    said = refused("run", "a.mcap", "b.mcap", "c.mcap")
    assert "(b.mcap c.mcap): it measures one dive; use aqualvs batch for several; see" in said
