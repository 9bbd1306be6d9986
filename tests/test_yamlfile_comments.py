"""Comments of a rig file outlive its being written anew."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from aqualvs.errors import RigError
from aqualvs.optics.rigfile import load_rig, save_rig
from aqualvs.simulation.scenarios import example_rig
from aqualvs.yamlfile import carry_comments, parse_yaml

HAND_WRITTEN = """\
# Camera no. 4, new dome since May.
aqualvs_rig: 1   # do not change
name: "four # of five"  # the yellow one

# Measured by Ana:
image: {width_px: 720, height_px: 576}
camera:
  # from the data sheet
  fx_px: 817.5  # ± 2
  fy_px: 878.0
  cx_px: 359.5
  cy_px: 287.5
  position_mm: [0, 0,   # on the axis
    0]
dome: {inner_radius_mm: 44.25, thickness_mm: 5.75, n_acrylic: 1.49}  # Delrin ring
water: {n: 1.3333}
lasers:
- name: left   # port
  normal: [1, 0, 0]
  offset_mm: -140
# starboard had a crack
- {name: right, normal: [1, 0, 0], offset_mm: 140}  # replaced
working_range_mm: [250, 1300]
solved_from:
  note: |  # said on deck
    # no comment, but text
    two
# that is all
"""
COMMENTS = [
    "# Camera no. 4, new dome since May.",
    "# do not change",
    "# the yellow one",
    "# Measured by Ana:",
    "# from the data sheet",
    "# ± 2",
    "# on the axis",
    "# Delrin ring",
    "# port",
    "# starboard had a crack",
    "# replaced",
    "# said on deck",
    "# that is all",
]


def content(text: str) -> Any:
    return parse_yaml(text, "x", RigError)


def lines_with(text: str, words: str) -> list[str]:
    return [line for line in text.splitlines() if words in line]


def test_a_rig_keeps_its_comments_where_they_were(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(HAND_WRITTEN, encoding="utf-8")
    rig = load_rig(path)
    lasers = (replace(rig.lasers[1], plane=rig.lasers[0].plane), rig.lasers[0])
    save_rig(replace(rig, n_water=1.34, lasers=lasers), path)
    text = path.read_text(encoding="utf-8")
    assert [one for one in COMMENTS if text.count(one) != 1] == []
    assert load_rig(path).n_water == 1.34
    assert load_rig(path).solved_from == rig.solved_from
    (line,) = lines_with(text, "# ± 2")
    assert line == "  fx_px: 817.5  # ± 2"
    (line,) = lines_with(text, "# port")
    assert line == "- name: left  # port"
    lines = text.splitlines()
    assert lines[lines.index("# starboard had a crack") + 1].startswith("- name: right")
    assert lines[lines.index("# Measured by Ana:") + 1].startswith("image:")
    assert lines[-1] == "# that is all"


def test_saving_again_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(HAND_WRITTEN, encoding="utf-8")
    save_rig(load_rig(path), path)
    once = path.read_bytes()
    assert save_rig(load_rig(path), path) is None
    assert path.read_bytes() == once


def test_comments_of_what_is_gone_move_to_what_held_it() -> None:
    old = "a: 1\nlasers:\n- name: x  # cracked\n  b: 2\n- name: y\nc:\n  d: 3  # deep\n"
    new = "a: 1\nlasers:\n- name: y\nc: 4\n"
    assert carry_comments(old, new) == ("a: 1\n# cracked\nlasers:\n- name: y\n# deep\nc: 4\n")
    assert carry_comments("x: 1  # gone\n", "y: 2\n") == "# gone\ny: 2\n"


def test_comments_go_from_the_rig_of_the_step_before(tmp_path: Path) -> None:
    (tmp_path / "old.yaml").write_text(HAND_WRITTEN, encoding="utf-8")
    rig = load_rig(tmp_path / "old.yaml")
    save_rig(rig, tmp_path / "new.yaml", comments_of=tmp_path / "old.yaml")
    assert "# starboard had a crack" in (tmp_path / "new.yaml").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "old",
    [
        "a: [  # not closed",
        "# only a comment",
        "- 1  # a list",
        "a: 1 # x\r\nb: 2\r\n",
        "a: '# no'",
    ],
)
def test_odd_texts(old: str) -> None:
    new = "a: 1\nb: 2\n"
    carried = carry_comments(old, new)
    assert content(carried) == content(new)
    assert ("# x" in carried) == ("# x" in old)


def test_many_comments_are_all_kept_on_top() -> None:
    old = "".join(f"# number {i}\n" for i in range(3000)) + "a: 1\n"
    carried = carry_comments(old, "a: 2\n")
    assert content(carried) == {"a": 2}
    assert carried.count("# number") == 3000


keys = st.sampled_from(["a", "b", "name", "c d", "1"])
scalars = st.one_of(
    st.integers(-9, 9), st.floats(-1, 1), st.sampled_from(["x", "y # z", "two\nlines", "", "'"])
)
trees = st.recursive(
    scalars,
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(keys, inner, max_size=3)),
    max_leaves=8,
)
mappings = st.dictionaries(keys, trees, min_size=1, max_size=4)


@settings(max_examples=60, deadline=None)
@given(mappings, mappings, st.data())
def test_no_comment_is_lost_and_no_value_changes(
    before: dict[str, Any], after: dict[str, Any], data: st.DataObject
) -> None:
    old = yaml.safe_dump(before, default_flow_style=data.draw(st.sampled_from([False, None])))
    commented = []
    for number, line in enumerate(old.splitlines()):
        own = data.draw(st.booleans())
        commented += [f"# own {number}", line] if own else [f"{line}  # behind {number}"]
    text = "\n".join(commented) + "\n"
    try:
        unchanged = repr(content(text)) == repr(content(old))
    except RigError:
        unchanged = False
    # In the midst of a text of several lines these are no comments.
    if not unchanged:
        return
    new = yaml.safe_dump(after, width=1000)
    carried = carry_comments(text, new)
    assert repr(content(carried)) == repr(content(new))
    for number in range(len(old.splitlines())):
        assert f"# own {number}" in carried or f"# behind {number}" in carried
    assert carry_comments(carried, new) == carried


def test_the_example_rig_has_room_for_comments(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    save_rig(example_rig(), path)
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("\n", "  # c\n", 1).replace("lasers:", "lasers:  # mine"))
    save_rig(replace(example_rig(), name="other"), path)
    assert "lasers:  # mine" in path.read_text(encoding="utf-8")
