"""Fixtures of the tests through the command line."""

from collections.abc import Callable

import pytest

from aqualvs.cli.main import main
from complaints import complaints


@pytest.fixture
def refused(capfd: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run the command line, which must refuse in one line with exit code 2; returns its words."""

    def check(*arguments: object) -> str:
        assert main([str(one) for one in arguments]) == 2
        said = complaints(capfd.readouterr().err)
        assert len(said) == 1
        assert said[0].startswith("aqualvs: error: ")
        return said[0].removeprefix("aqualvs: error: ").rstrip("\n")

    return check
