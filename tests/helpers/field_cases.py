"""Interlaced videos woven from the pictures of the bundled dive."""

from dataclasses import replace
from fractions import Fraction

import av
import numpy as np

from aqualvs.optics.rigfile import load_rig, save_rig
from aqualvs.optics.shutter import FIRST_ROW, Shutter, ShutterKind
from batch_cases import DEMO

FIELDS = Shutter(kind=ShutterKind.INTERLACED, readout=0.04)
"""Two pictures of the bundled dive, 40 ms apart, make one of 12.5 a second."""


def interlaced_rig(path, shutter=FIELDS):
    """Write the rig of the bundled dive with another shutter."""
    save_rig(replace(load_rig(DEMO / "rig.yaml"), shutter=shutter), path)
    return path


def woven_dive(path, n_pictures=12, group=3, *, shutter=FIELDS, coded=True):
    """Weave the dive's pictures in pairs, so that field n is every other row of picture n.

    Chroma is that of the fields; `coded` says so in the stream. Otherwise it is mixed, as a
    converter makes it that takes the picture for progressive.
    """
    fields = "tff=1" if shutter.first_field == "top" else "bff=1"
    options = {"preset": "ultrafast", "g": str(group), "sc_threshold": "0", "crf": "16"}
    if coded:
        options |= {"flags": "+ilme+ildct", "x264-params": fields}
    with av.open(str(DEMO / "dive.mp4")) as old, av.open(str(path), "w") as new:
        stream = new.add_stream("libx264", rate=Fraction(25, 2))
        stream.width, stream.height, stream.pix_fmt = 720, 576, "yuv420p"
        stream.options = options
        pictures = old.decode(video=0)
        for i in range(n_pictures):
            pair = [next(pictures).to_ndarray() for _ in range(2)]
            both = av.VideoFrame.from_ndarray(woven(*pair, shutter, mixed=not coded), "yuv420p")
            both.pts, both.time_base = i, Fraction(2, 25)
            new.mux(stream.encode(both))
        new.mux(stream.encode(None))
    return path


def woven(early, late, shutter=FIELDS, *, mixed=False):
    """Weave two 4:2:0 pictures (864, 720) as PyAV stacks them."""
    both, height = early.copy(), len(early) * 2 // 3
    other = 1 - FIRST_ROW[shutter.first_field]
    both[:height][other::2] = late[:height][other::2]
    mine, its = (one[height:].reshape(2, height // 2, -1) for one in (both, late))
    if mixed:
        mine[:] = ((mine.astype(np.uint16) + its + 1) // 2).astype(np.uint8)
    else:
        mine[:, other::2] = its[:, other::2]
    return both
