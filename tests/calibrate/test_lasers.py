"""Notes of the command on the box of markers."""

from types import SimpleNamespace

import numpy as np

from aqualvs.calibrate.lasers import _misplaced

MARKERS = np.array([10, 11, 12, 13])


def notes(pictures):
    """By the markers (indices) that each picture shows, and those whose corners it leaves out."""
    views, used = [], []
    for number, (shown, left_out) in enumerate(pictures):
        ids = (4 * np.array(shown)[:, None] + np.arange(4)).ravel()
        name, inside = f"view_{number}.png", ~np.isin(ids // 4, left_out)
        views.append(SimpleNamespace(view=SimpleNamespace(name=name, ids=ids)))
        # Some are left out by the pose of the picture alone, some by all pictures together.
        kept = inside | (np.arange(len(ids)) % 2 == 0)
        corners = SimpleNamespace(ids=ids[kept])
        used.append(SimpleNamespace(name=name, corners=corners, corner_inliers=inside[kept]))
    views.append(SimpleNamespace(view=SimpleNamespace(name="not used", ids=np.arange(16))))
    return _misplaced(MARKERS, views, SimpleNamespace(views=used))


def test_a_marker_that_most_pictures_leave_out_is_named():
    assert notes([([0, 1, 2], [1]), ([0, 1, 3], [1]), ([1, 2, 3], [])]) == [
        "marker 11: left out of 2 of 3 pictures, where it does not fit the others; check its place "
        "and number in the box's file"
    ]


def test_one_bad_picture_of_a_marker_is_no_fault_of_the_box():
    assert notes([([0, 1], [1]), ([0, 1], []), ([2, 3], [3])]) == []
