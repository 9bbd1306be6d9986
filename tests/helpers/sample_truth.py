"""Exact projections of the rendered samples' targets, by their true rig."""

import dataclasses
import json

import numpy as np

from aqualvs.geometry.transforms import SE3
from rig_from_sample_truth import load_truth


def _camera(lab, n_outside):
    rig = load_truth(lab / "truth" / "rig_truth.json")
    return dataclasses.replace(rig, n_water=n_outside).camera()


def _pose(rows):
    matrix = np.array(rows)
    return SE3(matrix[:3, :3], 1e-3 * matrix[:3, 3])


def _entry(lab, folder, name):
    entries = json.loads((lab / "truth" / f"{folder}.json").read_text())
    return next(entry for entry in entries if entry["file"] == name)


def board_projection(lab, folder, name):
    """Points in `board` to pixels, for a picture of a dome folder in air."""
    camera = _camera(lab, 1.0003)
    dome_from_board = _pose(_entry(lab, folder, name)["T_S_board"])
    return lambda points: camera.project(dome_from_board.apply(points))


def box_projection(lab, folder, name):
    """Points in `box` to pixels, for a picture of a box folder."""
    entry = _entry(lab, folder, name)
    camera = _camera(lab, entry["n_outside"])
    dome_from_box = _pose(entry["T_G_S"]).inverse()
    return lambda points: camera.project(dome_from_box.apply(points))


def index_projection(lab, clip):
    """Points in `dome` to pixels, for a clip of the index target."""
    entries = json.loads((lab / "truth" / "index.json").read_text())
    entry = next(entry for entry in entries if entry["clip"] == clip)
    return _camera(lab, entry["n_outside"]).project
