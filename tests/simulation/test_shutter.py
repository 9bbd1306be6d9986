"""Pictures of a scene that moves while they are taken."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.errors import OptionError
from aqualvs.optics.expected_error import WallView
from aqualvs.optics.shutter import AT_ONCE, Shutter, ShutterKind
from aqualvs.scanner import Scanner
from aqualvs.scanning.scan import Frame, planes_of_image
from aqualvs.simulation.dive import check_shutter, shutter_from_words
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenario import dome_from_target
from aqualvs.simulation.scenarios import example_rig
from aqualvs.simulation.scene import CameraSensor, Scene, Wall

_HEIGHT = 144
_RANGE = 0.57
_RATES = np.array([0.2, np.deg2rad(15.0), np.deg2rad(-12.0)])
_ROLLING = Shutter(kind=ShutterKind.ROLLING, readout=0.02)
_FIELDS = Shutter(kind=ShutterKind.INTERLACED, readout=0.02)


def renderer(shutter):
    """The example rig at a quarter of its resolution, for speed."""
    rig = example_rig()
    lens = replace(rig.lens, fx=204.0, fy=219.5, cx=92.0, cy=70.5)
    return Renderer(replace(rig, size_px=(180, _HEIGHT), lens=lens, shutter=shutter))


def moving(t):
    pose = dome_from_target(*(np.array([_RANGE, 0.0, 0.0]) + _RATES * t))
    return Scene(dome_from_scene=pose, walls=(Wall(),), target="wall")


def difference(a, b):
    return np.abs(a.astype(int) - b.astype(int)).max()


@pytest.mark.parametrize("shutter", [_ROLLING, _FIELDS, replace(_ROLLING, exposure=0.008)])
def test_of_a_scene_that_stands_still_every_shutter_takes_the_same_picture(shutter):
    taken = renderer(shutter).take(lambda _: moving(0.0))
    still = renderer(AT_ONCE).render(moving(0.0))
    # The mean over an exposure rounds anew.
    assert difference(taken.image, still.image) <= (1 if shutter.exposure else 0)


def test_each_row_of_a_rolling_picture_is_that_of_its_own_time():
    eye = renderer(_ROLLING)
    taken = eye.take(moving, 3.0).image
    times = 3.0 + _ROLLING.row_times(np.arange(_HEIGHT), _HEIGHT)
    for row, other in ((10, 133), (133, 10)):
        own, wrong = (
            np.abs(taken[row].astype(int) - eye.render(moving(t), t).image[row]).mean()
            for t in (times[row], times[other])
        )
        # Some rows share an instant, an eighth of a millisecond away at most.
        assert own < 0.1
        assert wrong > 0.4


@pytest.mark.parametrize("first", ["top", "bottom"])
def test_each_field_of_an_interlaced_picture_is_a_picture_of_its_own_time(first):
    eye = renderer(replace(_FIELDS, first_field=first))
    taken = eye.take(moving, 3.0)
    row = 0 if first == "top" else 1
    for start, t in ((row, 2.99), (1 - row, 3.01)):
        assert np.array_equal(taken.image[start::2], eye.render(moving(t), t).image[start::2])
    middle = eye.lit_points(moving(3.0), 3.0)
    assert np.array_equal(taken.lit.points_in_dome, middle.points_in_dome)


def test_an_exposure_widens_a_stripe_and_leaves_its_middle():
    # Grey levels are linear in light and below full scale, so that their centroid is the light's.
    sensor = CameraSensor(gain=0.15, gamma=1.0)

    def nearing(t):
        pose = dome_from_target(_RANGE + 1.0 * t, 0.0, 0.0)
        walls = (Wall(contrast=0.0),)
        return Scene(dome_from_scene=pose, walls=walls, target="wall", sensor=sensor)

    def middle_and_width(exposure):
        eye = renderer(Shutter(exposure=exposure))
        eye = Renderer(replace(eye.rig, lasers=eye.rig.lasers[1:2]))
        dark = eye.render(replace(nearing(0.0), lasers_on=False)).image
        light = eye.take(nearing).image[50:90, :, 1] - dark[50:90, :, 1].astype(float)
        x = np.arange(light.shape[1])
        near = np.abs(x - light.argmax(axis=1)[:, None]) <= 6
        light = np.where(near, np.maximum(light, 0.0), 0.0)
        middle = (light * x).sum(axis=1) / light.sum(axis=1)
        square = (light * (x - middle[:, None]) ** 2).sum(axis=1) / light.sum(axis=1)
        return middle, np.sqrt(square.mean())

    sharp, narrow = middle_and_width(0.0)
    blurred, wide = middle_and_width(0.03)
    assert wide > 1.1 * narrow
    assert np.abs(blurred - sharp).mean() < 0.15


def test_a_rolling_picture_is_misread_as_the_rig_foretells():
    rig = replace(example_rig(), shutter=_ROLLING)
    image = Renderer(rig).take(moving, 0.0, np.random.default_rng(1)).image
    frame = Frame(0, 0.0, *planes_of_image(np.ascontiguousarray(image[:, :, ::-1])))
    found = Scanner(rig).process(frame).posture
    error = np.array([found.range - _RANGE, found.pitch, found.yaw])
    wall = WallView.ahead(rig, _RANGE)
    told = wall.by_rates(lambda rows: _ROLLING.row_times(rows, rig.size_px[1])) @ _RATES
    # The scanner weighs points otherwise; at once, it is 0.04 mm and 0.01 degrees off.
    assert np.all(np.abs(error - told) < [0.3e-3, np.deg2rad(0.04), np.deg2rad(0.04)])
    assert abs(told[1]) > np.deg2rad(0.5)


def test_words_name_a_shutter():
    assert shutter_from_words("rolling:20:8", 25.0) == replace(_ROLLING, exposure=0.008)
    assert shutter_from_words("interlaced:8", 25.0) == replace(_FIELDS, exposure=0.008)
    assert shutter_from_words("global", 25.0) == AT_ONCE


@pytest.mark.parametrize(
    "words", ["roll:20", "rolling", "rolling:x", "rolling:20:8:1", "interlaced:30", "rolling:nan"]
)
def test_words_that_name_no_shutter_are_refused(words):
    with pytest.raises(OptionError, match=r"^--shutter: .*write "):
        shutter_from_words(words, 25.0)


def test_a_picture_takes_no_longer_than_a_frame():
    check_shutter(_FIELDS, 25.0)
    with pytest.raises(OptionError, match="lower fps"):
        check_shutter(_ROLLING, 60.0)
