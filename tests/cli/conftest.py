"""Fixtures of the tests through the command line."""

from collections.abc import Callable

import pytest

from aqualvs.cli.main import main


@pytest.fixture
def refused(capfd: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run the command line; it must refuse in one line with exit code 2. Returns the line."""

    def check(*arguments: object) -> str:
        assert main([str(one) for one in arguments]) == 2
        said = capfd.readouterr()
        assert said.err.count("\n") == 1
        assert said.err.startswith("aqualvs: error: ")
        assert "Traceback" not in said.err
        return said.err

    return check
