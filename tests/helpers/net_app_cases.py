"""Stretches, holes and dives along a net, made by hand for the tests of `aqualvs net`."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from aqualvs.nets.condition import NetStretch
from aqualvs.nets.coverage import Twine
from aqualvs.nets.holes import Hole
from aqualvs.nets.lattice import NetLattice
from aqualvs.nets.places import DivePostures
from aqualvs.nets.spectrum import Mesh
from aqualvs.results.folder import NET_MAP_PNG, NET_MAP_SVG
from aqualvs.vehicle_logs import Interpolation, Signal, VehicleLog

STRETCH_S = 2.5
"""Length of the stretches made here."""


def leave_maps_blank(patch: pytest.MonkeyPatch) -> None:
    """Have the files of a net written with a white map: drawing it takes most of their time."""
    blank = {
        NET_MAP_PNG: cv2.imencode(".png", np.full((2, 2), 255, np.uint8))[1].tobytes(),
        NET_MAP_SVG: b'<svg xmlns="http://www.w3.org/2000/svg"/>',
    }

    def draw(_wall: object, paths: list[Path]) -> bool:
        for path in paths:
            path.write_bytes(blank[path.name])
        return True

    patch.setattr("aqualvs.nets.map.draw_map", draw)


def lattice(bar=0.025):
    return NetLattice(
        mesh=Mesh.FOUR_SIDED, bar=bar, sigma_bar=2e-4, waves=np.eye(2) / bar, score=3.0
    )


def twine(thickness=0.0025):
    return Twine(
        thickness=thickness, sigma=4e-4, body=2.4e-3, sheet=3e-3, halo=7e-4, sigma_halo=2e-4
    )


def stretch(i, place, piece=0, *, begin=(0.0, 0.0), solidity=0.25, seen=True, distance=0.5):
    """The stretch number `i`, which ends at a place (right, up) of a piece of track."""
    return NetStretch(
        first_frame=int(25 * STRETCH_S * i),
        last_frame=int(25 * STRETCH_S * (i + 1)) - 1,
        begin_s=STRETCH_S * i,
        end_s=STRETCH_S * (i + 1),
        n_frames=62,
        range=distance,
        begin_place=np.asarray(begin, float),
        place=np.asarray(place, float),
        piece=piece,
        lattice=lattice() if seen else None,
        twine=twine() if seen else None,
        solidity=solidity if seen else None,
        sigma_solidity=0.02 if seen and solidity is not None else None,
        n_strands=17.0,
        seen_length=40.0,
    )


def hole(time_s, place, piece=0, size=0.1, from_foot=(0.0, 0.0)):
    return Hole(
        piece=piece,
        place=np.asarray(place, float),
        extent=(size, 0.8 * size),
        diameter=0.9 * size,
        sigma_diameter=0.012,
        missing_meshes=10.0,
        frame=int(25 * time_s),
        time_s=time_s,
        from_foot=np.asarray(from_foot, float),
        n_looks=5,
    )


def postures(duration_s, *, distance=0.5, pitch=0.0, yaw=0.0, rate=10.0):
    """A steady posture over a dive; angles in radians, numbers or functions of time."""
    t = np.arange(0.0, duration_s, 1.0 / rate)

    def over_time(value):
        return value(t) if callable(value) else np.full(len(t), float(value))

    return DivePostures(t, over_time(distance), over_time(pitch), over_time(yaw))


def vehicle_log(duration_s, *, depth=None, heading=None, roll=None, pitch=None, rate=5.0):
    """A log of functions of time, SI units and radians."""
    t = np.arange(-5.0, duration_s + 5.0, 1.0 / rate)

    def signal(function, kind):
        return None if function is None else Signal.from_samples(t, function(t), kind)

    return VehicleLog(
        name="vehicle.csv",
        kind="csv",
        depth=signal(depth, Interpolation.LINEAR),
        heading=signal(heading, Interpolation.BEARING),
        roll=signal(roll, Interpolation.ANGLE),
        pitch=signal(pitch, Interpolation.ANGLE),
    )
