"""`aqualvs reproduce` from the command line."""

import pytest

from aqualvs.cli.main import main
from aqualvs.experiments import experiment


def test_unknown_experiment_is_one_line_and_exit_code_2(tmp_path, refused):
    said = refused("reproduce", "nets", "-o", tmp_path / "out")
    assert said.startswith("nets: no such experiment; choose from rig,")


def test_folder_that_is_a_file_is_exit_code_2(tmp_path, refused):
    (tmp_path / "out").write_text("")
    assert "choose another folder" in refused("reproduce", "rig", "-o", tmp_path / "out")


def test_list_names_every_experiment(capsys):
    assert main(["reproduce", "--list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(experiment.MODULES)


@pytest.mark.parametrize("name", ["rig"])
def test_experiment_is_run_and_its_page_written(tmp_path, capsys, name):
    out = tmp_path / "out"
    assert main(["reproduce", name, "-o", str(out)]) == 0
    said = capsys.readouterr().out
    assert said.startswith(f"[1/1] {name}: ")
    assert f"page: {out / 'reproduce.html'}" in said
    assert (out / "results.json").is_file()
    assert (out / "reproduce.html").stat().st_size > 20_000
