"""The site builds without a network, and no link inside it is dead."""

import os
import shutil
import subprocess
import sys

import pytest

import aqualvs
from repository import ROOT

pytest.importorskip("material", reason="the site needs the dev extra")


def build(folder, docs=None):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    if docs is not None:
        command += ["--config-file", str(docs)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    return subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300
    )


def test_the_site_builds_and_links_hold(tmp_path):
    done = build(tmp_path / "site")
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "site" / "index.html").read_text(encoding="utf-8")
    assert f"aqualvs {aqualvs.__version__}" in page
    formulas = (tmp_path / "site" / "mathematics.html").read_text(encoding="utf-8")
    assert "<mfrac>" in formulas
    assert "```" not in formulas
    reference = (tmp_path / "site" / "reference.html").read_text(encoding="utf-8")
    missing = [name for name in aqualvs.__all__ if f'id="aqualvs.{name}"' not in reference]
    assert not missing
    # What a page loads comes with it.
    loads = [part.split('"')[0] for part in page.split('src="')[1:]]
    loads += [part.split('href="')[1].split('"')[0] for part in page.split("<link ")[1:]]
    assert loads
    assert not [one for one in loads if one.startswith(("http:", "https:", "//"))]


def test_a_dead_link_is_found(tmp_path):
    docs = tmp_path / "docs"
    docs.mkdir()
    (docs / "index.md").write_text("[gone](gone.md)\n", encoding="utf-8")
    config = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").split("nav:\n")[0]
    shutil.copytree(ROOT / "tools", tmp_path / "tools")
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    (tmp_path / "mkdocs.yml").write_text(config, encoding="utf-8")
    done = build(tmp_path / "site", tmp_path / "mkdocs.yml")
    assert done.returncode != 0
    assert "gone.md" in done.stderr + done.stdout
