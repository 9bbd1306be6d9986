"""The one reader of YAML: plain values, limits, and one line for whatever is wrong."""

import os
import re
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from aqualvs.batch.dives import read_list
from aqualvs.calibrate.common import load_nominal
from aqualvs.calibration.targets.target_files import load_board, load_box, load_target
from aqualvs.control.gains_file import load_gains
from aqualvs.control.plan import load_plan
from aqualvs.design.file import load_design
from aqualvs.errors import AqualvsError, RigError
from aqualvs.experiments.benchmark_set import SET_FILE, load_set
from aqualvs.nets.target_file import target_dict
from aqualvs.optics.rigfile import load_rig
from aqualvs.report.run_data import read_run_file
from aqualvs.results.run_request import read_run_yaml
from aqualvs.simulation.scenario import read_scenario
from aqualvs.yamlfile import MAX_BYTES, MAX_DEPTH, MAX_VALUES, parse_yaml, read_text, read_yaml
from repository import ROOT

SOURCES = ROOT / "src" / "aqualvs"
BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 9)
)
# Each level has one list more around the one before it, with no bracket within a bracket.
LADDER = "a0: &a0 [x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}]\n" for i in range(1, 900))
BROKEN = {
    "two keys": "a: 1\na: 2\n",
    "two keys, spelt otherwise": "a: 1\n'a': 2\n",
    "unclosed": "a: [1, 2\nb: 1\n",
    "brackets": "[" * 2000,
    "braces": "{a: " * 2000,
    "dashes": "- " * 2000,
    "many brackets": "[" * 1_000_000,
    "digits": "a: " + "9" * 5000,
    "digits with a sign": "a: -" + "9" * 5000,
    "tag of a float": "a: !!float abc",
    "tag of a date": "a: !!timestamp 2026-13-45",
    "tag of a set": "!!set {a, b}",
    "tag of Python": "a: !!python/object/apply:os.getcwd []",
    "own tag": "a: !mine 3",
    "alias bomb": BOMB,
    "alias ladder": LADDER,
    "list in itself": "a: &a [*a]",
    "no anchor": "a: *b",
    "list as a key": "? [1, 2]\n: 3\n",
    "two documents": "a: 1\n---\na: 2\n",
    "control character": "a: 1\nb: \x00\n",
    "tabs": "a:\n\t- 1\n",
    "escape": 'a: "\\UFFFFFFFF"',
    "merge of a number": "<<: 1",
    "version": "%YAML 9.9\n---\na: 1\n",
}
UNUSUAL = {
    "impossible date": "date: 2026-13-45",
    "empty": "",
    "a word": "word",
    "a list": "[1, 2]",
    "a number": "3",
    "no hexadecimal number": "a: 0x_",
    "numbers as keys": "1: 2\n3.5: 4\nnull: 5\ntrue: 6\n",
    "infinity": "a: 1.0e+999",
    "long key": f"{'k' * 900}: 1",
}
READERS: dict[str, Callable[[Path], object]] = {
    "rig": load_rig,
    "nominal": load_nominal,
    "gains": load_gains,
    "plan": load_plan,
    "design": load_design,
    "board": load_board,
    "box": load_box,
    "target": load_target,
    "net": lambda path: target_dict(str(path)),
    "scenario": read_scenario,
    "list of dives": read_list,
}


def parse(text: str) -> object:
    return parse_yaml(text, "file.yaml", RigError)


def refusal(text: str) -> str:
    with pytest.raises(RigError) as caught:
        parse(text)
    message = str(caught.value)
    assert message.startswith("file.yaml: ")
    assert message.isprintable()
    assert len(message) < 200
    return message


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1", 1),
        ("-1_000", -1000),
        ("0", 0),
        ("1.5", 1.5),
        ("-2.5e-03", -2.5e-3),
        (".5", 0.5),
        (".inf", float("inf")),
        ("-.INF", float("-inf")),
        ("yes", True),
        ("Off", False),
        ("~", None),
        ("", None),
        ("'1'", "1"),
        ('"yes"', "yes"),
        ("!!str 1", "1"),
        ("! 1", "1"),
        ("!!float 3", 3.0),
        ("!!int '3'", 3),
        ("2026-05-01", "2026-05-01"),
        ("2026-05-01T10:00:00Z", "2026-05-01T10:00:00Z"),
        ("010", "010"),
        ("0x1F", "0x1F"),
        ("12:30:45", "12:30:45"),
        ("1e3", "1e3"),
        ("=", "="),
        ("<<", "<<"),
        ("|\n  two\n  lines\n", "two\nlines\n"),
    ],
)
def test_values_are_plain(text: str, value: object) -> None:
    content = parse(f"key: {text}")
    assert content == {"key": value}
    assert type(content["key"]) is type(value)


def test_what_pyyaml_writes_is_read_as_it_was() -> None:
    words = "yes 1e3 010 0x1F 12:30:45 2026-05-01 .5 -.5 1_0 ~ << = null 0b1 a:b 1.0 é"
    shared = [1, 2.5]
    content = {
        "words": words.split(),
        "numbers": [1e-9, 1e30, -3, 0.1, 2**62],
        "a": shared,
        "b": shared,
    }
    for text in (yaml.safe_dump(content), yaml.safe_dump(content, allow_unicode=True)):
        assert parse(text) == content
    assert parse(yaml.safe_dump(content, explicit_start=True, explicit_end=True)) == content


def test_anchors_and_merged_keys() -> None:
    text = "base: &b {x: 1, y: 2}\nmore: &m {z: 4}\nc: {y: 3, <<: *b}\nd: {<<: [*b, *m]}\ne: *m\n"
    content = parse(text)
    assert content["c"] == {"y": 3, "x": 1}
    assert content["d"] == {"x": 1, "y": 2, "z": 4}
    assert content["e"] == {"z": 4}


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_no_plain_yaml_is_refused_in_one_line(name: str) -> None:
    assert "; " in refusal(BROKEN[name])


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("two keys", "key 'a' appears twice in line 2; keep one of them"),
        ("unclosed", "in line 2; fix that line"),
        ("brackets", f"nested deeper than {MAX_DEPTH} levels in line 1"),
        ("alias ladder", f"nested deeper than {MAX_DEPTH} levels in line {MAX_DEPTH}"),
        ("alias bomb", f"more than {MAX_VALUES:,} values in line"),
        ("digits", "whole number of 5000 digits in line 1; shorten it"),
        ("tag of a float", "'abc' is not a float in line 1"),
        ("tag of Python", "in line 1; leave the tag out"),
        ("control character", "control character U+0000 in line 2"),
        ("two documents", "a second document begins in line"),
    ],
)
def test_faults_name_the_line_and_the_remedy(name: str, words: str) -> None:
    assert words in refusal(BROKEN[name])


def test_limits_leave_room_for_large_files() -> None:
    dives = [{"dive": f"north/{i:04d}.mp4", "rig": "rig.yaml", "salinity": 34} for i in range(4000)]
    assert parse(yaml.dump(dives, Dumper=yaml.CSafeDumper)) == dives
    nested: object = "x"
    for _ in range(MAX_DEPTH):
        nested = [nested]
    assert parse(yaml.safe_dump(nested)) == nested
    refusal(yaml.safe_dump([nested]))


@pytest.mark.parametrize("name", [*BROKEN, *UNUSUAL])
@pytest.mark.parametrize("kind", READERS)
def test_every_reader_refuses_in_one_line(kind: str, name: str, tmp_path: Path) -> None:
    path = tmp_path / "given.yaml"
    path.write_text((BROKEN | UNUSUAL)[name], encoding="utf-8")
    with pytest.raises(AqualvsError) as caught:
        READERS[kind](path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    assert len(message) < 1500


@pytest.mark.parametrize("name", [*BROKEN, *UNUSUAL])
def test_a_run_file_and_a_benchmark_set_are_refused(name: str, tmp_path: Path) -> None:
    text = (BROKEN | UNUSUAL)[name]
    (tmp_path / "run.yaml").write_text(text, encoding="utf-8")
    (tmp_path / SET_FILE).write_text(text, encoding="utf-8")
    with pytest.raises(AqualvsError, match="benchmark"):
        load_set(tmp_path)
    if name in BROKEN or name in ("empty", "a word", "a list", "a number"):
        with pytest.raises(AqualvsError, match=r"run\.yaml"):
            read_run_yaml(tmp_path)
        content, trouble = read_run_file(tmp_path)
        assert content == {}
        assert "run.yaml" in trouble


def test_files_that_are_no_text(tmp_path: Path) -> None:
    def said(path: Path) -> str:
        with pytest.raises(RigError) as caught:
            read_yaml(path, "a rig file", RigError)
        assert "give the path of a rig file" in str(caught.value) or "UTF-8" in str(caught.value)
        return str(caught.value)

    assert "no such file" in said(tmp_path / "none.yaml")
    assert "is a folder" in said(tmp_path)
    fifo, loop, utf16, large = (tmp_path / name for name in ("fifo", "loop", "utf16", "large"))
    os.mkfifo(fifo)
    assert "is a pipe" in said(fifo)
    assert "is a device" in said(Path("/dev/zero"))
    loop.symlink_to(loop)
    assert "cannot be read" in said(loop)
    utf16.write_text("a: 1", encoding="utf-16")
    assert "is not text in UTF-8; save it as UTF-8" in said(utf16)
    with large.open("wb") as file:
        file.truncate(MAX_BYTES + 1)
    assert "is larger than 8 MB" in said(large)
    assert "is not a path" in said(Path("a\0b"))
    assert "cannot be read" in said(tmp_path / ("n" * 300))
    assert "\n" not in said(tmp_path / "a\0\nb")


def test_a_byte_order_mark_is_no_part_of_the_text(tmp_path: Path) -> None:
    path = tmp_path / "file.yaml"
    path.write_text("a: 1", encoding="utf-8-sig")
    assert read_yaml(path, "a file", RigError) == {"a": 1}
    assert read_text(path, "a file", RigError) == "a: 1"


def test_nothing_else_reads_yaml() -> None:
    writing = {"dump", "safe_dump", "SafeDumper", "SequenceNode"}
    guilty = []
    for path in SOURCES.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        # What carries comments over looks for their places only.
        if path.name not in ("yamlfile.py", "yamlcomments.py") and "yaml" in text:
            used = set(re.findall(r"\byaml\.(\w+)", re.sub(r'\w+\.yaml|"[^"\n]*"', "", text)))
            guilty += [(path, name) for name in used - writing]
            assert not re.search(r"from yaml import|import yaml as", text), path
    assert guilty == []
