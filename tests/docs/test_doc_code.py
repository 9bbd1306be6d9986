"""Code and files that the documentation shows: Python runs, YAML is read by what it is for."""

import contextlib
import importlib
import io
import json
import math
import os
import shutil
import socket
import struct
import subprocess
import sys
import threading
import time
from importlib.resources import files
from pathlib import Path

import pytest
import yaml

from aqualvs.calibration.targets.target_files import load_board, load_box
from aqualvs.control.plan import load_plan
from aqualvs.live.options import load_vehicle
from aqualvs.optics.rigfile import load_rig
from aqualvs.pipeline import run_and_print
from aqualvs.results.run_request import FrameWindow, RunRequest
from aqualvs.simulation import scenario
from doc_blocks import Block, blocks
from repository import ROOT
from whole import WHOLE

PYTHON = blocks("python")
YAML = blocks("yaml")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What the snippets find: a rig, a recording, the examples."""
    folder = tmp_path_factory.mktemp("snippets")
    demo = files("aqualvs") / "data" / "demo"
    shutil.copy(str(demo / "rig.yaml"), folder / "rig.yaml")
    shutil.copytree(ROOT / "examples", folder / "examples")
    request = RunRequest(
        source=str(demo / "dive.mp4"),
        rig=folder / "rig.yaml",
        out=folder / "run",
        frames=FrameWindow(0, 5),
        mcap=True,
        report=False,
    )
    assert run_and_print(request, lambda _line: None) == 0
    shutil.copy(folder / "run" / "dive.mcap", folder / "dive.mcap")
    (folder / "dive.tlog").write_bytes(vehicle_log())
    return folder


def vehicle_log(seconds: int = 40) -> bytes:
    """A telemetry log of a vehicle that turns to and fro at 5 m, as pymavlink packs it."""
    mavlink = importlib.import_module("pymavlink.dialects.v20.ardupilotmega")
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    records = []
    for i in range(10 * seconds):
        boot_ms = 100 * i
        heading = 0.3 * math.sin(0.05 * i)
        heartbeat = mavlink.MAVLink_heartbeat_message(12, 3, 128, 2, 4, 3)
        attitude = mavlink.MAVLink_attitude_message(boot_ms, 0.0, 0.0, heading, 0.0, 0.0, 0.0)
        depth = mavlink.MAVLink_global_position_int_message(boot_ms, 0, 0, 0, -5000, 0, 0, 0, 0)
        for message in (heartbeat, attitude, depth):
            stamp = struct.pack(">Q", 1_700_000_000_000_000 + 1000 * boot_ms)
            records.append(stamp + message.pack(sender))
    return b"".join(records)


def telling(stop: threading.Event) -> None:
    """Send what `aqualvs live --json` sends, until told to stop."""
    sample = json.dumps({"valid": True, "range_m": 0.6}).encode()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        while not stop.is_set():
            sender.sendto(sample, ("127.0.0.1", 14660))
            time.sleep(0.02)


@pytest.mark.parametrize("block", PYTHON, ids=str)
def test_python_runs(block: Block, folder):
    if "while True" in block.text:
        said = said_by_an_endless_one(block.text, folder)
    elif WHOLE:
        # By themselves, which tells of a module that only others import.
        said = said_by_a_process(block.text, folder)
    else:
        # A process of its own takes seconds to begin.
        told = io.StringIO()
        with contextlib.chdir(folder), contextlib.redirect_stdout(told):
            exec(compile(block.text, str(block), "exec"), {"__name__": "__main__"})
        said = told.getvalue()
    if "print(" in block.text:
        assert said.strip()


def said_by_an_endless_one(code: str, folder: Path) -> str:
    stop = threading.Event()
    threading.Thread(target=telling, args=(stop,), daemon=True).start()
    try:
        return said_by_a_process(code.replace("while True:", "for _ in range(3):"), folder)
    finally:
        stop.set()


def said_by_a_process(code: str, folder: Path) -> str:
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("block", YAML, ids=str)
def test_yaml_is_what_it_is_shown_for(block: Block, tmp_path):
    shown = yaml.safe_load(block.text)
    path = tmp_path / "shown.yaml"
    path.write_text(block.text, encoding="utf-8")
    if "aqualvs_plan" in shown:
        load_plan(path)
    elif "aqualvs_vehicle" in shown:
        (tmp_path / shown["key"]).write_text("a passphrase", encoding="utf-8")
        load_vehicle(path)
    elif "squares_x" in shown:
        load_board(path)
    elif "markers" in shown:
        load_box(path)
    elif "motion" in shown:
        scenario.read_scenario(path)
    else:
        text = next(b.text for b in YAML if b.page == "rig.md")
        whole = {} if "aqualvs_rig" in shown else yaml.safe_load(text)
        if "flat" in shown:
            del whole["dome"]
        for key, value in shown.items():
            # Some keys of a section stand for what the rest of it has in the first block.
            whole[key] = whole.get(key, {}) | value if isinstance(value, dict) else value
        path.write_text(yaml.safe_dump(whole), encoding="utf-8")
        load_rig(path)


def test_the_page_names_every_key_of_a_scenario():
    page = (ROOT / "docs/cameras.md").read_text(encoding="utf-8")
    section = page.partition("## Scenario files")[2].partition("\n## ")[0]
    schemas = [one for name, one in vars(scenario).items() if name.endswith("File")]
    assert len(schemas) == 9
    for schema in schemas:
        for key in schema.model_fields:
            assert f"`{key}`" in section, f"{schema.__name__}.{key}"
