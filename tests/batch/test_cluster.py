"""`aqualvs batch --scheduler` with a scheduler and workers of their own, as on other machines."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time

import pytest

from aqualvs.cli.main import main
from batch_cases import DEMO, RESULTS, demo_dive, without_times
from whole import WHOLE

distributed = pytest.importorskip("distributed")

TIMEOUT_S = 240
DASK = [sys.executable, "-m", "dask"]
QUIET = ["--no-dashboard"]


@contextlib.contextmanager
def begun(command, folder):
    """A process that works elsewhere than this one; it is ended at the end."""
    with (folder / "said.txt").open("ab") as said:
        process = subprocess.Popen(command, cwd=folder, stdout=said, stderr=said)
        try:
            yield process
        finally:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(timeout=TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def await_worker(address, name, said):
    deadline = time.monotonic() + TIMEOUT_S
    with distributed.Client(address, timeout=TIMEOUT_S, set_as_default=False) as client:
        while name not in names_of_workers(client):
            assert time.monotonic() < deadline, said.read_text()
            time.sleep(0.05)


def names_of_workers(client):
    return {worker["name"] for worker in client.scheduler_info()["workers"].values()}


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """Address of a scheduler."""
    folder = tmp_path_factory.mktemp("scheduler")
    told = folder / "scheduler.json"
    command = [*DASK, "scheduler", "--host", "127.0.0.1", "--port", "0", *QUIET]
    with begun([*command, "--scheduler-file", str(told)], folder):
        deadline = time.monotonic() + TIMEOUT_S
        while not told.exists() or not told.read_text().endswith("}"):
            assert time.monotonic() < deadline, (folder / "said.txt").read_text()
            time.sleep(0.05)
        yield json.loads(told.read_text())["address"]


@pytest.fixture
def worker(address, tmp_path):
    """What begins a worker for the scheduler, of which it has none before."""
    deadline = time.monotonic() + TIMEOUT_S
    with distributed.Client(address, timeout=TIMEOUT_S, set_as_default=False) as client:
        while names_of_workers(client):
            assert time.monotonic() < deadline
            time.sleep(0.05)
    with contextlib.ExitStack() as stack:

        def begin(name, program=DASK):
            place = tmp_path / name
            place.mkdir()
            command = [*program, "worker", address, "--nthreads", "1", "--no-nanny", *QUIET]
            process = stack.enter_context(begun([*command, "--name", name], place))
            await_worker(address, name, place / "said.txt")
            return process

        yield begin


@pytest.fixture(scope="module")
def season(tmp_path_factory):
    folder = tmp_path_factory.mktemp("season")
    for name in ("north", "south"):
        demo_dive(folder / f"{name}.mp4", 24, 6)
    (folder / "rig.yaml").write_bytes((DEMO / "rig.yaml").read_bytes())
    return folder


def batch(season, out, *more):
    return main(["batch", str(season), "-o", str(out), "--no-report", "--net", *more])


def results(out):
    return {
        f"{name}/{file}": without_times(out / "dives" / name / file)
        for name in ("north", "south")
        for file in (*RESULTS, "net.csv")
    }


@pytest.fixture(scope="module")
def near(season, tmp_path_factory):
    """What runs on this machine give."""
    out = tmp_path_factory.mktemp("near")
    for name in ("north", "south"):
        words = ["run", str(season / f"{name}.mp4"), "--rig", str(season / "rig.yaml")]
        words += ["-o", str(out / "dives" / name), "--no-report", "--net", "--workers", "1"]
        assert main(words) == 0
    return results(out)


def test_workers_may_come_and_go_and_give_what_runs_on_this_machine_give(
    address, worker, season, near, tmp_path
):
    first = worker("one")
    if WHOLE:
        worker("two")
    out, said = tmp_path / "out", tmp_path / "said.txt"
    command = [sys.executable, "-m", "aqualvs", "batch", str(season), "-o", str(out)]
    command += ["--no-report", "--net", "--scheduler", address]
    with begun(command, tmp_path) as process:
        deadline = time.monotonic() + TIMEOUT_S
        while not list((out / ".batch" / "dives").glob("*/survey")):
            assert time.monotonic() < deadline
            assert process.poll() is None, said.read_text()
            time.sleep(0.02)
        os.kill(first.pid, signal.SIGKILL)
        worker("three")
        assert process.wait(timeout=TIMEOUT_S) == 0, said.read_text()
    assert "2 finished" in said.read_text()
    far = results(out)
    assert [name for name in near if far[name] != near[name]] == []


@pytest.mark.usefixtures("worker")
def test_a_scheduler_without_workers_is_said(address, season, tmp_path, capsys):
    assert batch(season, tmp_path / "out", "--scheduler", address) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert address in said
    assert "worker" in said


def test_a_worker_without_aqualvs_is_said(address, worker, season, tmp_path, capsys):
    lacks = "import sys; sys.modules['aqualvs'] = None; from dask.__main__ import main; main()"
    worker("bare", [sys.executable, "-c", lacks])
    assert batch(season, tmp_path / "out", "--scheduler", address) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "install aqualvs[batch] of this version on its machine" in said
