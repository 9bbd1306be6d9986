"""Options that would do nothing: another option that they need is implied, or they are refused."""

import pytest
from typer.main import get_command

from aqualvs.cli.follow import OF_A_SIMULATION, OF_A_VEHICLE
from aqualvs.cli.main import app, main
from aqualvs.follow import vehicle
from aqualvs.live import command as live_command

LIVE = ["live", "udp://127.0.0.1:1", "--rig", "none.yaml"]
FOLLOW = ["follow", "udp://127.0.0.1:1", "--rig", "none.yaml", "--mavlink", "udpin:127.0.0.1:1"]


@pytest.fixture
def requests(monkeypatch):
    """Requests of `live` and of `follow` with a vehicle, which do not run."""
    made = []

    def note(request, _echo):
        made.append(getattr(request, "live", request))
        return 0

    monkeypatch.setattr(live_command, "run_live", note)
    monkeypatch.setattr(vehicle, "run_follow", note)
    return made


@pytest.mark.parametrize("command", [LIVE, [*FOLLOW, "--gains", "bluerov2"]])
def test_options_of_recordings_record(command, requests):
    for options in ([], ["--record-video"], ["--record-to", "here"]):
        assert main([*command, *options]) == 0
    assert [request.record for request in requests] == [False, True, True]
    # The page's button begins recordings.
    assert main([*command, "--record-video", "--dashboard"]) == 0
    assert not requests[-1].record


def test_an_address_serves(requests):
    addresses = ["--dashboard-address", "127.0.0.1:9000", "--foxglove-address", "127.0.0.1:9001"]
    assert main([*LIVE, *addresses]) == 0
    assert (requests[0].page.host, requests[0].page.port) == ("127.0.0.1", 9000)
    assert requests[0].outputs[0].args == ("127.0.0.1", 9001)
    assert main(LIVE) == 0
    assert requests[1].page is None
    assert requests[1].outputs == ()


def test_a_token_of_the_environment_is_for_all_commands(requests, monkeypatch):
    monkeypatch.setenv("AQUALVS_TOKEN", "long enough for a page")
    assert main(LIVE) == 0
    assert len(requests) == 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([*LIVE, "--token", "secret-words"], "--token: for the pilot's page; add --dashboard"),
        (
            [*LIVE, "--embed-from", "http://a"],
            "--embed-from http://a: for the pilot's page; add --dashboard",
        ),
        (
            [*LIVE, "--mavlink-peer", "10.0.0.1"],
            "--mavlink-peer 10.0.0.1: for a MAVLink connection; add --mavlink",
        ),
        (
            ["doctor", "--mavlink-key", "key"],
            "--mavlink-key key: for a MAVLink connection; add --mavlink",
        ),
        (
            ["follow", "--sim", "--rig", "rig.yaml"],
            "--rig rig.yaml: for a vehicle; leave it out with --sim",
        ),
        (["follow", "--sim", "--record"], "--record: for a vehicle; leave it out with --sim"),
        (
            ["follow", "--sim", "--token", "secret-words"],
            "--token: for the pilot's page; add --dashboard",
        ),
        (
            [*FOLLOW, "--gains", "bluerov2", "--waves", "0.2"],
            "--waves 0.2: for a simulation; leave it out, or give --sim",
        ),
        (
            ["board", "charuco", "-o", "b", "--width-mm", "300"],
            "--width-mm 300.0: not of a charuco; leave it out",
        ),
        (
            ["board", "box", "-o", "b", "--squares-x", "3"],
            "--squares-x 3: not of a box; leave it out",
        ),
        (["board", "charuco", "-o", "b", "--squares-x", "0"], "--squares-x 0: give 1 or more"),
        (
            ["board", "plate", "-o", "b", "--marker-mm", "0"],
            "--marker-mm 0: give millimetres, 1 or more",
        ),
    ],
)
def test_options_that_would_do_nothing_are_refused(arguments, said, refused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert refused(*arguments) == said
    assert not list(tmp_path.iterdir())


def test_the_help_of_follow_says_which_options_are_for_what():
    told = {"Vehicle:": set(), "Sim:": set(), "Sim,": set()}
    for parameter in get_command(app).commands["follow"].params:
        first = (getattr(parameter, "help", None) or "").partition(" ")[0]
        told.get(first, set()).add(parameter.name)
    assert told["Sim:"] | told["Sim,"] == set(OF_A_SIMULATION)
    shared_texts = {"source", "vehicle_file", "mavlink_peer", "mavlink_key"}
    assert told["Vehicle:"] == set(OF_A_VEHICLE) - shared_texts
