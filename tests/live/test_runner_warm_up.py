"""The made-up picture that makes a scanner ready must be one that it can measure."""

import pytest

from aqualvs.live.runner import warm_up
from aqualvs.optics.rig import Rig
from aqualvs.scanner import Scanner
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig


@pytest.mark.parametrize("rig", [example_rig(), bluerov2_rig()], ids=["576", "1080"])
def test_the_whole_path_is_walked(rig: Rig) -> None:
    posture = warm_up(Scanner(rig)).posture
    assert posture
    # Painted with whole-pixel lines: a tenth of a pixel is about 0.1 % of the range.
    assert posture.range == pytest.approx(0.5 * sum(rig.working_range), rel=3e-3)
    assert abs(posture.yaw) < 0.01
    assert abs(posture.pitch) < 0.01
