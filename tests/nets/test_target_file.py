"""The target as a word or a file."""

from pathlib import Path

import pytest

from aqualvs.errors import OptionError
from aqualvs.nets.target_file import target_dict
from aqualvs.scanning.paper.mesh_filter import MeshFilterOptions
from aqualvs.scanning.target import TargetKind


@pytest.mark.parametrize("kind", list(TargetKind))
def test_words(kind: TargetKind) -> None:
    facts = target_dict(kind.value)
    assert facts.kind is kind
    assert facts.mesh_filter == MeshFilterOptions()


def test_file(tmp_path: Path) -> None:
    path = tmp_path / "net.yaml"
    path.write_text("kind: net\nmesh_filter: {rd_theta_mm: 8, r_max_mm: 40}\n")
    facts = target_dict(str(path))
    assert facts.kind is TargetKind.NET
    assert facts.mesh_filter == MeshFilterOptions(rd_theta=8e-3, r_max=40e-3)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("kind: fish", "kind is 'fish'; write 'auto', 'net' or 'solid'"),
        ("type: net", "type is not a key of a net.yaml; allowed here: kind, net, mesh_filter"),
        (
            "kind: net\nmesh_filter: {rd_mm: 3}",
            "mesh_filter.rd_mm is not a key of a net.yaml; did you mean",
        ),
        ("kind: net\nmesh_filter: {dd_mm: wide}", "mesh_filter.dd_mm is 'wide'"),
        ("kind: net\nmesh_filter: {dd_mm: -1}", "mesh_filter.dd_mm is -1; it must be greater"),
        ("- net", "holds no keys"),
        ("kind: [", "is not YAML"),
    ],
)
def test_bad_files_are_named(tmp_path: Path, content: str, words: str) -> None:
    path = tmp_path / "net.yaml"
    path.write_text(content)
    with pytest.raises(OptionError, match=str(path)) as caught:
        target_dict(str(path))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_neither_word_nor_file() -> None:
    with pytest.raises(OptionError, match="neither a file nor one of auto, net, solid"):
        target_dict("nets")
