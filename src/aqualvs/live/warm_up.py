"""Making a scanner ready, so that the first frame of a stream does not wait for it."""

import cv2
import numpy as np

from aqualvs.optics.rig import Rig
from aqualvs.optics.sheet import sheets_of
from aqualvs.optics.stripe_view import see_stripe
from aqualvs.scanning.pipeline import Scanner
from aqualvs.scanning.scan import Frame, Scan

_GREY, _LIGHT, _THICK_PX, _BLUR_PX = 30, 150, 3, 1.2
_ROUNDS = 2


def warm_up(scanner: Scanner) -> Scan:
    """Let a scanner measure made-up pictures, which loads its compiled kernels.

    Returns
    -------
    scan : Scan
        Of a wall in the middle of the working range, square to the vehicle.
    """
    frame = wall_frame(scanner.rig)
    for _ in range(_ROUNDS):
        scan = scanner.process(frame)
    return scan


def wall_frame(rig: Rig) -> Frame:
    """Return a picture of the stripes on a wall in the middle of the working range."""
    camera = rig.camera()
    width, height = rig.size_px
    luma = np.full((height, width), _GREY, np.uint8)
    for sheet in sheets_of(rig):
        stripe = see_stripe(camera, sheet, 0.5 * sum(rig.working_range))
        # OpenCV takes fixed-point coordinates, here in 1/16 px.
        pixels = np.rint(16.0 * stripe.pixels).astype(np.int32)
        cv2.polylines(luma, [pixels], False, _LIGHT, _THICK_PX, cv2.LINE_AA, shift=4)
    luma = np.asarray(cv2.GaussianBlur(luma, (0, 0), _BLUR_PX), np.uint8)
    half = (-(-width // 2), -(-height // 2))
    lit = cv2.resize(luma, half, interpolation=cv2.INTER_AREA).astype(np.float64) - _GREY
    u = np.clip(120.0 - 0.4 * lit, 0.0, 255.0).astype(np.uint8)
    return Frame(0, 0.0, luma, (u, np.full_like(u, 110)))
