"""`aqualvs reproduce`: what a run writes, keeps, and says; with experiments that cost nothing."""

import json

import numpy as np
import pytest

from aqualvs.errors import OptionError, OutputError
from aqualvs.experiments import experiment as catalogue
from aqualvs.experiments import page as records
from aqualvs.experiments.command import TimeLeft, reproduce, time_left_text
from aqualvs.experiments.experiment import (
    DataColumns,
    Experiment,
    ExperimentFigure,
    ExperimentResult,
    ExperimentRow,
)
from aqualvs.experiments.page import PAGE
from aqualvs.report.figure_style import new_figure
from aqualvs.results.files import RECORD, Claim
from aqualvs.terminal import hidden_progress, progress


def chart():
    with new_figure(1.0, "column") as figure:
        figure.add_subplot().plot([1, 2], [3, 4])
    return ExperimentFigure(name="chart", caption="Two points.", figure=figure)


def experiment(name, *, met=True, fault=None, columns=None, sentence="Found 1.", drawn=False):
    def run(laboratory):
        if fault is not None:
            raise fault
        return ExperimentResult(
            sentence=sentence,
            findings=(
                ExperimentRow(what="range error, %", paper="2.3", ours="0.1", bar="0.5", met=met),
                ExperimentRow(what="frames", paper="", ours="3"),
            ),
            pictures=(chart(),) if drawn else (),
            series=(
                DataColumns(name="rows", columns=columns or {"x_mm": np.array([0.1, np.nan])}),
            ),
            notes=("Not the paper's tank.",),
        )

    return Experiment(title=f"About {name}", paper="figure 1", about="A wall.", run=run)


def run(folder, *names, **faults):
    """Return exit code and lines; `faults` maps names to what goes wrong there."""
    lines = []
    with pytest.MonkeyPatch.context() as patch:
        load = {name: experiment(name, **faults.get(name, {})) for name in names}
        patch.setattr(catalogue, "experiment", load.__getitem__)
        return reproduce(names, folder, lines.append), lines


def named(folder):
    return [one["name"] for one in results(folder)["experiments"]]


def results(folder):
    return json.loads((folder / "results.json").read_text())


def test_run_writes_all_files_and_says_each_result(tmp_path):
    code, lines = run(tmp_path, "box", "rig", box={"drawn": True})
    assert code == 0
    assert lines[0].startswith("[1/2] rig: Found 1. (")
    assert lines[1].startswith("[2/2] box: Found 1. (")
    assert lines[2].startswith("2 of 2 criteria met")
    assert named(tmp_path) == ["rig", "box"]
    for suffix in ("png", "pdf", "svg"):
        assert (tmp_path / "figures" / f"box_chart.{suffix}").stat().st_size > 500
    assert (tmp_path / "series" / "rig_rows.csv").read_text() == 'x_mm\n0.1\n""\n'
    assert set(json.loads((tmp_path / "times.json").read_text())) == {"rig", "box"}
    assert "About rig" in (tmp_path / PAGE).read_text()


def test_two_runs_write_the_same_results_and_figures(tmp_path):
    for folder in ("a", "b"):
        run(tmp_path / folder, "rig", rig={"drawn": True})
    names = ["results.json", "series/rig_rows.csv"]
    names += [f"figures/rig_chart.{suffix}" for suffix in ("png", "pdf", "svg")]
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name


def test_failure_is_one_line_and_does_not_stop_the_rest(tmp_path):
    fault = {"fault": ValueError("no stripes\nat all")}
    code, lines = run(tmp_path, "rig", "dome", "box", dome=fault)
    assert code == 1
    assert lines[1] == (
        "[2/3] dome: failed: ValueError: no stripes at all; the full traceback is in "
        "failures/dome.txt"
    )
    assert "1 of 3 experiments failed: dome" in lines
    assert "Traceback" in (tmp_path / "failures" / "dome.txt").read_text()
    assert named(tmp_path) == ["rig", "dome", "box"]
    assert "no stripes at all" in (tmp_path / PAGE).read_text()
    assert run(tmp_path, "dome")[0] == 0
    assert not (tmp_path / "failures" / "dome.txt").exists()


def test_columns_of_different_length_are_a_failure(tmp_path):
    columns = {"x": np.zeros(2), "y": np.zeros(3)}
    code, lines = run(tmp_path, "rig", rig={"columns": columns})
    assert code == 1
    assert "ValueError" in lines[0]


def test_stop_leaves_what_was_done(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, "rig", "dome", dome={"fault": KeyboardInterrupt()})
    assert named(tmp_path) == ["rig"]
    assert "About rig" in (tmp_path / PAGE).read_text()


def test_later_run_keeps_other_results_of_the_same_version_only(tmp_path, monkeypatch):
    run(tmp_path, "box", box={"sentence": "First."})
    run(tmp_path, "rig")
    assert named(tmp_path) == ["rig", "box"]
    assert "First." in (tmp_path / PAGE).read_text()
    content = results(tmp_path)
    content["sources"] = "another version"
    (tmp_path / "results.json").write_text(json.dumps(content))
    # Versions before this one kept no record of what they wrote.
    (tmp_path / RECORD).unlink()
    run(tmp_path, "rig")
    assert named(tmp_path) == ["rig"]


@pytest.mark.parametrize("content", ["", "[]", '{"sources": 3}', "\x00"])
def test_results_that_cannot_be_read_are_written_anew(tmp_path, content):
    # As a run leaves it that is killed while it writes.
    Claim("reproduce", [tmp_path / "results.json"], overwrite=True)
    (tmp_path / "results.json").write_text(content)
    assert run(tmp_path, "rig")[0] == 0
    assert named(tmp_path) == ["rig"]


def test_results_of_something_else_are_left_alone(tmp_path):
    (tmp_path / "results.json").write_text("mine")
    with pytest.raises(OutputError, match="did not write it"):
        run(tmp_path, "rig")
    assert (tmp_path / "results.json").read_text() == "mine"


def test_missed_bar_is_said_and_counted(tmp_path):
    code, lines = run(tmp_path, "rig", "dome", dome={"met": False})
    assert code == 0
    assert "MISSED: range error, %." in lines[1]
    assert lines[2].startswith("1 of 2 criteria met")


def test_unknown_name_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(OptionError, match="nets: no such experiment; choose from rig, dome"):
        run(tmp_path / "out", "rig", "nets")
    assert not (tmp_path / "out").exists()


def test_folder_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "out").write_text("")
    with pytest.raises(OutputError, match="another folder"):
        run(tmp_path / "out", "rig")


def test_rendered_dives_of_another_version_are_removed(tmp_path):
    work = records.work_folder(tmp_path)
    (work / "old").write_text("")
    assert (records.work_folder(tmp_path) / "old").exists()
    (work / "made_by.txt").write_text("another version")
    assert not (records.work_folder(tmp_path) / "old").exists()


def test_order_is_the_catalogue_s_and_all_without_a_name():
    assert catalogue.ordered(("box", "rig", "box")) == ["rig", "box"]
    assert catalogue.ordered(()) == list(catalogue.MODULES)


def test_time_left_follows_the_pace_of_this_machine():
    clock = [0.0]
    left = TimeLeft(["rig", "dome", "box"], lambda: clock[0])
    first = left.seconds
    left.start("rig")
    clock[0] = 1.0
    assert left.seconds == pytest.approx(first - 1.0)
    # Ten times slower than typical: far more is left than was guessed, however much is behind.
    clock[0] = 50.0
    share = left.share
    left.end()
    assert left.share > share
    # 20 s of trust and 50 measured, over 20 and what is typical of the one that is done.
    rig, dome, box = (catalogue.MODULES[name][1] for name in ("rig", "dome", "box"))
    assert left.seconds == pytest.approx((dome + box) * 70.0 / (20.0 + rig))
    assert left.seconds > 2.0 * first
    for name in ("dome", "box"):
        left.start(name)
        left.end()
    assert left.seconds == 0.0
    assert left.share == 1.0


def test_time_left_in_words():
    assert time_left_text(12.0) == "about 10 s left"
    assert time_left_text(200.0) == "about 3 min left"


def test_bars_of_what_runs_inside_are_hidden(monkeypatch, capsys):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    with progress("alone", 2) as tick:
        tick(2)
    assert "alone" in capsys.readouterr().err
    with hidden_progress(), progress("inside", 2) as tick:
        tick(2)
    assert "inside" not in capsys.readouterr().err
