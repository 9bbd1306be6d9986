"""The dome's own checks."""

import pytest

from aqualvs.errors import RigError
from aqualvs.optics.dome import Dome


def test_outer_radius() -> None:
    assert Dome(0.04425, 0.00575, 1.49).outer_radius == pytest.approx(0.05)
    assert Dome(0.05, 0.0, 1.49).outer_radius == 0.05


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ((0.0, 0.005, 1.49), "inner radius 0 mm"),
        ((float("nan"), 0.005, 1.49), "inner radius nan mm"),
        ((float("inf"), 0.005, 1.49), "inner radius inf mm"),
        ((0.044, -0.001, 1.49), "thickness -1 mm"),
        ((0.044, float("nan"), 1.49), "thickness nan mm"),
        ((0.044, 0.005, 0.5), "n_acrylic = 0.5"),
        ((0.044, 0.005, float("nan")), "n_acrylic = nan"),
        ((0.044, 0.005, 149.0), "between 1 and 3"),
    ],
)
def test_impossible_domes_are_refused(values: tuple[float, float, float], words: str) -> None:
    with pytest.raises(RigError, match=words):
        Dome(*values)
