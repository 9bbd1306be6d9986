"""`aqualvs demo`, with a short dive in place of the bundled one."""

import pytest

from aqualvs.cli.main import main


@pytest.fixture(scope="module")
def short_dive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bundled")
    scenario = folder / "short.yaml"
    scenario.write_text("duration_s: 0.12\nmotion: {range_mm: [500, 520]}\nwalls: [{}]\n")
    assert main(["simulate", str(scenario), "-o", str(folder / "demo")]) == 0
    return folder / "demo"


def test_the_demo_measures_and_compares(short_dive, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("aqualvs.demo.bundled_dive", lambda: short_dive)
    out = tmp_path / "out"
    # The second time it replaces the first, when asked to.
    for options in ([], ["--overwrite"]):
        assert main(["demo", "-o", str(out), *options]) == 0
        said = capsys.readouterr().out
        assert "posture in 3 of 3 frames" in said
        assert "against the truth in 3 frames" in said
        assert f"report: {out / 'report.html'}" in said
    assert (out / "report.html").is_file()


def test_a_missing_dive_is_said(tmp_path, monkeypatch, refused):
    monkeypatch.setattr("aqualvs.demo.bundled_dive", lambda: tmp_path)
    assert "dive.mp4: missing" in refused("demo", "-o", tmp_path / "out")
