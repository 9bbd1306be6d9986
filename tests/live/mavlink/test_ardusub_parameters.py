"""Parameters of the vehicle, asked for over real MAVLink."""

import contextlib
import time
from collections.abc import Iterator

import pytest

from aqualvs.live.mavlink.link import MavlinkLink

pytest.importorskip("pymavlink")

from fake_ardusub_cases import Fake
from waiting import TIMEOUT_S


@pytest.fixture(scope="module")
def fake() -> Iterator[Fake]:
    """A vehicle with twenty-five more parameters than fit into one round of requests."""
    made = Fake()
    made.play(parameters={"RC4_DZ": 40.0, "RC4_TRIM": 1500.0} | {f"P{i}": i / 4 for i in range(25)})
    yield made
    made.stop()


def test_reads_what_the_vehicle_has(fake: Fake) -> None:
    with contextlib.closing(MavlinkLink(fake.url)) as link:
        found = link.read_parameters(["RC4_DZ", "RC4_TRIM", "RC4_DZ"], timeout_s=TIMEOUT_S)
    assert found == {"RC4_DZ": 40.0, "RC4_TRIM": 1500.0}
    assert {m["kind"] for m in fake.wire} <= {"HEARTBEAT", "PARAM_REQUEST_READ"}


def test_leaves_out_what_it_does_not_have_and_still_reads_the_rest(fake: Fake) -> None:
    strange = [f"NONE{i}" for i in range(12)]
    with contextlib.closing(MavlinkLink(fake.url)) as link:
        # Those that do not exist are waited for until the end, on a busy machine, too.
        found = link.read_parameters([*strange, *(f"P{i}" for i in range(25))], timeout_s=6.0)
    assert found == {f"P{i}": i / 4 for i in range(25)}


def test_gives_up_after_its_patience() -> None:
    with contextlib.closing(MavlinkLink("udpout:127.0.0.1:9")) as link:
        began = time.monotonic()
        assert link.read_parameters(["RC4_DZ"], timeout_s=0.2) == {}
        assert time.monotonic() - began >= 0.2


def test_reads_anew_each_time(fake: Fake) -> None:
    with contextlib.closing(MavlinkLink(fake.url)) as link:
        assert link.read_parameters(["P1"], timeout_s=TIMEOUT_S) == {"P1": 0.25}
        fake.play(parameters={"P1": 7.0})
        assert link.read_parameters(["P1"], timeout_s=TIMEOUT_S) == {"P1": 7.0}
