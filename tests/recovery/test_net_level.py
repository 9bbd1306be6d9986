"""Level square nets: strands run along the stripes of level and of upright lasers."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Laser
from aqualvs.scanner import Scanner
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.simulation.scenario import dome_from_target
from aqualvs.simulation.scenarios import example_rig
from aqualvs.simulation.scene import Net, Scene, SurfaceKind, Wall
from aqualvs.simulation.truth import visible_fit
from net_dives import frame_of
from quick_pictures import QuickRenderer


def level(name: str, height: float, tilt_deg: float) -> Laser:
    """Return a laser whose sheet is `height` (m) above the dome, and falls towards the target."""
    tilt = np.deg2rad(tilt_deg)
    return Laser(name, Plane.from_normal((0.0, np.sin(tilt), np.cos(tilt)), height * np.cos(tilt)))


def upright(name: str, side: float, tilt_deg: float) -> Laser:
    """Return a laser whose sheet is `side` (m) to the right, and turns left towards the target."""
    tilt = np.deg2rad(tilt_deg)
    return Laser(name, Plane.from_normal((np.cos(tilt), np.sin(tilt), 0.0), side * np.cos(tilt)))


def fan(n: int, half_angle_deg: float) -> tuple[Laser, ...]:
    """Return upright lasers of one emitter, which stand evenly over twice the angle."""
    angles = np.deg2rad(np.linspace(-half_angle_deg, half_angle_deg, n))
    emitter = np.array([0.10, 0.0, 0.06])
    normals = np.column_stack([np.cos(angles), -np.sin(angles) - 0.15, np.full(n, 0.1)])
    return tuple(
        Laser(f"line_{i}", Plane.from_normal(normal, float(normal @ emitter)))
        for i, normal in enumerate(normals)
    )


HIGH = level("high", 0.12, 8.0)
RIGS = {
    "two": (level("low", -0.15, -14.0), HIGH),
    "three": (level("low", -0.15, -12.0), HIGH, upright("left", -0.14, -14.0)),
}
"""The level lasers cross 0.7 m ahead, so each may have made the other's stripe."""
FANS = {"fan": fan(8, 16.0)}


@cache
def equipment(name: str) -> tuple[QuickRenderer, Scanner]:
    rig = replace(example_rig(), lasers=(RIGS | FANS)[name])
    return QuickRenderer(rig, halo_px=31), Scanner(rig)


def measure(
    lasers: str, net: Net, posture: tuple[float, float, float], behind: float | None = None
) -> tuple[Posture | Refusal, FloatArray]:
    """Measure a net at a range (m), pitch and yaw (deg); return the plane of its lit twine, too.

    The plane is range (m), pitch and yaw (rad).
    """
    distance, pitch, yaw = posture
    pose = dome_from_target(distance, np.deg2rad(pitch), np.deg2rad(yaw))
    walls = () if behind is None else (Wall(depth=behind),)
    renderer, scanner = equipment(lasers)
    scene = Scene(dome_from_scene=pose, nets=(net,), walls=walls)
    picture = renderer.render(scene, 0.0, np.random.default_rng(7))
    seen = visible_fit(picture.lit, SurfaceKind.NET)
    assert seen is not None
    x, y, z = seen[0].normal
    true = np.array([seen[0].offset, np.arctan2(z, y), np.arctan2(x, y)])
    return scanner.process(frame_of(0, 0.0, picture.image)).posture, true


def square(bar: float, twine: float, roll_deg: float, offset: tuple[float, float]) -> Net:
    return Net(mesh="square", bar=bar, twine=twine, roll=np.deg2rad(roll_deg), offset=offset)


def error(posture: Posture | Refusal, true: FloatArray) -> FloatArray:
    assert posture, posture
    off: FloatArray = np.array([posture.range, posture.pitch, posture.yaw]) - true
    return off


@pytest.mark.parametrize("slide", [0.0, 0.013, 0.027])
def test_a_coarse_net_is_found_before_a_wall(slide: float) -> None:
    """Its few lit strands are a twentieth of the light on the wall, and most of it in front."""
    net = square(0.0401, 0.0013, -0.4, (0.036 + slide, 0.0216 + slide))
    posture, true = measure("three", net, (0.629, 6.0, 0.4), behind=0.213)
    # Measured to the wall, a third farther, without a look in front of it.
    assert abs(error(posture, true)[0]) < 0.002 * true[0]


def test_a_strand_along_a_sheet_hides_no_net_before_a_wall() -> None:
    net = square(0.0388, 0.0024, 0.24, (0.0197, 0.0282))
    posture, true = measure("three", net, (0.506, -4.0, 1.0), behind=0.325)
    assert abs(error(posture, true)[0]) < 0.002 * true[0]


FINE = square(0.0246, 0.0032, -1.5, (0.0948, 0.0583)), (0.655, -2.7, -4.5), 0.751
NEAR = square(0.0278, 0.0022, 1.1, (0.0752, 0.0274)), (0.523, -3.6, 7.6), 0.752
FAR = square(0.0392, 0.0031, 1.7, (0.0651, 0.0273)), (0.893, -7.1, 0.1), 0.68


@pytest.mark.parametrize(("net", "at", "behind"), [FINE, NEAR, FAR], ids=["fine", "near", "far"])
@pytest.mark.parametrize("lasers", RIGS)
def test_stripes_on_a_wall_out_of_range_are_not_read_as_each_others(
    lasers: str, net: Net, at: tuple[float, float, float], behind: float
) -> None:
    """With two lasers exchanged they lie on a plane at half the net's range, tilted by 45 degrees.

    A third laser, which shows nothing there, tells; two lasers alone cannot, and refuse it.
    """
    posture, true = measure(lasers, net, at, behind)
    if posture:
        assert abs(error(posture, true)[0]) < 0.02 * true[0]


def test_a_net_is_measured_before_a_wall_out_of_range() -> None:
    net, at, behind = FINE
    posture, true = measure("three", net, at, behind)
    assert abs(error(posture, true)[0]) < 0.002 * true[0]


@pytest.mark.parametrize(
    ("net", "at", "behind"),
    [
        (square(0.0347, 0.0028, -23.9, (0.085, 0.0394)), (0.82, -7.1, 6.0), 0.64),
        (square(0.0266, 0.0026, -24.7, (0.0169, 0.0513)), (0.8, 3.3, -5.0), 0.61),
    ],
)
def test_stripes_on_a_wall_out_of_range_are_not_read_as_the_next_lasers(
    net: Net, at: tuple[float, float, float], behind: float
) -> None:
    """Read so, they lie on a plane before the net, a fifth too near."""
    posture, true = measure("fan", net, at, behind)
    assert abs(error(posture, true)[0]) < 0.002 * true[0]


@pytest.mark.parametrize(
    ("net", "at"),
    [
        (square(0.0373, 0.0029, -0.37, (0.0854, 0.0129)), (0.402, 6.3, 9.3)),
        (square(0.0194, 0.002, -0.53, (0.0933, 0.0981)), (0.597, 3.3, -5.7)),
    ],
    ids=["bent", "solid"],
)
def test_light_along_a_strand_is_off_the_sheets_middle(
    net: Net, at: tuple[float, float, float]
) -> None:
    """One stripe lies on a strand, a pixel beside the middle of its sheet.

    Taken at its word it bends the net by 2 degrees, or makes a wall of it, 6 sigmas off.
    """
    posture, true = measure("three", net, at)
    off = error(posture, true)
    assert isinstance(posture, Posture)
    assert np.all(np.abs(off) < 4.0 * np.sqrt(np.diag(posture.covariance)))
    assert np.rad2deg(np.abs(off[1:])).max() < 0.3


@pytest.mark.parametrize(
    ("net", "at", "behind"),
    [
        (square(0.0267, 0.0022, -10.6, (0.0626, 0.0507)), (0.39, 5.2, 9.69), 0.27),
        (square(0.0306, 0.0016, 14.1, (0.0992, 0.0596)), (0.38, 6.16, 5.0), 0.27),
    ],
)
def test_lasers_that_may_have_made_a_stripe_do_not_multiply_its_light(
    net: Net, at: tuple[float, float, float], behind: float
) -> None:
    """The net has most of the light before the wall, each peak counted once.

    Counted for each laser of the fan that may have made it, other light was more, and the wall
    was measured, 70 % farther.
    """
    posture, true = measure("fan", net, at, behind)
    assert abs(error(posture, true)[0]) < 0.005 * true[0]


@pytest.mark.parametrize(
    ("net", "at", "behind"),
    [
        (square(0.0366, 0.0017, 3.2, (0.0479, 0.0959)), (0.44, -1.96, -14.97), 0.26),
        (square(0.0286, 0.0015, 23.5, (0.095, 0.0071)), (0.49, -6.32, -2.87), 0.34),
    ],
)
def test_a_wall_with_strands_before_many_lasers_is_no_target(
    net: Net, at: tuple[float, float, float], behind: float
) -> None:
    posture, _ = measure("fan", net, at, behind)
    assert isinstance(posture, Refusal)
    assert posture.reason is Reason.AMBIGUOUS
    assert "much light in front of the surface" in posture.detail
