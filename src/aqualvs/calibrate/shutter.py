"""`aqualvs calibrate shutter`: the readout of a rolling shutter, from a dive before a flat target.

Points that are computed as if all rows had been exposed at once do not lie on a plane while the
vehicle turns: a pitch rate bends the plane and a yaw rate twists it, in proportion to the readout.
The rates come from the neighbouring frames, as in a run. Two further warps are fitted with the
readout: the static one, such as errors of the rig, and the one by the change of range, which is
too slight to tell the readout by.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np

from aqualvs.calibrate.common import finish
from aqualvs.errors import CalibrationError, RigError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.rig import Rig
from aqualvs.optics.rig_covariance import posture_by_plane
from aqualvs.optics.rigfile import check_rig_place, load_rig
from aqualvs.optics.shutter import Shutter, ShutterKind
from aqualvs.report.calibration_material import CalibrationPage, Series, expectations, facts
from aqualvs.report.html import Card
from aqualvs.results.run_request import check_fits
from aqualvs.scanner import Scanner
from aqualvs.scanning.posture import Posture
from aqualvs.scanning.row_motion import REACH, motion_beside
from aqualvs.scanning.scan import Scan, ScanPoints
from aqualvs.sources import FrameSource, open_source
from aqualvs.terminal import Echo, progress

# Readout for which the scanner computes the influence of motion, in seconds. The influence is
# proportional to the readout and scaled afterwards, so any value will do.
_NOMINAL = 0.02
# Length in seconds of the parts of the dive whose scatter gives sigma: longer than errors of the
# picture are correlated while a vehicle swings, and than the window of frames that gives a rate.
_PART_S = 0.5
# Fewest parts: the variance of Student's distribution needs more than three.
_MIN_PARTS = 4
# Fewest frames with a posture.
_MIN_FRAMES = 50
# The lasers move with the camera: a stripe moves by the change of range and tilt alone, 50 px/s and
# less, and its width changes more by distance and brightness than by blur.
_EXPOSURE = "The exposure is not observable from stripes: the value in the rig file stays."


@dataclass(frozen=True, slots=True, kw_only=True)
class ShutterRequest:
    """Request of `aqualvs calibrate shutter`, see its `--help`."""

    source: str
    rig: Path
    out: Path
    fps: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class ShutterCalibration:
    """Readout of a shutter, estimated from a dive."""

    # As in `Shutter`, and its standard deviation, in seconds.
    readout: float
    sigma: float
    # Frames with a posture.
    n_frames: int
    # Shape (N,): mean time of each part of the dive, and its readout, in seconds.
    times: FloatArray
    parts: FloatArray

    @property
    def rolls(self) -> bool:
        """Whether the readout differs from zero by more than three sigmas."""
        return abs(self.readout) > 3.0 * self.sigma


class _Warp(NamedTuple):
    """Normal equations of one frame: right = matrix @ (static - readout * rates).

    The three components are range, pitch and yaw; residuals are divided by their noise.
    """

    i_scan: int  # Index of the frame's scan.
    time: float  # In seconds.
    matrix: FloatArray  # Shape (3, 3).
    right: FloatArray  # Shape (3,).


def calibrate_shutter(source: FrameSource, rig: Rig) -> ShutterCalibration:
    """Estimate the readout of a rolling shutter.

    In the dive the vehicle turns before a flat target; the rig's own readout is not used. Raises
    `CalibrationError` if the dive has too few postures, or too little motion, and `SourceError` if
    the pictures do not fit the rig, or cannot be read.
    """
    check_fits(source, rig)
    nominal = Shutter(kind=ShutterKind.ROLLING, readout=_NOMINAL)
    scanner = Scanner(replace(rig, shutter=nominal))
    scans: list[Scan] = []
    warps: list[_Warp] = []
    with progress(f"measuring {source.name}", source.n_frames) as tick:
        for frame in source:
            _, scan = scanner.scan(frame)
            equations = _warp(scan, rig.size_px[1])
            if equations is not None:
                warps.append(_Warp(len(scans), scan.time_s, *equations))
            # The points of a whole dive would not fit into memory.
            scans.append(replace(scan, points=ScanPoints.none()))
            tick(1)
    if len(warps) < _MIN_FRAMES:
        raise CalibrationError(
            f"{source.name}: a posture in {len(warps)} frames only; give a dive of 20 s before a "
            f"wall, at least {_MIN_FRAMES} frames"
        )
    found = _solve(scans, warps)
    # Largest useful sigma, in seconds: 5 % of a usual readout.
    max_sigma = 1e-3
    if not found.sigma <= max_sigma:
        raise CalibrationError(
            f"{source.name}: the readout is not observable, its sigma is {1e3 * found.sigma:.2g} "
            "ms; swing the vehicle in pitch and yaw before a wall, 10 degrees and more to each "
            "side, for 20 s"
        )
    return found


def run_shutter(request: ShutterRequest, echo: Echo) -> None:
    """Calibrate the shutter and write the rig with it, and its report.

    Raises `AqualvsError` as `calibrate_shutter`, or if the rig cannot be used or an output cannot
    be written.
    """
    check_rig_place(request.out)
    rig = load_rig(request.rig)
    if rig.shutter.is_interlaced:
        raise RigError(
            f"{request.rig}: camera.shutter.kind is interlaced, and the video standard fixes the "
            "time between its fields; leave the shutter out to calibrate a rolling one"
        )
    with open_source(request.source, fps=request.fps) as source:
        found = calibrate_shutter(source, rig)
    shutter = Shutter(exposure=rig.shutter.exposure)
    sentence = "All rows are exposed at once, as far as this dive shows."
    if found.rolls:
        shutter = replace(shutter, kind=ShutterKind.ROLLING, readout=round(found.readout, 5))
        order = "first row to the last" if found.readout > 0.0 else "last row to the first"
        sentence = f"The shutter rolls from the {order}."
    echo(f"readout {_text(found)} from {found.n_frames} frames")
    echo(sentence)
    echo(_EXPOSURE)
    note = {
        "date": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "frames": found.n_frames,
        "readout_ms": round(1e3 * found.readout, 3),
        "sigma_ms": round(1e3 * found.sigma, 3),
    }
    solved = replace(rig, shutter=shutter, solved_from={**rig.solved_from, "shutter": note})
    page = CalibrationPage(
        title="Calibration of the shutter",
        subtitle=f"Rig “{rig.name}”, {request.source}",
        cards=(Card("readout", _text(found), f"{found.n_frames} frames"),),
        words=(sentence, _EXPOSURE),
        expectations=expectations(solved),
        series=(
            Series(
                title="Readout of parts of the dive",
                x_label="time, s",
                y_label="readout, ms",
                x=found.times,
                y=1e3 * found.parts,
                level=("all", 1e3 * found.readout),
            ),
        ),
        facts=facts(("rig before", str(request.rig))),
    )
    finish(solved, page, request.out, "shutter", echo, request.rig)


def _text(found: ShutterCalibration) -> str:
    return f"{1e3 * found.readout:.2f} ± {1e3 * found.sigma:.2f} ms"


def _warp(scan: Scan, height: int) -> tuple[FloatArray, FloatArray] | None:
    """Return the normal equations of a frame's warp; None without a posture or noise.

    `height` is the number of rows of the picture.
    """
    posture, points = scan.posture, scan.points
    if not isinstance(posture, Posture) or posture.by_motion is None or not points.used.any():
        return None
    seen = points.points_in_dome[points.used]
    # The plane is m·X = 1.
    m = posture.normal_in_dome / posture.range
    by_m = posture_by_plane(m)
    sigma = points.sigma[points.used] * np.linalg.norm(m)
    # Time of each row from the middle of the readout, as a share of the readout.
    shares = (points.pixels[points.used, 1] + 0.5) / height - 0.5
    # Residuals of m·X, and their derivatives by the rates, for a readout of one second.
    both = np.column_stack([seen @ m - 1.0, (seen * shares[:, None]) @ np.linalg.inv(by_m)])
    both, seen = both / sigma[:, None], seen / sigma[:, None]
    # Remove the component that another plane explains: it does not depend on the readout.
    both -= seen @ np.linalg.lstsq(seen, both)[0]
    noise = 1.4826 * float(np.median(np.abs(both[:, 0])))
    if not noise > 0.0:
        return None
    sums = both.T @ both / noise**2
    return sums[1:, 1:], sums[1:, 0]


def _solve(scans: Sequence[Scan], warps: Sequence[_Warp]) -> ShutterCalibration:
    """Return the readout that explains the warps, with a sigma from the parts of the dive."""
    readout = 0.0
    # Rates depend on the readout; each iteration reduces the error by a factor of ten or more.
    rounds = 6
    for _ in range(rounds):
        equations = list(_equations(scans, warps, readout))
        matrices = np.array([matrix for matrix, _ in equations])
        rights = np.array([right for _, right in equations])
        inverse = np.linalg.pinv(matrices.sum(axis=0))
        readout = float(np.clip(inverse[0] @ rights.sum(axis=0), -1.0, 1.0))
    times = np.array([warp.time for warp in warps])
    n_parts = max(round(float(np.ptp(times)) / _PART_S), _MIN_PARTS)
    share = np.arange(len(warps)) * n_parts // len(warps)
    # Jackknife: the readout without each of the parts (Efron and Stein 1981).
    left = [share != part for part in range(n_parts)]
    without = np.array(
        [np.linalg.pinv(matrices[one].sum(axis=0))[0] @ rights[one].sum(axis=0) for one in left]
    )
    # The variance of Student's distribution: the scatter of few parts is itself uncertain.
    variance = float((n_parts - 1) * np.var(without)) * (n_parts - 1) / (n_parts - 3)
    return ShutterCalibration(
        readout=readout,
        # Without motion, the noise of the rates passes for motion, and parts may agree by chance:
        # sigma is at least that of the least squares.
        sigma=float(np.sqrt(max(variance, inverse[0, 0]))),
        n_frames=len(warps),
        times=np.array([times[share == part].mean() for part in range(n_parts)]),
        parts=n_parts * without.mean() - (n_parts - 1) * without,
    )


def _equations(
    scans: Sequence[Scan], warps: Sequence[_Warp], readout: float
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield the normal equations (5, 5) and (5,) of each frame, with rates for a readout.

    The unknowns are the readout, the warp by the change of range, and the static warp (3).
    """
    scaled = [_with_readout(scan, readout) for scan in scans]
    for warp in warps:
        i = warp.i_scan
        beside = [*scaled[max(i - REACH, 0) : i], *scaled[i + 1 : i + 1 + REACH]]
        motion, _ = motion_beside(scaled[i], beside)
        of_range, of_pitch, of_yaw = motion[:3].tolist()
        moved = [[0.0, -of_pitch, -of_yaw], [-of_range, 0.0, 0.0]]
        terms = np.column_stack([*moved, np.eye(3)])
        yield terms.T @ warp.matrix @ terms, terms.T @ warp.right


def _with_readout(scan: Scan, readout: float) -> Scan:
    """Return the scan with the influence of motion scaled from `_NOMINAL` to a readout."""
    posture = scan.posture
    if not isinstance(posture, Posture) or posture.by_motion is None:
        return scan
    share = readout / _NOMINAL
    by_motion = posture.by_motion * np.repeat([share, share**2], 3)
    return replace(scan, posture=replace(posture, by_motion=by_motion))
