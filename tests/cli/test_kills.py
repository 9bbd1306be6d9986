"""Commands that are killed: what they leave is readable, and goes on to the same results.

`make kills` does it a hundred times, for `live` and `follow` too.
"""

import random

import pytest

from kill_cases import Kills
from processes import on_proc

KINDS = ("run", "batch")


@pytest.fixture(scope="module")
def kills(tmp_path_factory):
    return Kills(tmp_path_factory.mktemp("kills") / "home", KINDS)


@on_proc
@pytest.mark.parametrize("kind", KINDS)
def test_a_command_killed_at_a_random_moment(kills, kind):
    # The later half: before it, a command has hardly begun to write.
    moment = 0.5 + 0.5 * random.Random(kind).random()
    assert kills.fault_after(kind, moment, again=True) == ""
