"""Simulated cameras: the colour of their lines is that of measured ones, and every step tells."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from aqualvs.errors import OptionError
from aqualvs.optics.water import GREEN_NM
from aqualvs.simulation.cameras import (
    CAMERAS,
    IDEAL,
    Development,
    Drift,
    SimulatedCamera,
    expose,
    simulated_camera,
    spread,
)
from aqualvs.simulation.lasers import ColourFilters, band_shares, default_sources
from aqualvs.simulation.scenario import dome_from_target
from aqualvs.simulation.scenarios import example_rig
from aqualvs.simulation.scene import CameraSensor, Scene, WaterOptics
from camera_cases import REAL, chroma, line_minus_background, wall_pictures

_STILL = WaterOptics(forward_scatter=0.0)
# No blur, noise, drift or automatic balance, and a tone curve that is a straight line.
_PLAIN = Development(
    defocus_px=0.0, flare=0.0, gains=(1.0, 1.0), white_balance=0.0, gamma=1.0, mosaic=False
)


def _flat(colour, size=(32, 48)):
    return np.tile(np.array(colour, np.float32), (*size, 1))


def _shoot(radiance, t=0.0, rng=None, filters=None, **options):
    camera = SimulatedCamera(
        name="test",
        filters=ColourFilters() if filters is None else filters,
        development=replace(_PLAIN, **options),
    )
    return camera.picture(radiance, _STILL, CameraSensor(), t, rng)


@pytest.mark.parametrize(
    ("name", "power", "bounds"),
    [
        # Per level of green, from the tables of real pictures. Webcam: between the photographs of
        # 15 lines on a wall (dR 2, dG 30, dB 21: dU 0, dV -14) and on a board in a bright room
        # (dR -29, dG 56, dB 27: dU 0, dV -40).
        (
            "webcam",
            0.5,
            {"R": (-0.52, 0.07), "B": (0.48, 0.70), "U": (-0.04, 0.04), "V": (-0.71, -0.44)},
        ),
        # Action: between a phone (60, 176, 154: dU 8, dV -56) and overexposed lines in the dark
        # (106, 152, 177: dU 20, dV -25); both were bright.
        (
            "action",
            6.0,
            {"R": (0.34, 0.70), "B": (0.85, 1.16), "U": (0.02, 0.13), "V": (-0.34, -0.16)},
        ),
        # Pal: lines under water, lamps off (71, 125, 84: dU -11, dV -23), by a third of it.
        (
            "pal",
            1.0,
            {"R": (0.42, 0.67), "B": (0.50, 0.80), "U": (-0.12, -0.05), "V": (-0.25, -0.14)},
        ),
    ],
)
def test_a_line_has_the_colour_of_measured_ones(name, power, bounds):
    added = line_minus_background(name, power)
    assert 25.0 < added[1] < 180.0
    u, v = chroma(added)
    found = {"R": added[0], "B": added[2], "U": u, "V": v}
    for part, (low, high) in bounds.items():
        assert low <= found[part] / added[1] <= high, (part, found, added)


def test_an_overexposed_core_is_white_in_a_green_halo():
    on, off, lit = wall_pictures("action", 30.0)
    core = on[lit[:, 1], lit[:, 0]]
    assert np.mean(core.min(axis=1) > 245.0) > 0.8
    # Just outside the stripe, where the lens has spread its light.
    wide = np.zeros(on.shape[:2], np.uint8)
    wide[on.min(axis=2) > 200.0] = 1
    around = (cv2.dilate(wide, np.ones((9, 9))) - cv2.dilate(wide, np.ones((5, 5)))) == 1
    halo = (on - off)[around].mean(axis=0)
    assert halo[1] > 15.0
    assert chroma(halo)[1] < -0.1 * halo[1]


def test_a_core_that_red_hardly_sees_is_cyan():
    on, _, lit = wall_pictures("webcam", 10.0)
    core = on[lit[:, 1], lit[:, 0]].mean(axis=0)
    assert core[1:].min() > 240.0
    assert core[0] < core[1] - 60.0


@pytest.mark.parametrize("name", REAL)
def test_other_wavelengths_have_their_own_colour(name):
    red, blue = (line_minus_background(name, 1.0, wavelength) for wavelength in (640.0, 445.0))
    # The table's red lines: dR 87, dG 9, dB 37, V up by 36; those of 445 nm raise U.
    assert red[0] > 15.0
    assert red[1] < 0.4 * red[0]
    assert chroma(red)[1] > 0.25 * red[0]
    assert blue[2] > 15.0
    assert chroma(blue)[0] > 0.25 * blue[2]


def test_the_ideal_camera_is_the_scene_s_sensor_and_nothing_else():
    rng = np.random.default_rng(0)
    radiance = rng.uniform(0.0, 2.0, (48, 64, 3)).astype(np.float32)
    water, sensor = WaterOptics(), CameraSensor()
    ours = IDEAL.picture(radiance, water, sensor, 3.0, np.random.default_rng(1))
    theirs = expose(spread(radiance, water, sensor), sensor, np.random.default_rng(1))
    assert np.array_equal(ours, theirs)
    assert IDEAL.filters.laser_colour(GREEN_NM).tolist() == [0.40, 1.0, 0.27]
    assert band_shares(GREEN_NM).tolist() == [0.0, 1.0, 0.0]
    assert IDEAL.still_quality is None
    scene = Scene(dome_from_scene=dome_from_target(0.5, 0.0, 0.0))
    assert IDEAL.light(scene) is scene


def test_daylight_keeps_its_colour_and_a_laser_does_not():
    filters = ColourFilters(at_green=(0.1, 1.0, 0.6), saturation=0.5)
    colour = (0.2, 0.5, 0.4)
    shown = _shoot(_flat(colour), filters=filters)
    # Half a grey level of rounding.
    assert np.allclose(shown[9, 9] / 255.0, colour, atol=0.5 / 255.0 + 1e-6)
    behind = _shoot(_flat(np.add(colour, 0.2 * filters.laser_colour(GREEN_NM))), filters=filters)
    change = (behind[9, 9].astype(float) - shown[9, 9]) / 255.0
    recorded = filters.correcting @ [0.1, 1.0, 0.6]
    assert np.allclose(change, 0.2 * recorded, atol=1.1 / 255.0)
    assert change[0] < -0.02


@pytest.mark.parametrize("name", REAL)
def test_light_far_above_full_scale_is_white(name):
    sky = _flat((0.1, 0.1, 0.1), (96, 96))
    sky[40:56, 40:56] = 60.0
    shown = simulated_camera(name).picture(sky, _STILL, CameraSensor())
    assert shown[48, 48].min() == 255


def test_exposure_follows_the_light_and_drifts():
    bright, dark = (_shoot(_flat([x] * 3), gains=(0.1, 8.0)).mean() for x in (0.6, 0.1))
    assert bright == pytest.approx(dark, abs=1.0)
    swing = Drift(swing=0.2, period_s=4.0)
    seen = [_shoot(_flat([0.4] * 3), t, exposure_drift=swing).mean() for t in (0.0, 1.0, 3.0, 4.0)]
    assert seen[1] > 1.1 * seen[0]
    assert seen[2] < 0.9 * seen[0]
    # The fast part has another period.
    assert seen[3] == pytest.approx(seen[0], rel=0.05)


def test_white_balance_takes_the_green_out_of_water_and_drifts():
    green = _flat((0.1, 0.4, 0.3))
    kept, half, grey = (_shoot(green, white_balance=share)[5, 5] for share in (0.0, 0.5, 1.0))
    assert np.ptp(kept) > np.ptp(half) > np.ptp(grey)
    assert np.ptp(grey) <= 1
    swing = Drift(swing=0.3, period_s=4.0)
    redder, greener = (_shoot(green, t, red_drift=swing)[5, 5].astype(int) for t in (1.0, 3.0))
    assert redder[0] - redder[1] > greener[0] - greener[1] + 10


def test_the_mosaic_leaves_even_colours_alone_and_colours_edges():
    shown = _shoot(_flat((0.2, 0.5, 0.4)), mosaic=True)
    assert np.allclose(shown / 255.0, (0.2, 0.5, 0.4), atol=0.6 / 255.0)
    edge = _flat((0.1, 0.1, 0.1))
    edge[:, 25:] = 0.8
    fringes = np.ptp(_shoot(edge, mosaic=True).astype(int), axis=2)
    assert fringes[:, 22:28].max() > 20
    assert fringes[4:-4, :20].max() <= 1


def test_sharpening_overshoots_to_both_sides_of_an_edge():
    edge = _flat((0.3, 0.3, 0.3))
    edge[:, 25:] = 0.6
    row = _shoot(edge, sharpening=0.8, sharpening_px=(1.2, 0.0))[16, :, 1] / 255.0
    assert row.max() > 0.64
    assert row.min() < 0.26
    across = edge.transpose(1, 0, 2).copy()
    column = _shoot(across, sharpening=0.8, sharpening_px=(1.2, 0.0))[:, 16, 1] / 255.0
    assert column.max() <= 0.61


def test_narrow_chroma_smears_colour_but_not_luma():
    edge = _flat((0.5, 0.3, 0.3))
    edge[:, 25:] = (0.3, 0.5, 0.3)
    shown = _shoot(edge, chroma_px=(3.0, 0.0))[16].astype(float)
    v = shown[:, 0] - shown @ [0.299, 0.587, 0.114]
    luma = shown @ [0.299, 0.587, 0.114]
    # Between two of its sixteenths and fourteen, the smear of sigma 3 px takes 7 px.
    assert 5 <= np.sum((v > v.min() + 0.125 * np.ptp(v)) & (v < v.max() - 0.125 * np.ptp(v))) <= 9
    assert np.abs(np.diff(luma)).max() > 0.8 * np.ptp(luma)


def test_noise_grows_with_the_light_and_with_the_gain():
    def noise(level, gain):
        shown = _shoot(
            _flat([level] * 3, (96, 96)),
            0.0,
            np.random.default_rng(2),
            gains=(gain, gain),
            read_noise=0.01,
            shot_noise=1e-3,
        )
        return float(shown[..., 1].std() / 255.0)

    # Variance: 1e-4 + 1e-3 * light, times the gain's square; the sample's own spread is 1 %.
    assert noise(0.1, 1.0) == pytest.approx(np.sqrt(2e-4), rel=0.05)
    assert noise(0.6, 1.0) == pytest.approx(np.sqrt(7e-4), rel=0.05)
    assert noise(0.1, 4.0) == pytest.approx(4.0 * np.sqrt(2e-4), rel=0.05)


def test_lamps_light_the_scene():
    scene = Scene(dome_from_scene=dome_from_target(0.5, 0.0, 0.0))
    lit = simulated_camera("action").light(scene)
    assert np.all(np.subtract(lit.water.ambient, scene.water.ambient) > 0.2)


@pytest.mark.parametrize(("stated", "taken"), [(None, GREEN_NM), (650.0, 650.0)])
def test_a_laser_may_tell_its_wavelength(stated, taken):
    rig = example_rig()
    lasers = (replace(rig.lasers[0], wavelength_nm=stated),)
    assert default_sources(replace(rig, lasers=lasers))[0].wavelength_nm == taken


def test_water_dims_a_wavelength_as_its_band():
    for wavelength, shares in [(640.0, [1, 0, 0]), (445.0, [0, 0, 1]), (576.0, [0.5, 0.5, 0])]:
        assert band_shares(wavelength).tolist() == pytest.approx(shares)


def test_an_unknown_camera_is_refused_with_the_known_ones():
    with pytest.raises(OptionError, match="ideal, webcam, action, pal"):
        simulated_camera("gopro")
    assert list(CAMERAS) == ["ideal", *REAL]
