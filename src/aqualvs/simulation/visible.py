"""Which points of the stripes a picture truly shows, whoever looks for them."""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.simulation.lit_points import LitPoints
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scene import Scene
from aqualvs.simulation.sensor import expose, spread

CONTRAST_LIMIT = 10.0
"""Grey levels by which a visible stripe point is brighter than without its stripe."""

VISIBLE_LIMIT = 40
"""Visible stripe points from which on a frame can be expected to be measured."""

# A stripe is narrower than this share of the picture's width; the glow of the sheets is wider.
_WIDEST_STRIPE = 1 / 36
_LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)
_BEYOND = 1e6


def stripe_contrast(
    renderer: Renderer, scene: Scene, t: float, radiance: NDArray[np.float32], lit: LitPoints
) -> NDArray[np.float32]:
    """Return by how many grey levels the stripes lift the pixels around them.

    Parameters
    ----------
    renderer : Renderer
        What the scene is rendered with.
    scene : Scene
        With its lasers on.
    t : float
        Time in seconds.
    radiance : float32 array, shape (height, width, 3)
        Of that scene at that time, from `Renderer.radiance`.
    lit : LitPoints
        Of that scene at that time.

    Returns
    -------
    contrast : float32 array, shape (height, width)
        What the lasers add to the luma (ITU-R BT.601) of the picture without noise, above what
        they add on the lighter side of it, left and right or above and below, whichever is more
        (a morphological opening). The glow of the sheets in the water shows no stripe, and neither
        does a place that daylight saturates. Zero away from lit points.
    """
    height, width = radiance.shape[:2]
    size = 2 * round(0.5 * _WIDEST_STRIPE * width) + 1
    around = _around(lit, (height, width), 2 * size + 1)
    dark = renderer.radiance(replace(scene, lasers_on=False), t, around)
    dark[~around] = radiance[~around]
    images = (
        expose(spread(x, scene.water, scene.sensor), scene.sensor, None) for x in (radiance, dark)
    )
    bright_luma, dark_luma = (image.astype(np.float32) @ _LUMA for image in images)
    lift = bright_luma - dark_luma
    across = [_above_flanks(lift, around, window) for window in _windows(size)]
    return np.where(around, np.maximum(*across), 0.0).astype(np.float32)


def _windows(size: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    return np.ones((1, size), np.uint8), np.ones((size, 1), np.uint8)


def _above_flanks(
    lift: FloatArray, around: BoolArray, window: NDArray[np.uint8]
) -> NDArray[np.float64]:
    """Return how far a picture stands above its opening by a window, where it is known."""
    low = cv2.erode(np.where(around, lift, _BEYOND), window)
    opened = cv2.dilate(np.where(around, low, -_BEYOND), window)
    return np.asarray(lift - opened, dtype=np.float64)


def visible_points(lit: LitPoints, label: int, contrast: NDArray[np.float32]) -> IntArray:
    """Return which lit points are visible stripe points of a target.

    A stripe has one point in every pixel along it: in every column where it is rather level, in
    every row where it is rather upright. A point is visible where the contrast at its pixel, or
    at one beside it, reaches `CONTRAST_LIMIT`.

    Parameters
    ----------
    lit : LitPoints
        Of the frame.
    label : int
        `Label` of the target.
    contrast : array, shape (height, width)
        From `stripe_contrast`.

    Returns
    -------
    i_points : int array, shape (N,)
        Indices into `lit`, ordered by laser.
    """
    bright = np.asarray(cv2.dilate(contrast, np.ones((3, 3), np.uint8)))
    x, y = _places(lit.pixels, contrast.shape).T
    seen: BoolArray = (lit.label == label) & (bright[y, x] >= CONTRAST_LIMIT)
    chosen = [
        _one_a_pixel(np.flatnonzero(seen & (lit.laser == k)), lit.pixels)
        for k in np.unique(lit.laser)
    ]
    return np.concatenate([np.empty(0, np.int64), *chosen])


def _around(lit: LitPoints, shape: tuple[int, int], size: int) -> BoolArray:
    """Return the pixels within half of `size` of lit points."""
    marked = np.zeros(shape, np.uint8)
    x, y = _places(lit.pixels, shape).T
    marked[y, x] = 1
    return np.asarray(cv2.dilate(marked, np.ones((size, size), np.uint8)) > 0)


def _places(pixels: FloatArray, shape: tuple[int, ...]) -> IntArray:
    """Return the pixels (x, y) that exact places lie in, within an image of a shape."""
    return np.rint(pixels).astype(np.int64).clip(0, [shape[1] - 1, shape[0] - 1])


def _one_a_pixel(points: IntArray, pixels: FloatArray) -> IntArray:
    """Return the first of the points in every column, or in every row if these are more."""
    places = np.rint(pixels[points]).astype(np.int64)
    firsts = [np.unique(places[:, axis], return_index=True)[1] for axis in (0, 1)]
    return np.asarray(points[np.sort(max(firsts, key=len))], dtype=np.int64)
