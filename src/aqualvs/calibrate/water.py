"""`aqualvs calibrate water`: the index of the water, from a target fixed on the vehicle."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aqualvs.calibrate.common import Tell, finish
from aqualvs.calibration.detection.detection import detect_markers
from aqualvs.calibration.targets.pose_files import picture_paths
from aqualvs.calibration.targets.target_files import load_target
from aqualvs.calibration.targets.targets import MarkerSet, View
from aqualvs.calibration.water_index.estimator import WaterCalibration
from aqualvs.calibration.water_index.estimator import calibrate_water as solve_water
from aqualvs.calibration.water_index.state import IndexOptions, IndexPrior
from aqualvs.errors import CalibrationError, OptionError
from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import check_rig_place, load_rig
from aqualvs.optics.solved import (
    SolvedStep,
    merged,
    rig_uncertainty,
    with_step,
    with_uncertainty,
)
from aqualvs.report.calibration_material import (
    CalibrationPage,
    Series,
    ViewRow,
    expectations,
    facts,
)
from aqualvs.report.html import Card
from aqualvs.results.run_request import check_fits
from aqualvs.sources import FrameSource, open_source
from aqualvs.sources.images import IMAGE_SUFFIXES, ImageSource
from aqualvs.terminal import Tick, progress

_FPS = 25.0


@dataclass(frozen=True, slots=True, kw_only=True)
class WaterRequest:
    """Request of `aqualvs calibrate water`, see its `--help`."""

    source: tuple[str, ...]
    target: Path
    rig: Path
    out: Path
    temperature_c: float | None
    salinity: float | None
    fps: float | None
    place_sigma_mm: float
    turn_sigma_deg: float


def calibrate_water(request: WaterRequest, tell: Tell) -> None:
    """Estimate the index and write the rig in that water, and its report.

    Raises
    ------
    AqualvsError
        If a file, a picture or its content cannot be used.
    """
    check_rig_place(request.out)
    rig = load_rig(request.rig, need_lasers=False)
    markers = load_target(request.target)
    prior = _prior(request, rig)
    with _source(request) as source:
        check_fits(source, rig)
        with progress(f"looking for {request.target.name}", source.n_frames) as tick:
            shots = list(_shots(source, markers, tick))
    if not shots:
        raise CalibrationError(
            f"{request.target}: its markers are in no picture of {' '.join(request.source[:3])}; "
            "check its family and ids, and that the camera sees the target sharp"
        )
    result = solve_water(
        rig,
        [view for _, view in shots],
        [time_s for time_s, _ in shots],
        uncertainty=rig_uncertainty(rig),
        prior=prior,
        options=IndexOptions.of_target(request.place_sigma_mm, request.turn_sigma_deg),
    )
    _check(result)
    solved = _noted(rig, result)
    tell(f"index {result.n:.5f} ± {result.sigma:.5f} from {len(shots)} pictures")
    for line in (*result.remarks, *(step.text() for step in result.steps)):
        tell(line)
    finish(
        solved,
        _page(solved, result, prior, request),
        request.out,
        "water",
        tell,
        comments_of=request.rig,
    )


def _check(result: WaterCalibration) -> None:
    if not result.observable and not any(reading.prior_used for reading in result.readings):
        raise CalibrationError(
            f"the index is known to {result.sigma:.2g} only: "
            f"{' '.join(result.remarks) or 'the lens is too near the centre of the dome'}; or give "
            "--temperature-c and --salinity"
        )


def _prior(request: WaterRequest, rig: Rig) -> IndexPrior | None:
    if request.temperature_c is None and request.salinity is None:
        return None
    if request.temperature_c is None or request.salinity is None:
        missing = "--salinity" if request.salinity is None else "--temperature-c"
        raise OptionError(f"{missing}: missing; the index of water needs both")
    return IndexPrior.seawater(request.temperature_c, request.salinity, n_air=rig.n_air)


def _source(request: WaterRequest) -> FrameSource:
    only = request.source[0]
    pictures = len(request.source) > 1 or Path(only).suffix.lower() in IMAGE_SUFFIXES
    if pictures or any(sign in only for sign in "*?["):
        return ImageSource(picture_paths(request.source), fps=request.fps or _FPS)
    fps = request.fps or (_FPS if Path(only).is_dir() else None)
    return open_source(only, fps=fps)


def _shots(source: FrameSource, markers: MarkerSet, tick: Tick) -> Iterator[tuple[float, View]]:
    for frame in source:
        found = detect_markers(np.ascontiguousarray(frame.luma), markers, f"frame {frame.index}")
        if isinstance(found, View):
            yield frame.time_s, found
        tick(1)


def _noted(rig: Rig, result: WaterCalibration) -> Rig:
    counted = [reading for reading in result.readings if reading]
    step = SolvedStep(
        pictures=len(counted),
        points=sum(reading.n_points for reading in counted),
        rms_px=result.rms_px,
        extras={"n": round(result.n, 6), "observable": result.observable},
    )
    uncertainty = merged(rig_uncertainty(rig), result.uncertainty)
    return with_uncertainty(with_step(result.rig, "water", step), uncertainty)


def _page(
    rig: Rig, result: WaterCalibration, prior: IndexPrior | None, request: WaterRequest
) -> CalibrationPage:
    counted = [reading for reading in result.readings if reading]
    times = np.array([reading.time for reading in counted])
    marks = tuple((step.time, f"{step.size:+.4f}") for step in result.steps)
    level = None if prior is None else (prior.source, prior.n)
    return CalibrationPage(
        title="Calibration of the water",
        subtitle=f"Rig “{rig.name}”, {' '.join(request.source[:3])}",
        cards=(
            Card("index", f"{result.n:.5f}", f"± {result.sigma:.5f}"),
            Card("changes seen", f"{result.sigma_random:.1e}", "what more pictures would lessen"),
            Card("pictures", str(len(counted)), f"{result.rms_px:.3f} px rms"),
        ),
        warnings=tuple(step.text() for step in result.steps),
        words=result.remarks,
        expectations=expectations(rig),
        series=(
            Series(
                title="Index, from all pictures so far",
                x_label="time, s",
                y_label="index",
                x=times,
                y=np.array([reading.n for reading in counted]),
                sigma=np.array([reading.sigma for reading in counted]),
                level=level,
                marks=marks,
            ),
            Series(
                title="Index of each picture, with its noise alone",
                x_label="time, s",
                y_label="index",
                x=times,
                y=np.array([reading.n_frame for reading in counted]),
                sigma=np.array([reading.sigma_frame for reading in counted]),
                marks=marks,
            ),
        ),
        views=tuple(
            ViewRow(
                name=reading.name,
                n_points=0,
                rms_px=float("nan"),
                remark=reading.refused,
                used=False,
            )
            for reading in result.readings
            if not reading
        ),
        facts=facts(("rig before", str(request.rig)), ("target", str(request.target))),
    )
