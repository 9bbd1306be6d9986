"""Malformed files and options: no traceback, no hang, no flood of memory, no silent success.

`make fuzz` runs more of them.
"""

import sys

import pytest

from fuzz_cases import Bench, failures
from whole import WHOLE

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="judges copies of this process")

N_CASES = 150 if WHOLE else 16


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    return Bench(tmp_path_factory.mktemp("fuzz") / "bench")


def test_malformed_input_is_refused_in_one_line(bench, tmp_path):
    assert failures(bench, 17, N_CASES, tmp_path) == []
