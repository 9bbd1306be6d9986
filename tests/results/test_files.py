"""What commands replace: their own files, when asked; rigs never without a dated copy."""

import json
import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import typer.main

from aqualvs.check.comparison import last_calibration
from aqualvs.cli.main import app, main
from aqualvs.design.report import ERRORS_PNG, PICTURE_PNG
from aqualvs.design.settings import Design
from aqualvs.errors import OutputError, RigError
from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import dated_copies, keep_dated, load_rig, save_rig
from aqualvs.optics.solved import SolvedStep, with_step
from aqualvs.results.files import RECORD, Claim
from aqualvs.results.folder import RUN_FILES, prepare_folder
from aqualvs.simulation.scenarios import example_rig
from repository import ROOT

TESTS = ROOT / "tests"
PRECIOUS = "somebody's own\n"

QUICK: dict[str, tuple[list[str], list[str]]] = {
    "design": (["-o", "."], ["rig.yaml", "errors.png", "picture.png", "design.html"]),
    "board": (["charuco", "-o", "rig"], ["rig.yaml", "rig.pdf"]),
    "tune": (["bluerov2", "-o", "rig.yaml"], ["rig.yaml"]),
    "simulate": (["wall", "-o", "."], ["rig.yaml", "dive.mp4", "truth.csv"]),
    "follow": (["--sim", "--seconds", "2", "-o", "."], ["truth.csv", "follow.html"]),
    "benchmark": (["clear", "--frames", "2", "-o", "."], ["benchmark.yaml", "README.md"]),
    "batch": (["DIVE", "--rig", "r.yaml", "-o", "."], ["summary.html", "dataset", "dives"]),
    "reproduce": (["distance", "-o", "."], ["reproduce.html", "results.json", "figures"]),
    "calibrate camera": (["DIVE", "--board", "b.yaml", "-o", "rig.yaml"], ["rig.yaml"]),
    "calibrate dome": (
        ["DIVE", "--board", "b.yaml", "--rig", "r.yaml", "-o", "rig.yaml"],
        ["rig.yaml"],
    ),
    "calibrate lasers": (
        ["DIVE", "--box", "b.yaml", "--rig", "r.yaml", "-o", "rig.yaml"],
        ["rig.yaml"],
    ),
    "calibrate shutter": (["DIVE", "--rig", "r.yaml", "-o", "rig.yaml"], ["rig.yaml"]),
    "calibrate water": (
        ["DIVE", "--target", "t.yaml", "--rig", "r.yaml", "-o", "rig.yaml"],
        ["rig.yaml"],
    ),
}
"""Commands that look at their outputs first: arguments, and files that are somebody else's."""

ELSEWHERE = {
    "run": "results/test_files.py::test_a_run_leaves_the_files_of_others_alone",
    "demo": "results/test_files.py::test_a_run_leaves_the_files_of_others_alone",
    "report": "results/test_folder.py::test_a_report_of_others_stays",
    "net": "cli/test_net.py::test_files_of_others_in_the_nets_place_stay",
    "net-change": "cli/test_net_change.py::test_faults_in_one_line_and_files_of_others_stay",
    "figures": "report/test_mesh_figures.py::test_pictures_of_others_stay",
    "score": "cli/test_score.py::test_scores_of_others_stay",
    "import": "cli/test_formats.py::test_files_of_others_are_never_overwritten",
    "export": "cli/test_formats.py::test_files_of_others_are_never_overwritten",
    "live": "recording/test_recorder.py::test_a_name_that_is_taken_or_impossible_is_refused",
}
"""Commands that must read something before: the test with what they need."""

NO_FILES = {"check", "doctor", "schema"}


def all_commands() -> dict[str, Any]:
    """Return every command of the command line by its words."""
    found: dict[str, Any] = {}
    group: Any = typer.main.get_command(app)
    for name, command in group.commands.items():
        inner = getattr(command, "commands", None)
        found |= (
            {name: command}
            if inner is None
            else {f"{name} {one}": below for one, below in inner.items()}
        )
    return found


def test_every_command_that_writes_is_covered_here() -> None:
    """A new command must be listed, with the test that shows what it leaves alone."""
    assert set(all_commands()) == {*QUICK, *ELSEWHERE, *NO_FILES}
    for place in ELSEWHERE.values():
        file, _, name = place.partition("::")
        assert f"def {name}(" in (TESTS / file).read_text(encoding="utf-8"), place


def test_every_option_that_names_a_file_to_write_belongs_to_a_command_that_is_covered() -> None:
    """An option whose words say that it writes makes its command one that is covered."""
    for name, command in all_commands().items():
        for option in command.params:
            says = (getattr(option, "help", None) or "").lower()
            writes = option.name in ("out", "output", "own") or "to write" in says
            if writes or re.search(r"\brecord\b", says):
                assert name not in NO_FILES, (name, option.name)
        if (
            name in QUICK
            and not name.startswith("calibrate")
            and name not in ("batch", "reproduce")
        ):
            assert "overwrite" in {option.name for option in command.params}, name


@pytest.mark.parametrize("name", QUICK)
@pytest.mark.parametrize("force", [False, True])
def test_files_of_others_are_never_replaced(
    name: str,
    force: bool,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments, outputs = QUICK[name]
    has_option = "overwrite" in {one.name for one in all_commands()[name].params}
    if force and not has_option:
        pytest.skip("has no --overwrite")
    (tmp_path / "input.mp4").write_text("x")
    save_rig(example_rig(), tmp_path / "r.yaml")
    words = ["input.mp4" if word == "DIVE" else word for word in arguments]
    for output in outputs:
        path = tmp_path / output
        path.write_text(PRECIOUS)
        assert main([*name.split(), *words, *(["--overwrite"] if force else [])]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert f"{output}: exists" in said
        assert "--overwrite" not in said
        assert path.read_text() == PRECIOUS
        path.unlink()


def blank_figures(_design: Design, _by_camera: object, out: Path) -> list[Path]:
    """Write the files of `draw_figures` without the drawing, which is most of the time."""
    written = [out / ERRORS_PNG, out / PICTURE_PNG]
    for path in written:
        path.write_bytes(b"")
    return written


# Fans that touch at a range leave two points of a stripe in one place.
@pytest.mark.filterwarnings("ignore:invalid value encountered")
def test_a_design_never_replaces_a_calibrated_rig(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("aqualvs.design.command.draw_figures", blank_figures)
    command = ["design", "--no-tilt", "--no-changes", "-o", str(tmp_path)]
    assert main(command) == 0
    assert main(command) == 2
    assert "add --overwrite" in capsys.readouterr().err
    assert main([*command, "--baseline-mm", "160", "--overwrite"]) == 0
    # The rig of the first design is kept all the same.
    assert len(dated_copies(tmp_path / "rig.yaml")) == 1
    save_rig(with_step(example_rig(), "lasers", step(2026, 5, 1)), tmp_path / "rig.yaml")
    mine = (tmp_path / "rig.yaml").read_text()
    assert main([*command, "--overwrite"]) == 2
    assert "rig.yaml: has changed since 'aqualvs design' wrote it" in capsys.readouterr().err
    assert (tmp_path / "rig.yaml").read_text() == mine


def test_a_run_leaves_the_files_of_others_alone(tmp_path: Path) -> None:
    for name in RUN_FILES:
        folder = tmp_path / name
        folder.mkdir()
        (folder / name).write_text(PRECIOUS)
        with pytest.raises(OutputError, match="did not write it"):
            prepare_folder(folder, overwrite=True)
        assert (folder / name).read_text() == PRECIOUS


def test_a_claim_notes_what_was_written_and_gives_it_back_when_asked(tmp_path: Path) -> None:
    out = tmp_path / "new" / "scores.csv"
    with Claim("score", [out], overwrite=False):
        out.write_text("1")
    with pytest.raises(OutputError, match=r"exists; choose another place .* --overwrite"):
        Claim("score", [out], overwrite=False)
    with pytest.raises(OutputError, match="'aqualvs tune' did not write it"):
        Claim("tune", [out], overwrite=True)
    with Claim("score", [out], overwrite=True):
        out.write_text("2")
    out.write_text("3, by hand")
    with pytest.raises(OutputError, match="has changed since"):
        Claim("score", [out], overwrite=True)
    out.unlink()
    with Claim("score", [out], overwrite=False):
        pass
    assert json.loads((out.parent / RECORD).read_text()) == {}


def test_a_killed_command_may_begin_again(tmp_path: Path) -> None:
    out = tmp_path / "dive.mp4"
    Claim("simulate", [out], overwrite=False)
    out.write_text("half")
    Claim("simulate", [out], overwrite=True)


@pytest.mark.parametrize(
    "record", ["", "[", "[1]", '{"a": 3}', "[" * 100_000, '{"a": {"mark": 1}}']
)
def test_a_record_that_makes_no_sense_frees_nothing(record: str, tmp_path: Path) -> None:
    (tmp_path / RECORD).write_text(record)
    (tmp_path / "a").write_text(PRECIOUS)
    with pytest.raises(OutputError, match="did not write it"):
        Claim("run", [tmp_path / "a"], overwrite=True, known=[tmp_path / "a"])


def test_links_and_large_files(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OutputError, match="did not write it"):
        Claim("run", [tmp_path / "link"], overwrite=True)
    large = tmp_path / "large"
    with Claim("run", [large], overwrite=False):
        large.write_bytes(bytes(300_000))
    with large.open("r+b") as file:
        file.write(b"x")
    with pytest.raises(OutputError, match="has changed since"):
        Claim("run", [large], overwrite=True)


def step(*date: int, pictures: int = 9) -> SolvedStep:
    return SolvedStep(date=datetime(*date, tzinfo=UTC), pictures=pictures, points=90, rms_px=0.1)


def test_rigs_are_kept_under_dated_names(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    assert save_rig(example_rig(), path) is None
    first = path.read_bytes()
    assert save_rig(example_rig(), path) is None
    assert dated_copies(path) == []
    copy = save_rig(with_step(example_rig(), "dome", step(2026, 5, 1)), path)
    assert copy is not None
    assert re.fullmatch(r"rig\.\d{4}-\d\d-\d\dT\d{6}\.yaml", copy.name)
    assert copy.read_bytes() == first
    for day in range(2, 5):
        save_rig(with_step(example_rig(), "dome", step(2026, 5, day)), path)
    assert len(dated_copies(path)) == 4
    assert dated_copies(path)[-1] == copy


def test_copies_of_one_second_are_told_apart(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    now = datetime(2026, 11, 23, 14, 15, 3, tzinfo=UTC)
    for number in range(12):
        path.write_text(str(number))
        keep_dated(path, now)
    (tmp_path / "rig.dome.yaml").write_text("")
    (tmp_path / "rig.2026-11-23.yaml").write_text("")
    assert [int(copy.read_text()) for copy in dated_copies(path)] == list(range(12))[::-1]
    assert (tmp_path / "rig.2026-11-23T141503.yaml").read_text() == "0"


def test_a_file_that_is_no_rig_is_not_replaced_by_one(tmp_path: Path) -> None:
    for text in (PRECIOUS, "squares_x: 11\n", "a: [", ""):
        path = tmp_path / "board.yaml"
        path.write_text(text)
        with pytest.raises(OutputError, match="exists and is not a rig file"):
            save_rig(example_rig(), path)
        assert path.read_text() == text


def calibrated(path: Path, *steps: tuple[str, SolvedStep]) -> None:
    """Calibrate a rig step by step, as the commands do: the camera's begins anew."""
    rig: Rig = example_rig()
    for name, note in steps:
        rig = with_step(rig, name, note)
        save_rig(rig, path)


def test_the_last_calibration_is_the_one_before_all_four_steps(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    names = ("camera", "dome", "lasers", "water")
    calibrated(path, *((name, step(2026, 5, 1, 9 + i)) for i, name in enumerate(names)))
    (newest, *_) = dated_copies(path)
    words = rf"of an earlier calibration \(steps less than 12 hours .*--against {newest}"
    with pytest.raises(RigError, match=words):
        last_calibration(path)
    for copy in dated_copies(path):
        copy.unlink()
    with pytest.raises(RigError, match=r"no dated copy is beside it.*--against FILE"):
        last_calibration(path)
    may = load_rig(path)
    calibrated(path, *((name, step(2026, 8, 1, 9 + i)) for i, name in enumerate(names)))
    assert load_rig(last_calibration(path)).solved_from == may.solved_from
    august = load_rig(path)
    save_rig(with_step(august, "lasers", step(2026, 9, 1)), path)
    assert load_rig(last_calibration(path)).solved_from == august.solved_from


def test_a_rig_without_dates_has_no_last_calibration(tmp_path: Path) -> None:
    save_rig(example_rig(), tmp_path / "rig.yaml")
    with pytest.raises(RigError, match="notes no date"):
        last_calibration(tmp_path / "rig.yaml")


def test_check_against_last(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "rig.yaml"
    calibrated(path, ("lasers", step(2026, 5, 1)))
    calibrated(path, ("lasers", step(2026, 8, 1)))
    assert main(["check", str(path), "--against", "last"]) == 0
    assert dated_copies(path)[0].name in capsys.readouterr().out.replace("\n", "")
