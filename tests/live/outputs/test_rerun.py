"""The output to Rerun: files and viewers, which come and go; the SDK is a stand-in."""

import socket
from typing import ClassVar

import pytest

from aqualvs.errors import OptionError, OutputError
from aqualvs.live.outputs import rerun
from aqualvs.sources.base import State
from live_cases import demo_samples


class Log:
    made: ClassVar[list["Log"]] = []

    def __init__(self):
        self.samples, self.opened, self.closed = [], None, False
        self.made.append(self)

    def save(self, path):
        path.touch()
        self.opened = path

    def connect(self, url):
        self.opened = url

    def spawn(self):
        self.opened = "viewer"

    def write(self, sample):
        self.samples.append(sample)

    def close(self):
        self.closed = True


@pytest.fixture
def logs(monkeypatch):
    monkeypatch.setattr(rerun, "rerun_sdk", lambda: None)
    monkeypatch.setattr(rerun, "RerunLog", Log)
    # Look for the viewer before every sample.
    monkeypatch.setattr(rerun, "_CHECK_EVERY_S", 0.0)
    monkeypatch.setattr(Log, "made", [])
    return Log.made


@pytest.fixture(scope="module")
def sample():
    return demo_samples(1)[0]


def test_file(logs, sample, tmp_path):
    path = tmp_path / "dive.rrd"
    output = rerun.RerunOutput(str(path))
    assert output.keeps_all
    output.send(sample)
    assert (logs[0].opened, len(logs[0].samples)) == (path, 1)
    assert output.health().state is State.OK
    output.close()
    output.send(sample)
    assert (len(logs[0].samples), logs[0].closed, output.health().state) == (1, True, State.OFF)
    with pytest.raises(OutputError, match="exists; choose another name"):
        rerun.RerunOutput(str(path))


def test_viewer_comes_leaves_and_comes_back(logs, sample):
    with socket.create_server(("127.0.0.1", 0)) as viewer:
        port = viewer.getsockname()[1]
    output = rerun.RerunOutput(f"127.0.0.1:{port}")
    with pytest.raises(OSError, match=f"no viewer at 127.0.0.1:{port}"):
        output.send(sample)
    assert output.health().state is State.WARN
    with socket.create_server(("127.0.0.1", port)):
        output.send(sample)
        assert output.health().state is State.OK
    with pytest.raises(OSError, match="no viewer"):
        output.send(sample)
    with socket.create_server(("127.0.0.1", port)):
        output.send(sample)
    output.close()
    first, second = (one for one in logs if one.opened)
    assert first.opened == second.opened == f"rerun+http://127.0.0.1:{port}/proxy"
    assert (first.closed, second.closed, len(second.samples)) == (True, True, 1)


def test_viewer_of_its_own(logs, sample):
    output = rerun.RerunOutput("viewer")
    assert not output.keeps_all
    assert not logs
    output.send(sample)
    output.send(sample)
    assert (logs[0].opened, len(logs[0].samples), len(logs)) == ("viewer", 2, 1)


@pytest.mark.parametrize("where", ["", "somewhere", ":9876", "host:port", "dive.mcap"])
def test_no_place(logs, where):
    with pytest.raises(OptionError, match="give viewer, HOST:PORT"):
        rerun.RerunOutput(where)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (PermissionError(13, "Permission denied"), "Permission denied"),
        (ValueError("embedded null byte"), "embedded null byte"),
    ],
)
def test_file_that_cannot_be_written(logs, tmp_path, monkeypatch, fault, words):
    def refuse(self, path):
        raise fault

    monkeypatch.setattr(Log, "save", refuse)
    with pytest.raises(OutputError, match=rf"cannot be written \({words}\)"):
        rerun.RerunOutput(str(tmp_path / "dive.rrd"))
