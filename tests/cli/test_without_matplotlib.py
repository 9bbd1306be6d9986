"""Commands where Matplotlib, which the extra `plots` brings, is not installed."""

import importlib.util
import subprocess
import sys

import pytest

from aqualvs.nets.map import draw_map

# What is drawn is all that these have; their commands ask for Matplotlib before they are imported.
DRAWING = {"net_survey.page", "report.mesh_figures"}


@pytest.fixture
def bare(monkeypatch):
    """An installation without the extra."""
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "matplotlib" else find(name)
    )


@pytest.mark.usefixtures("bare")
@pytest.mark.parametrize(
    "arguments",
    [
        ("net-change", "one", "two", "-o", "out"),
        ("design", "-o", "out"),
        ("follow", "--sim", "-o", "out"),
        ("figures", "run"),
        ("reproduce", "--list"),
    ],
    ids=lambda arguments: arguments[0],
)
def test_commands_that_draw_name_the_extra(arguments, refused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "needs matplotlib; pip install 'aqualvs[plots]'" in refused(*arguments)
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("bare")
def test_an_earlier_map_does_not_stay(tmp_path):
    old = tmp_path / "net_map.png"
    old.write_bytes(b"of another evaluation")
    wall: object = None
    assert not draw_map(wall, [old, tmp_path / "net_map.svg"])
    assert not list(tmp_path.iterdir())


def test_the_other_modules_load_without_it():
    script = """
import importlib, pkgutil, sys
import aqualvs
sys.modules["matplotlib"] = None
for module in pkgutil.walk_packages(aqualvs.__path__, "aqualvs."):
    if not module.name.endswith("__main__"):
        try:
            importlib.import_module(module.name)
        except ModuleNotFoundError as fault:
            assert fault.name.startswith("matplotlib"), module.name
            print(module.name)
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    names = {name.removeprefix("aqualvs.") for name in done.stdout.split()}
    assert {name for name in names if not name.startswith("experiments.")} == DRAWING
    assert not {name for name in names if "benchmark" in name}
