"""The index of water against published values."""

import numpy as np
import pytest

from aqualvs.errors import OptionError
from aqualvs.optics.water import (
    N_AIR,
    Dispersion,
    index_in_seawater,
    seawater_index,
    seawater_index_slopes,
    seawater_index_vacuum,
)

SODIUM_NM = 589.3


@pytest.mark.parametrize(
    ("temperature_c", "salinity_permille", "wavelength_nm", "published"),
    [
        # Pure water, sodium D line, relative to air: CRC Handbook of Chemistry and Physics.
        (0.0, 0.0, SODIUM_NM, 1.33395),
        (10.0, 0.0, SODIUM_NM, 1.33369),
        (20.0, 0.0, SODIUM_NM, 1.33299),
        (30.0, 0.0, SODIUM_NM, 1.33192),
        # Seawater of 35 per mille: Austin and Halikas (1976), as quoted with the equation.
        (20.0, 35.0, SODIUM_NM, 1.33940),
        # Limits of Austin and Halikas at 532 nm.
        (0.0, 35.0, 532.0, 1.3430),
        (30.0, 35.0, 532.0, 1.3403),
        (0.0, 0.0, 532.0, 1.3360),
        (30.0, 0.0, 532.0, 1.3340),
    ],
)
def test_meets_published_values(
    temperature_c: float, salinity_permille: float, wavelength_nm: float, published: float
) -> None:
    index = seawater_index(temperature_c, salinity_permille, wavelength_nm)
    # The equation's own standard deviation is 1.5e-5; the table rounds to 1e-4 or 1e-5.
    assert float(index) == pytest.approx(published, abs=6e-5)


def test_vacuum_index_carries_air() -> None:
    assert float(seawater_index_vacuum(12.0, 33.0) / seawater_index(12.0, 33.0)) == pytest.approx(
        N_AIR, rel=1e-15
    )
    assert float(seawater_index_vacuum(12.0, 33.0, n_air=1.0)) == float(seawater_index(12.0, 33.0))


def test_slopes_are_the_derivatives() -> None:
    t, s, w = np.meshgrid([1.0, 14.0, 29.0], [1.0, 20.0, 39.0], [410.0, 532.0, 690.0])
    slopes = seawater_index_slopes(t, s, w)
    h = 1e-2
    by_t = (seawater_index(t + h, s, w) - seawater_index(t - h, s, w)) / (2 * h)
    by_s = (seawater_index(t, s + h, w) - seawater_index(t, s - h, w)) / (2 * h)
    # Rounding 2e-16 / 1e-2.
    np.testing.assert_allclose(slopes.by_temperature, by_t, rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(slopes.by_salinity, by_s, rtol=0.0, atol=1e-13)


def test_colder_saltier_and_bluer_water_bends_more() -> None:
    assert (np.diff(seawater_index(np.linspace(0, 30, 31), 35.0)) < 0.0).all()
    assert (np.diff(seawater_index(10.0, np.linspace(0, 40, 41))) > 0.0).all()
    assert (np.diff(seawater_index(10.0, 35.0, np.linspace(400, 700, 61))) < 0.0).all()


@pytest.mark.parametrize("light_nm", [405.0, 450.0, 520.0, 640.0, 780.0])
def test_the_index_for_one_colour_gives_that_for_another_in_any_water(light_nm: float) -> None:
    light = Dispersion.of(light_nm)
    for t, s in ((0.0, 0.0), (8.0, 34.0), (30.0, 0.0), (30.0, 40.0)):
        green, own = (index_in_seawater(t, s, nm, N_AIR) for nm in (None, light_nm))
        assert abs(light.from_green(green) - own) < min(light.sigma(green, 0.0), 1e-4)
        assert light.to_green(light.from_green(green)) == pytest.approx(green, abs=1e-15)
    # The colour in which a target is seen is known to 5 nm, or 2e-4 of the index.
    assert 1.5e-4 < light.sigma(1.34, 0.0) < 3e-4
    assert light.sigma(1.34, 1e-3) > light.ratio * 1e-3


@pytest.mark.parametrize("light_nm", [None, 532.0])
def test_green_light_needs_no_conversion_and_air_has_no_dispersion(light_nm: float | None) -> None:
    assert Dispersion.of(light_nm) == (1.0, 0.0, N_AIR)
    red = Dispersion.of(640.0, 1.0002)
    assert red.from_green(1.0002) == 1.0002
    assert red.sigma(1.0002, 0.0) == 0.0


def test_arguments_broadcast() -> None:
    assert seawater_index([0.0, 10.0, 20.0], 35.0).shape == (3,)
    assert seawater_index([[0.0], [10.0]], [0.0, 20.0, 35.0]).shape == (2, 3)
    assert seawater_index_slopes([0.0, 10.0], 35.0).by_salinity.shape == (2,)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((30.5, 35.0, 532.0), "water temperature 30.5 °C is outside 0 to 30 °C"),
        ((-1.0, 35.0, 532.0), "water temperature -1"),
        ((10.0, 41.0, 532.0), "salinity 41 per mille is outside 0 to 40"),
        ((10.0, 35.0, 1064.0), "wavelength 1064 nm is outside 400 to 700"),
        ((float("nan"), 35.0, 532.0), "water temperature nan"),
        (([10.0, 99.0], 35.0, 532.0), "water temperature 99"),
    ],
)
def test_outside_the_fitted_range_is_refused(arguments: tuple[float, ...], words: str) -> None:
    with pytest.raises(OptionError, match=words):
        seawater_index(*arguments)
