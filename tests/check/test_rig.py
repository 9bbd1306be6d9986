"""`aqualvs check`: numbers against closed forms and Monte Carlo, verdicts on spoilt rigs."""

import io
import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from aqualvs.calibration.targets.targets import View
from aqualvs.calibration.water_index.estimator import calibrate_water
from aqualvs.calibration.water_index.state import IndexOptions
from aqualvs.check.finding import index_sigma, index_sigma_of_step
from aqualvs.check.rig import check_rig, field_of_view, run_check
from aqualvs.errors import RigError
from aqualvs.geometry import SE3, Plane, rotation_from_rotvec
from aqualvs.optics.expected_error import (
    SIGMA_PX,
    ExpectedError,
    expected_posture_errors,
    point_per_pixel,
    visible_stripe,
)
from aqualvs.optics.flat_port import FlatPort
from aqualvs.optics.lens import Lens, LensModel
from aqualvs.optics.rig import (
    DOME_FROM_CAM_NOMINAL,
    Laser,
    Rig,
    RigUncertainty,
    Window,
    rig_parameter_names,
)
from aqualvs.optics.rigfile import save_rig
from aqualvs.optics.sheet import Sheet, sheets_of
from aqualvs.optics.solved import with_uncertainty
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig, flat_port_rig
from aqualvs.text import Finding, Severity


def pinhole(*lasers: Laser) -> Rig:
    """Return a rig with a bare pinhole camera at the dome's centre."""
    return Rig(
        name="pinhole",
        size_px=(641, 481),
        lens=Lens(fx=800.0, fy=800.0, cx=320.0, cy=240.0),
        dome_from_cam=SE3(DOME_FROM_CAM_NOMINAL, np.zeros(3)),
        housing=None,
        n_air=1.0,
        n_water=1.3333,
        lasers=lasers,
        working_range=(0.3, 1.2),
    )


def upright(offset: float = 0.1) -> Laser:
    return Laser("upright", Plane.from_normal([1.0, 0.0, 0.0], offset))


def level(offset: float = -0.1) -> Laser:
    return Laser("level", Plane.from_normal([0.0, 0.0, 1.0], offset))


def rising(height: float, tilt_deg: float) -> Laser:
    """Return a laser whose sheet is `height` (m) above the camera, and rises towards the target."""
    slope = np.tan(np.deg2rad(tilt_deg))
    return Laser("rising", Plane.from_normal([0.0, -slope, 1.0], height))


def expect(rig: Rig, wall: float) -> ExpectedError:
    return expected_posture_errors(rig, RigUncertainty.none(), (wall,))[0]


def sheet(laser: Laser) -> Sheet:
    return Sheet(plane=laser.plane)


def sentences(findings: list[Finding], severity: Severity) -> str:
    return " ".join(f.sentence for f in findings if f.severity is severity)


@pytest.mark.parametrize("rig", [example_rig(), bluerov2_rig()], ids=lambda rig: rig.name)
def test_example_rigs_are_sane(rig: Rig) -> None:
    findings = check_rig(rig)
    assert sentences(findings, Severity.BAD) == ""
    assert "The lens lies" in sentences(findings, Severity.OK)


def test_a_flat_port_is_described() -> None:
    findings = check_rig(flat_port_rig())
    assert sentences(findings, Severity.BAD) == ""
    said = sentences(findings, Severity.OK)
    assert "a flat port, 12 mm ahead, 5 mm thick and tilted by 0.7 degrees" in said
    assert "Through a flat port the index is observable" in said
    steep = replace(
        flat_port_rig(),
        housing=FlatPort(0.012, 0.005, 1.49, 0.7),
        lens=Lens(model=LensModel.FISHEYE, fx=560.0, fy=560.0, cx=959.5, cy=539.5),
    )
    assert "light misses the flat port" in sentences(check_rig(steep), Severity.WARN)


def test_field_of_view_of_a_pinhole() -> None:
    across, down = field_of_view(pinhole().camera())
    # 641 pixels from edge to edge; 1e-7: arccos near its end, and the arithmetic of the lens.
    assert across == pytest.approx(2.0 * np.arctan(320.5 / 800.0), abs=1e-7)
    assert down == pytest.approx(2.0 * np.arctan(240.5 / 800.0), abs=1e-7)


def test_stripe_of_a_pinhole() -> None:
    stripe = visible_stripe(pinhole().camera(), sheet(upright()), 0.5)
    # x = 320 + 800 · 0.1 / 0.5, the whole height of the picture but for one angular step.
    np.testing.assert_allclose(stripe.pixels[:, 0], 480.0, atol=1e-9)
    assert stripe.length_px == pytest.approx(481.0, abs=4.0)
    np.testing.assert_allclose(stripe.points_in_dome[:, :2], [[0.1, 0.5]] * len(stripe.pixels))


def test_stripe_lies_on_wall_and_laser_behind_a_dome() -> None:
    rig = example_rig()
    window = Window(Plane.from_normal([-0.3, 0.95, 0.1], 0.05), np.array([-0.15, 0.0, 0.0]))
    rig = replace(rig, lasers=(*rig.lasers, replace(rig.lasers[1], name="bent", window=window)))
    for one in sheets_of(rig):
        stripe = visible_stripe(rig.camera(), one, 0.6)
        assert len(stripe.pixels) > 100
        np.testing.assert_allclose(stripe.points_in_dome[:, 1], 0.6, rtol=1e-12)
        np.testing.assert_allclose(one.signed_distance(stripe.points_in_dome), 0.0, atol=1e-14)


def test_laser_parallel_to_the_wall_is_not_seen() -> None:
    across = Plane.from_normal([0.0, 1.0, 0.0], 0.5)
    assert not visible_stripe(pinhole().camera(), Sheet(plane=across), 0.5).visible


@pytest.mark.parametrize("wall", [0.3, 0.6, 1.0])
def test_range_per_pixel_of_a_pinhole(wall: float) -> None:
    """Laser plane at distance b beside the axis: r = f b / (u - cx), so dr/du = r²/(f b)."""
    rig = pinhole(upright(0.1), level(-0.08))
    expected = wall**2 / (800.0 * np.array([0.1, 0.08]))
    per_pixel = expect(rig, wall).per_pixel
    # Second order of the central difference over one pixel: (h/u)² with u = f b / r >= 64 px.
    np.testing.assert_allclose(per_pixel, expected, rtol=1e-4)
    stripe = visible_stripe(rig.camera(), sheet(upright()), wall)
    slope = point_per_pixel(rig.camera(), stripe)
    np.testing.assert_allclose(slope[:, 0], 0.0, atol=1e-12)


def test_one_line_gives_no_posture() -> None:
    assert not expect(pinhole(upright()), 0.5).valid
    assert not expect(pinhole(upright(), replace(upright(), name="twin")), 0.5).valid
    assert not expect(pinhole(), 0.5).valid
    assert expect(pinhole(upright(0.1), upright(-0.1)), 0.5).valid


def test_index_is_seen_by_a_decentred_lens_only() -> None:
    rig = example_rig()
    at = [
        index_sigma(replace(rig, dome_from_cam=SE3(rig.dome_from_cam.rotation, [0.0, y, 0.0])))
        for y in (0.001, 0.005, 0.015, 0.040)
    ]
    assert all(a > b for a, b in itertools.pairwise(at))
    centred = replace(rig, dome_from_cam=SE3(rig.dome_from_cam.rotation, np.zeros(3)))
    assert index_sigma(centred) > 0.1
    assert index_sigma(replace(rig, housing=None)) == np.inf


def test_index_sigma_is_that_of_a_monte_carlo() -> None:
    rig, rng = example_rig(), np.random.default_rng(3)
    told = index_sigma(rig)
    x, z = np.meshgrid(np.linspace(-0.09, 0.09, 10), np.linspace(-0.05, 0.05, 6))
    corners = np.stack([x, np.full_like(x, 0.4), z], axis=-1).reshape(-1, 3)
    tried = rig.n_water + told * np.linspace(-6.0, 6.0, 241)
    seen = [rig.in_water(float(n)).camera().project(corners) for n in tried]
    at, inside = np.array([pixels for pixels, _ in seen]), seen[120][1]
    found = []
    for _ in range(400):
        noisy = at[120] + rng.normal(0.0, SIGMA_PX, size=at[120].shape)
        cost = ((at - noisy) ** 2)[:, inside].sum(axis=(1, 2))
        found.append(tried[np.argmin(cost)])
    # A standard deviation from 400 trials is known to 3.5 %; four times that.
    assert np.std(found) == pytest.approx(told, rel=0.14)


def test_the_index_is_no_better_known_than_the_rig() -> None:
    """As `calibrate water` states it, by the uncertainty of rig and target."""
    rig = example_rig()
    rig = replace(rig, dome_from_cam=SE3(rig.dome_from_cam.rotation, [0.0, 0.03, 0.0]))
    options = IndexOptions.of_target(0.2, 0.1)
    x, z = np.meshgrid(np.linspace(-0.09, 0.09, 10), np.linspace(-0.05, 0.05, 6))
    corners = np.stack([x, np.full_like(x, 0.4), z], axis=-1).reshape(-1, 3)
    pixels, seen = rig.camera().project(corners)
    noisy = pixels[seen] + np.random.default_rng(4).normal(0.0, SIGMA_PX, (seen.sum(), 2))
    view = View("picture", np.flatnonzero(seen), corners[seen], noisy)
    told = []
    for lens_m, words in ((1e-5, "gives it to"), (2e-3, "gives it only to")):
        sigmas = dict.fromkeys(rig_parameter_names(rig), 1e-6)
        sigmas |= dict.fromkeys(("lens_x", "lens_y", "lens_z"), lens_m)
        known = RigUncertainty.independent(sigmas)
        told.append(index_sigma_of_step(rig, known, options))
        found = calibrate_water(rig, [view], uncertainty=known, options=options)
        # The noise of 120 coordinates is known to 7 %; twice that.
        assert told[-1] == pytest.approx(found.sigma, rel=0.14)
        text = sentences(check_rig(with_uncertainty(rig, known)), Severity.OK)
        assert words in text
    assert index_sigma(rig) < told[0] < told[1]


@pytest.mark.parametrize(
    ("rig", "words"),
    [
        (pinhole(), "There are no lasers"),
        (pinhole(upright(), level(0.9)), "'level' never crosses the picture between 300 and 1200"),
        (
            pinhole(upright(), Laser("beside", Plane.from_normal([1.0, -3.0, 0.0], 5e-3))),
            "'beside' never crosses the picture",
        ),
        (
            pinhole(upright(), Laser("twin", Plane.from_normal([-1, 0, 0], -0.1))),
            "lie in one plane",
        ),
        (
            pinhole(upright(1.4e-4), level(-0.1)),
            "'upright' passes the lens at 0.14 mm, so that its stripe does not move with range",
        ),
        (replace(example_rig(), n_water=1.5), "index 1.5000 is not that of water"),
        (
            replace(
                example_rig(),
                dome_from_cam=SE3(
                    rotation_from_rotvec([0.0, 0.0, np.pi]) @ DOME_FROM_CAM_NOMINAL, np.zeros(3)
                ),
            ),
            "looks 180 degrees away",
        ),
    ],
    ids=[
        "no lasers",
        "laser unseen",
        "unseen without depth",
        "coplanar",
        "metres",
        "no water",
        "backwards",
    ],
)
def test_what_makes_a_rig_useless(rig: Rig, words: str) -> None:
    assert words in sentences(check_rig(rig), Severity.BAD)


@pytest.mark.parametrize(
    ("rig", "words"),
    [
        (pinhole(upright()), "One laser draws one line"),
        (pinhole(upright(), level(-0.25)), "'level' is in the picture only from"),
        (
            pinhole(upright(2e-3), level(-0.1)),
            "'upright' passes the lens at 2 mm, so that its stripe hardly moves with range",
        ),
        (replace(example_rig(), n_water=1.0003), "that of air"),
        (
            pinhole(upright(0.05), Laser("b", Plane.from_normal([1, 0, 0.1], -0.05))),
            "at only 6 degrees",
        ),
        (
            replace(
                example_rig(),
                dome_from_cam=SE3(
                    rotation_from_rotvec([0.6, 0.0, 0.0]) @ DOME_FROM_CAM_NOMINAL, np.zeros(3)
                ),
            ),
            "looks 34 degrees away",
        ),
        (
            replace(pinhole(upright()), lens=Lens(fx=800, fy=800, cx=640, cy=240)),
            "(640, 240) px is far",
        ),
        (replace(pinhole(upright()), lens=Lens(fx=800, fy=500, cx=320, cy=240)), "800 and 500 px"),
        (
            replace(
                pinhole(upright()),
                lens=Lens(fx=300, fy=300, cx=320, cy=240, distortion=(-0.5, 0.0, 0.0, 0.0)),
            ),
            "of the picture sees no water",
        ),
        (pinhole(upright(0.002), level(-0.002)), "put the lasers farther"),
        # Their sheets cross 0.45 m ahead; 1 / wall + 1 / other is 2 tan(15) / 0.12.
        (
            pinhole(rising(0.12, -15.0), Laser("high", rising(-0.12, 15.0).plane)),
            "On a wall from 300 to 863 mm, lasers 'rising' and 'high' could each have made",
        ),
    ],
    ids=[
        *(
            "one",
            "near lost",
            "no depth",
            "air",
            "narrow",
            "aside",
            "centre",
            "aspect",
            "lens ends",
        ),
        *("baseline", "exchanged"),
    ],
)
def test_what_is_worth_a_warning(rig: Rig, words: str) -> None:
    findings = check_rig(rig)
    assert words in sentences(findings, Severity.WARN)


def test_of_many_lasers_the_widest_angle_counts() -> None:
    fan = [Laser(f"{i}", Plane.from_normal([1.0, 0.08 * i, 0.0], 0.05)) for i in range(5)]
    said = sentences(check_rig(pinhole(*fan)), Severity.OK)
    assert "Lasers '0' and '4' meet at 18 degrees." in said
    assert said.count("meet at") == 1
    assert "meet at" not in sentences(check_rig(pinhole(*fan)), Severity.WARN)
    twice = sentences(check_rig(pinhole(*fan, replace(fan[1], name="twin"))), Severity.BAD)
    assert "Lasers '1' and 'twin' lie in one plane" in twice


def checked(path: Path) -> tuple[int, str]:
    page = io.StringIO()
    code = run_check(path, Console(file=page, width=120))
    return code, page.getvalue()


def test_command_on_a_sane_rig(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    save_rig(example_rig(), path)
    code, page = checked(path)
    assert code == 0
    assert "rig 'example'" in page
    assert "lower mm/px" in page
    assert "pixel noise" in page
    assert "No uncertainty is given for the set of intrinsics" in " ".join(page.split())
    assert "This rig is sane" in page
    # The verdict first, then what needs a hand, then what is well.
    assert page.index("This rig is sane") < page.index(" ok ")
    assert page.rfind(" warn ") < page.index(" ok ")


def test_command_on_a_bad_rig(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    save_rig(replace(pinhole(), name="[bold]odd"), path)
    code, page = checked(path)
    assert code == 2
    assert "rig '[bold]odd'" in page
    assert "cannot measure as it is: correct 1 fault." in page


def test_command_on_no_rig(tmp_path: Path) -> None:
    with pytest.raises(RigError, match="no such file"):
        run_check(tmp_path / "none.yaml")
