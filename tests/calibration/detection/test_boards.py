import numpy as np
import pytest

from aqualvs.calibration.detection.boards import misfits, nothing_known, predict
from target_cases import charuco

_AXES = np.array([[20.0, -3.0], [4.0, 18.0]])


def _plain(shape=(5, 6)):
    row, column = np.indices(shape)
    return np.stack([column, row], axis=-1) @ _AXES.T + [100.0, 50.0]


def test_neighbours_of_an_even_grid_predict_every_point_exactly():
    pixels = _plain()
    known = np.ones(pixels.shape[:2], dtype=bool)
    known[2, 3] = known[0, 0] = False
    corrupt = np.where(known[..., None], pixels, np.nan)
    found = predict(corrupt, known)
    assert found.valid.all()
    assert found.pixels == pytest.approx(pixels)
    assert np.allclose(found.axes, _AXES)


def test_nearer_neighbours_count_more():
    # Squares that grow to the right, as on a tilted board: the far neighbours mislead.
    pixels = _plain()
    pixels[..., 0] += 0.4 * np.arange(6.0) ** 2
    found = predict(pixels, np.ones(pixels.shape[:2], dtype=bool))
    # Equal weights would miss by 0.9 px in the middle, and a parabola bends by 0.4 px a square.
    assert np.abs(found.pixels - pixels)[2, 2:4].max() < 0.6


def test_a_line_of_neighbours_predicts_nothing():
    pixels = _plain()
    known = np.zeros(pixels.shape[:2], dtype=bool)
    known[2] = True
    found = predict(pixels, known)
    assert not found.valid.any()
    assert np.isnan(found.pixels).all()


def test_the_odd_one_out_is_told_from_its_neighbours():
    pixels = _plain()
    known = np.ones(pixels.shape[:2], dtype=bool)
    pixels[2, 2] += [8.0, 0.0]
    odd = misfits(pixels, known, predict(pixels, known), share=0.2)
    assert np.argwhere(odd).tolist() == [[2, 2]]
    assert not misfits(pixels, known, predict(pixels, known), share=0.6).any()


def test_nothing_known_has_the_boards_shape():
    grid = nothing_known(charuco((7, 5)))
    assert grid.known.shape == (4, 6)
    assert not grid.known.any()
