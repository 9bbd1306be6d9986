"""The history of benchmarks: what is kept, what is compared, what is said."""

import importlib
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from benchmarks import __main__ as command
from benchmarks import history
from benchmarks.history import Entry, Machine, Row, append, before, change, read
from rich.console import Console

from aqualvs.errors import OutputError, SourceError

HERE = Machine("Linux x86_64", "a processor", 2, "CPython 3.11.7")
ROW = Row("optics", "rays", 20.0, "M/s", 0.5, 40.0)


def entry(*rows: Row, **changes: Any) -> Entry:
    made = Entry("2026-01-01T00:00:00+00:00", "0.1.0", "abc1234", HERE, 0.5, False, rows, ())
    return replace(made, **changes)


def found(**changes: Any) -> dict[str, Any]:
    row = {"name": "rays", "value": 20.0, "unit": "M/s", "reference": 0.5, "ratio": 40.0}
    return {**row, **changes}


def test_what_is_appended_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "history.json"
    first, second = entry(ROW), entry(replace(ROW, reference=None, ratio=None), failed=("mesh: x",))
    assert read(path) == []
    append(path, first)
    append(path, second)
    assert read(path) == [first, second]
    assert [one.name for one in path.parent.iterdir()] == ["history.json"]


@pytest.mark.parametrize("text", ["", "[]", '{"format": 2, "entries": []}', '{"format": 1}'])
def test_another_file_is_refused_and_stays(tmp_path: Path, text: str) -> None:
    path = tmp_path / "history.json"
    path.write_text(text)
    with pytest.raises(SourceError, match=r"history\.json: no history"):
        append(path, entry(ROW))
    assert path.read_text() == text


def test_a_file_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("a file where the folder should be")
    with pytest.raises((OutputError, SourceError), match=r"history\.json"):
        append(tmp_path / "out" / "history.json", entry(ROW))


def test_what_is_not_finite_is_kept_as_none(tmp_path: Path) -> None:
    row = history.row_of("nets", found(value=float("nan"), ratio=float("inf")))
    append(tmp_path / "history.json", entry(row))
    kept = json.loads((tmp_path / "history.json").read_text())["entries"][0]["rows"][0]
    assert (kept["value"], kept["ratio"], kept["reference"]) == (None, None, 0.5)


def test_a_row_without_its_ratio_is_refused() -> None:
    row = found()
    del row["ratio"]
    with pytest.raises(ValueError, match="a row of optics lacks ratio"):
        history.row_of("optics", row)


def test_only_the_same_machine_and_way_is_compared() -> None:
    old, new = replace(ROW, ratio=10.0), replace(ROW, ratio=20.0)
    elsewhere = entry(replace(ROW, ratio=1.0), machine=replace(HERE, cores=64))
    quick = entry(replace(ROW, ratio=2.0), quick=True)
    other = entry(replace(ROW, group="mesh"))
    then = before([entry(old), entry(new), elsewhere, quick, other], HERE, quick=False)
    assert then[ROW.key] == new
    assert ("mesh", "rays") in then


@pytest.mark.parametrize(
    ("then", "expected"),
    [
        (replace(ROW, ratio=50.0), 0.8),
        # The machine was slower, and the reference with it: nothing has changed.
        (replace(ROW, value=10.0, reference=0.25), 1.0),
        (replace(ROW, reference=None, ratio=None), None),
        (None, None),
    ],
)
def test_ratios_are_compared(then: Row | None, expected: float | None) -> None:
    assert change(ROW, then) == expected


def test_the_commit_says_whether_files_differ(tmp_path: Path) -> None:
    assert history.commit_of(tmp_path) == ""
    who = ["-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false"]
    (tmp_path / "file").write_text("1")
    for words in (["init", "-q"], ["add", "file"], [*who, "commit", "-q", "-m", "first"]):
        subprocess.run(["git", *words], cwd=tmp_path, check=True, timeout=300)
    clean = history.commit_of(tmp_path)
    assert len(clean) >= 7
    (tmp_path / "file").write_text("2")
    assert history.commit_of(tmp_path) == clean + "+"


def test_the_machine_is_described() -> None:
    here = history.machine()
    assert here.cores >= 1
    assert here.python.endswith(".".join(map(str, sys.version_info[:3])))
    assert history.machine() == here


def test_the_verdict_names_what_fell() -> None:
    rows = (ROW, replace(ROW, name="points", ratio=0.5), replace(ROW, name="new", ratio=None))
    then = {ROW.key: replace(ROW, ratio=60.0), ("optics", "points"): replace(ROW, ratio=0.5)}
    said = command.verdict(entry(*rows), then, 12.3)
    assert said == (
        "3 rows in 12 s; 1 of 2 reach their reference; "
        "2 compared with before: median x0.83, "
        "1 fell by more than 25 %, most of all optics/rays (x0.67)"
    )
    busy = command.verdict(entry(ROW, load=20.0, failed=("mesh: ValueError: no",)), {}, 1.0)
    assert "nothing to compare with on this machine yet" in busy
    assert "the machine was busy (20 processes, 2 cores)" in busy
    assert busy.endswith("FAILED: mesh")


@pytest.fixture
def benchmarks(monkeypatch: pytest.MonkeyPatch) -> dict[str, ModuleType]:
    """Stand-ins for the benchmarks, by name; those added here are what is run."""
    made: dict[str, ModuleType] = {}
    monkeypatch.setattr(command, "names", lambda words, **_: [n for n in made if words])
    monkeypatch.setattr(importlib, "import_module", lambda n: made[n.split(".")[1]])
    return made


def stand_in(run: Any) -> ModuleType:
    module = ModuleType("stand_in", "What it is about.")
    module.run = run
    return module


def test_a_run_shows_keeps_and_compares(
    benchmarks: dict[str, ModuleType], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ratios = iter([40.0, 20.0])
    benchmarks["bench_optics"] = stand_in(lambda: [found(ratio=next(ratios))])
    path = tmp_path / "history.json"
    words = ["optics", "--history", str(path)]
    assert command.main(words) == 0
    assert "nothing to compare" in capsys.readouterr().out
    assert command.main(words) == 0
    said = capsys.readouterr().out
    assert "optics: What it is about" in said
    assert "x0.5" in said
    assert "1 fell by more than 25 %, most of all optics/rays (x0.50)" in " ".join(said.split())
    assert [one.rows[0].ratio for one in read(path)] == [40.0, 20.0]
    assert read(path)[0].machine == history.machine()


def test_another_history_can_be_compared_with(
    benchmarks: dict[str, ModuleType], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    benchmarks["bench_optics"] = stand_in(lambda: [found()])
    other, own = tmp_path / "other.json", tmp_path / "own.json"
    append(other, entry(replace(ROW, ratio=10.0), machine=history.machine()))
    assert command.main(["optics", "--history", str(own), "--against", str(other)]) == 0
    assert "median x4.00" in " ".join(capsys.readouterr().out.split())
    assert (len(read(own)), len(read(other))) == (1, 1)


def test_a_broken_benchmark_hides_no_other(
    benchmarks: dict[str, ModuleType], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    benchmarks["bench_mesh"] = stand_in(lambda: [{"name": "no value"}])
    benchmarks["bench_optics"] = stand_in(lambda quick: [found(name=f"quick {quick}")])
    path = tmp_path / "history.json"
    assert command.main(["all", "--quick", "--history", str(path)]) == 1
    kept = read(path)[0]
    assert [row.name for row in kept.rows] == ["quick True"]
    assert kept.quick
    assert kept.failed == ("mesh: ValueError: a row of mesh lacks value, unit, reference, ratio",)
    assert "FAILED: mesh" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("more", [[], ["--against", "another.json"]])
def test_a_spoilt_history_is_told_before_anything_is_measured(
    benchmarks: dict[str, ModuleType],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    more: list[str],
) -> None:
    measured = []
    benchmarks["bench_optics"] = stand_in(lambda: measured.append(1) or [])
    (tmp_path / "history.json").write_text("{")
    assert command.main(["optics", "--history", str(tmp_path / "history.json"), *more]) == 2
    assert not measured
    assert "no history of benchmarks" in capsys.readouterr().out


def test_the_table_shows_what_there_is() -> None:
    console = Console(width=120)
    rows = [ROW, replace(ROW, name="alone", reference=None, ratio=None)]
    with console.capture() as shown:
        console.print(command.table(rows, {ROW.key: ROW}))
    lines = [line.split() for line in shown.get().splitlines()]
    assert lines[1] == ["rays", "20", "M/s", "0.5", "x40", "x1"]
    assert lines[2] == ["alone", "20", "M/s", "-", "-", "-"]


def test_names() -> None:
    every = command.names([])
    assert {"bench_optics", "bench_pipeline", "bench_start", "bench_batch"} <= set(every)
    assert command.names(["optic"]) == ["bench_optics"]
    assert "bench_batch" not in command.names([], quick=True)
    assert command.names(["no such"]) == []
