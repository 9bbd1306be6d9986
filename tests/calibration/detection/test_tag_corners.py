import cv2
import numpy as np
import pytest

from aqualvs.calibration.detection.boards import read_markers
from aqualvs.calibration.detection.detection import detect_markers
from aqualvs.calibration.detection.tag_corners import (
    N_UNKNOWNS,
    TagWindow,
    _coverage,
    marker_cells,
    refine_tags,
    tag_sums,
)
from aqualvs.calibration.targets.target_files import load_box, load_target
from aqualvs.calibration.targets.targets import View
from target_cases import homography, picture, seen, striped, tag_cells

_FAMILY = "DICT_APRILTAG_36h11"
_SIZE = (200, 180)
_SQUARE = np.array([[2.0, 2.0], [10.0, 2.0], [10.0, 10.0], [2.0, 10.0]])
_STEEP = [[40.3, 40.7], [120.2, 60.1], [118.6, 120.4], [42.9, 140.8]]
_PLAIN = [[50.6, 40.3], [130.1, 36.4], [136.8, 124.9], [46.2, 118.8]]


def _shot(corners, number=5, **options):
    cells = tag_cells(_FAMILY, number)
    h = homography(corners, cells.shape[::-1])
    return picture(cells, h, _SIZE, **options), seen(h, _SQUARE)


def _outward(pixels, truth):
    away = truth - truth.mean(axis=0)
    away /= np.linalg.norm(away, axis=1)[:, None]
    return np.sum((pixels - truth) * away, axis=1)


@pytest.mark.parametrize("corners", [_PLAIN, _STEEP])
@pytest.mark.parametrize("gamma", [1.0, 1.25, 2.2])
@pytest.mark.parametrize("blur", [0.6, 1.3])
def test_blur_and_gamma_do_not_pull_the_corners(corners, gamma, blur):
    image, truth = _shot(corners, gamma=gamma, blur=blur)
    found = read_markers(image, _FAMILY)
    assert found.ids.tolist() == [5]
    fit = refine_tags(image, found.ids, found.corners, _FAMILY)
    assert fit.valid.all()
    # The tone curve is a parabola, gamma 2.2 on dark ink is not quite: it may cost 0.05 px.
    assert abs(_outward(fit.pixels[0], truth).mean()) < 0.05
    assert np.abs(fit.pixels[0] - truth).max() < 0.1


def test_the_plain_contour_is_pulled():
    image, truth = _shot(_PLAIN, gamma=1.25, blur=1.0)
    found = read_markers(image, _FAMILY)
    # What the fit must undo; without it the test above would prove nothing.
    assert _outward(found.corners[0], truth).mean() < -0.3


def test_a_stripe_across_a_marker_does_not_pull_it():
    image, truth = _shot(_PLAIN)
    found = read_markers(image, _FAMILY)
    crossed = striped(image, (0.0, 70.0), (200.0, 100.0))
    fit = refine_tags(crossed, found.ids, found.corners, _FAMILY)
    assert np.count_nonzero(fit.valid) >= 3
    # Half of the marker is under the stripe or its foot, so noise counts for more.
    assert np.abs(fit.pixels[0] - truth)[fit.valid[0]].max() < 0.15


def test_a_marker_that_is_another_is_refused():
    image, truth = _shot(_PLAIN, number=5)
    fit = refine_tags(image, np.array([6]), truth[None], _FAMILY)
    assert not fit.valid.any()
    assert np.isnan(fit.pixels).all()


def test_a_flat_picture_is_refused():
    image = np.full((100, 100), 80, np.uint8)
    quads = np.array([[[20.0, 20.0], [80.0, 20.0], [80.0, 80.0], [20.0, 80.0]]])
    assert not refine_tags(image, np.array([5]), quads, _FAMILY).valid.any()


def test_noise_of_a_tenth_of_the_contrast_is_no_other_marker():
    image, truth = _shot(_PLAIN, noise=20.0, seed=3)
    fit = refine_tags(image, np.array([5]), truth[None], _FAMILY)
    assert fit.valid.all()
    assert np.abs(fit.pixels[0] - truth).max() < 5.0 * fit.sigma.max()


def test_the_sigma_of_a_corner_is_honest():
    scores = []
    for seed in range(16):
        image, truth = _shot(_PLAIN, noise=4.0, seed=seed)
        fit = refine_tags(image, np.array([5]), truth[None], _FAMILY)
        scores.append(((fit.pixels - truth) / fit.sigma[..., None])[0])
    # 128 coordinates: their spread is known to 6 %; neighbouring corners share an error.
    assert 0.75 < np.std(scores) < 1.35


def test_derivatives_are_those_of_the_grey_value():
    cells = marker_cells(_FAMILY, 5)
    unknowns = np.zeros(N_UNKNOWNS)
    # A marker without shear: the blur's correlation is left out of the derivatives.
    unknowns[:8] = [30.2, 31.4, 20.0, 0.0, 0.0, 18.0, 0.03, -0.02]
    unknowns[8:14] = [0.2, 0.0, -0.1, 0.1, 0.0, 0.2]
    unknowns[14:18] = [-0.2, 0.3, 30.0, 100.0]
    unknowns[18:] = [3.0, -2.0, 4.0, 5.0]
    image = np.zeros((64, 64), np.uint8)

    def sums(values):
        normal, gradient = np.zeros((N_UNKNOWNS, N_UNKNOWNS)), np.zeros(N_UNKNOWNS)
        residuals = np.zeros(image.shape)
        window = TagWindow(image, np.zeros(2), np.ones(image.shape), cells, 1.1, 1)
        tag_sums(window, values, normal, gradient, residuals, np.empty(N_UNKNOWNS))
        return normal, residuals

    normal, residuals = sums(unknowns)
    for i in range(N_UNKNOWNS):
        step = 1e-6 if i in (6, 7) else 1e-4
        move = step * np.eye(N_UNKNOWNS)[i]
        difference = (sums(unknowns - move)[1] - sums(unknowns + move)[1]) / (2.0 * step)
        # A pixel at the rim may leave the window with the step, and a little shear remains.
        difference = difference[np.isfinite(difference) & np.isfinite(residuals)]
        assert normal[i, i] == pytest.approx(np.sum(difference**2), rel=0.03)


@pytest.mark.samples
@pytest.mark.parametrize(
    ("folder", "name"),
    [("box", "view_01.png"), ("box_water", "view_02.png"), ("index/clip_2", "frame_004.png")],
)
def test_corners_of_the_samples_against_truth(samples, folder, name):
    from sample_truth import box_projection, index_projection

    lab = samples / "lab-paper"
    if folder.startswith("index"):
        markers = load_target(lab / "index" / "target.yaml")
        project = index_projection(lab, folder.split("/")[1])
    else:
        markers = load_box(lab / folder / "box.yaml")[0]
        project = box_projection(lab, folder, name)
    image = cv2.imread(str(lab / folder / name), cv2.IMREAD_GRAYSCALE)
    view = detect_markers(image, markers, name)
    assert isinstance(view, View)
    assert len(view) >= 20
    truth = project(view.points)[0]
    centres = project(markers.corners.mean(axis=1)[view.ids // 4])[0]
    away = truth - centres
    away /= np.linalg.norm(away, axis=1)[:, None]
    off = view.pixels - truth
    assert abs(np.mean(np.sum(off * away, axis=1))) < 0.05
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 0.15


@pytest.mark.parametrize("rho", [-0.5, 0.0, 0.4])
def test_the_blur_of_a_sheared_marker_is_integrated(rho):
    cells = marker_cells(_FAMILY, 5)
    sigma_u, sigma_v = 0.3, 0.4
    steps = np.linspace(-5.0, 5.0, 401)
    a, b = np.meshgrid(steps, steps)
    weight = np.exp(-0.5 * (a**2 + b**2))
    for u, v in [(1.0, 1.0), (0.0, 0.0), (3.2, 5.1), (6.0, 2.0), (4.4, 7.7)]:
        column = np.floor(u + sigma_u * a + 1.0).clip(0, 9).astype(int)
        row = np.floor(v + sigma_v * (rho * a + np.sqrt(1.0 - rho**2) * b) + 1.0).clip(0, 9)
        expected = np.sum(weight * cells[row.astype(int), column]) / np.sum(weight)
        # The series ends at the square of rho, the sum over steps has jaggies of 0.002.
        assert _coverage(cells, u, v, sigma_u, sigma_v, rho)[0] == pytest.approx(
            expected, abs=0.015
        )
