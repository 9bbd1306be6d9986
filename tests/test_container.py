"""The container's labels: what BlueOS reads must be JSON and name what the page serves."""

import json
import re

import pytest

from aqualvs import __version__
from aqualvs.live.options import DASHBOARD_PORT
from repository import ROOT

DOCKERFILE = ROOT / "Dockerfile"


def label(name: str) -> str:
    found = re.search(rf"^LABEL {name}=(['\"])(.*)\1$", DOCKERFILE.read_text(), re.MULTILINE)
    assert found is not None, name
    return found.group(2)


@pytest.mark.parametrize("name", ["authors", "company", "tags", "permissions"])
def test_labels_are_json(name: str) -> None:
    assert json.loads(label(name))


def test_versions_and_ports_agree_with_the_program() -> None:
    assert label("version") == __version__
    assert f"{DASHBOARD_PORT}/tcp" in json.loads(label("permissions"))["ExposedPorts"]
    command = DOCKERFILE.read_text().splitlines()[-1]
    assert f"0.0.0.0:{DASHBOARD_PORT}" in command


def test_the_command_is_one_that_aqualvs_has() -> None:
    from typer.testing import CliRunner

    from aqualvs.cli.main import app

    command = DOCKERFILE.read_text().splitlines()[-1]
    told = CliRunner().invoke(app, ["live", "--help"], env={"COLUMNS": "200"}).output
    for option in re.findall(r"--[a-z-]+", command):
        assert option in told
