"""`aqualvs calibrate water`: the index of the water, from a target fixed on the vehicle."""

import glob
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from aqualvs.calibrate import common
from aqualvs.calibration.detection.detection import detect_markers
from aqualvs.calibration.targets.target_files import load_target
from aqualvs.calibration.targets.targets import MarkerSet, View
from aqualvs.calibration.water_index.estimator import N_WATER, WaterCalibration
from aqualvs.calibration.water_index.estimator import calibrate_water as solve_water
from aqualvs.calibration.water_index.state import IndexOptions, IndexPrior
from aqualvs.errors import CalibrationError, check_options
from aqualvs.optics.rig import Rig, merged
from aqualvs.optics.rigfile import check_rig_place, load_rig
from aqualvs.optics.solved import SolvedStep, rig_uncertainty, with_step, with_uncertainty
from aqualvs.optics.water import Dispersion, may_be_water
from aqualvs.report.calibration_material import (
    CalibrationPage,
    Series,
    expectations,
    facts,
    missed_rows,
)
from aqualvs.report.html import Card
from aqualvs.results.run_request import Water, check_fits
from aqualvs.sources import FrameSource, open_source
from aqualvs.sources.images import IMAGE_SUFFIXES, ImageSource
from aqualvs.terminal import Echo, progress
from aqualvs.text import count_text


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

    def __post_init__(self) -> None:
        """Raise `OptionError` for negative deviations."""
        check_options(self, "place_sigma_mm", "turn_sigma_deg", least=0.0, wanted="0 or more")


def calibrate_water(
    pictures: common.Pictures | FrameSource,
    target: MarkerSet | str | Path,
    rig: Rig | str | Path,
    *,
    prior: IndexPrior | None = None,
    options: IndexOptions | None = None,
) -> common.Calibration[WaterCalibration]:
    """Estimate the water's index from pictures of markers that are fixed to the vehicle.

    Parameters
    ----------
    pictures : iterable of str, Path or array, a str or Path, or FrameSource
        Files or pixels (grey, or blue, green, red), one folder or pattern, or an opened video; of
        the size that the rig's camera has. Frames of a source have times, by which changes of the
        index are tracked.
    target : MarkerSet, str or Path
        Markers in the dome's frame, or their file.
    rig : Rig, str or Path
        Rig with camera and dome, or its file.
    prior : IndexPrior, optional
        Prior of the index, such as `IndexPrior.seawater`.
    options : IndexOptions, optional
        Assumptions on how firmly the target is mounted, and on the water.

    Returns
    -------
    Calibration
        `solution` is a `WaterCalibration`.

    Raises
    ------
    AqualvsError
        If a file, a picture or its content cannot be used.
    """
    before = rig if isinstance(rig, Rig) else load_rig(rig, need_lasers=False)
    markers = target if isinstance(target, MarkerSet) else load_target(target)
    if not isinstance(pictures, FrameSource):
        found = common.detect_targets(
            pictures,
            lambda name, image: detect_markers(image, markers, name),
            common.path_text(target, "the target"),
        )
        common.check_same_size(before, found)
        times = None
    else:
        found, times = _found_in(pictures, markers, before, target)
    seen = solve_water(
        before,
        found.views,
        times,
        uncertainty=rig_uncertainty(before),
        prior=prior,
        options=options or IndexOptions(),
    )
    if not seen.observable and not any(reading.prior_used for reading in seen.readings):
        why = "; ".join(seen.remarks) or (
            "the lens is too near the centre of the dome; give --temperature-c and --salinity"
        )
        raise CalibrationError(f"the index is known to {seen.sigma:.2g} only: {why}")
    result = _in_light(seen, common.lasers_wavelength(before))
    return common.Calibration(
        rig=_solved_rig(before, result, seen),
        uncertainty=result.uncertainty,
        residuals_px=result.residuals,
        left_out={**found.missed, **{one.name: one.refused for one in result.readings if not one}},
        notes=(
            *found.notes,
            *_not_water(seen.rig),
            *result.remarks,
            *(step.text() for step in result.steps),
        ),
        solution=result,
        found=(found,),
    )


def _not_water(rig: Rig) -> list[str]:
    """Return a note if a rig's index, for green light, is that of neither water nor air."""
    if may_be_water(rig.n_water) or rig.is_air(rig.n_water):
        return []
    return [
        f"the index {rig.n_water:.4f} is not that of water, which has 1.330 to 1.345 for green "
        "light; is the target where target.yaml has it, and the lens where the rig file has it?"
    ]


def run_water(request: WaterRequest, echo: Echo) -> None:
    """Calibrate the water's index and write the rig in that water, and its report.

    Raises `AqualvsError` as `calibrate_water`, or if an output cannot be written.
    """
    check_rig_place(request.out)
    rig = load_rig(request.rig, need_lasers=False)
    water = Water(temperature_c=request.temperature_c, salinity=request.salinity).seawater
    prior = None if water is None else IndexPrior.seawater(*water, n_air=rig.n_air)
    with _source(request) as source:
        done = calibrate_water(
            source,
            request.target,
            rig,
            prior=prior,
            options=IndexOptions.of_target(request.place_sigma_mm, request.turn_sigma_deg),
        )
    result = done.solution
    pictures = count_text(len(result.readings), "picture")
    echo(f"index {result.n:.5f} ± {result.sigma:.5f} from {pictures}")
    for line in done.notes:
        echo(line)
    page = _page(done, prior, request)
    common.finish(done.rig, page, request.out, "water", echo, request.rig)


def _found_in(
    source: FrameSource, markers: MarkerSet, rig: Rig, target: object
) -> tuple[common.DetectedTargets, list[float]]:
    """Return the markers found in the frames of a source, and the times of those frames."""
    check_fits(source, rig)
    name = common.named(target, "the target")
    views, times, missed = [], [], {}
    with progress(f"looking for {name}", source.n_frames) as tick:
        for frame in source:
            image = np.ascontiguousarray(frame.luma)
            view = detect_markers(image, markers, f"frame {frame.index}")
            if isinstance(view, View):
                views.append(view)
                times.append(frame.time_s)
            else:
                missed[f"frame {frame.index}"] = view
            tick(1)
    if not views:
        raise CalibrationError(
            f"{common.path_text(target, 'the target')}: its markers are in no picture "
            f"of {source.name}; check its family and ids, and that the camera sees the target sharp"
        )
    return common.DetectedTargets(tuple(views), (), rig.size_px, missed), times


def _source(request: WaterRequest) -> FrameSource:
    """Open the pictures, the folder or the video of a request."""
    first = request.source[0]
    several = len(request.source) > 1 or glob.has_magic(first)
    # Pictures carry no times.
    default_fps = 25.0
    if several or Path(first).suffix.lower() in IMAGE_SUFFIXES:
        return ImageSource(common.picture_paths(request.source), fps=request.fps or default_fps)
    fps = request.fps or (default_fps if Path(first).is_dir() else None)
    return open_source(first, fps=fps)


def _in_light(seen: WaterCalibration, light_nm: float | None) -> WaterCalibration:
    """Return a result for green light with the index, and its sigma, for a wavelength in nm."""
    light = Dispersion.of(light_nm, seen.rig.n_air)
    if light.ratio == 1.0:
        return seen
    rig, uncertainty = common.in_lasers_light(seen.rig, seen.uncertainty, light)
    remark = (
        f"the target, seen in green or white light, gives {seen.n:.5f} ± {seen.sigma:.5f}; from "
        f"it follows the index for the lasers' {light_nm:g} nm, by the dispersion of water"
    )
    return replace(
        seen,
        rig=rig,
        uncertainty=uncertainty,
        sigma=uncertainty.sigmas[N_WATER],
        remarks=(remark, *seen.remarks),
    )


def _solved_rig(rig: Rig, result: WaterCalibration, seen: WaterCalibration) -> Rig:
    """Return the rig with a result; `seen` is that for the light in which the target is seen."""
    counted = [reading for reading in result.readings if reading]
    of_light = {} if result.n == seen.n else {"n_green": round(seen.n, 6)}
    step = SolvedStep(
        pictures=len(counted),
        points=sum(reading.n_points for reading in counted),
        rms_px=result.rms_px,
        extras={"n": round(result.n, 6), **of_light, "observable": result.observable},
    )
    uncertainty = merged(rig_uncertainty(rig), result.uncertainty)
    return with_uncertainty(with_step(result.rig, "water", step), uncertainty)


def _page(
    done: common.Calibration[WaterCalibration], prior: IndexPrior | None, request: WaterRequest
) -> CalibrationPage:
    rig, result = done.rig, done.solution
    counted = [reading for reading in result.readings if reading]
    times = np.array([reading.time for reading in counted])
    random = f"{result.sigma_random:.1e}"
    marks = tuple((step.time, f"{step.size:+.4f}") for step in result.steps)
    level = None if prior is None else (prior.source, prior.n)
    course = Series(
        title="Index of each picture, with its own noise",
        x_label="time, s",
        y_label="index",
        x=times,
        y=np.array([reading.n_frame for reading in counted]),
        sigma=np.array([reading.sigma_frame for reading in counted]),
        marks=marks,
    )
    return CalibrationPage(
        title="Calibration of the water",
        subtitle=f"Rig “{rig.name}”, {' '.join(request.source[:3])}",
        cards=(
            Card("index", f"{result.n:.5f}", f"± {result.sigma:.5f}"),
            Card("random part", random, "of this sigma; less with more pictures"),
            Card("pictures", str(len(counted)), f"{result.rms_px:.3f} px rms"),
        ),
        warnings=tuple(step.text() for step in result.steps),
        words=result.remarks,
        expectations=expectations(rig),
        series=(
            replace(
                course,
                title="Index, from all pictures so far",
                y=np.array([reading.n for reading in counted]),
                sigma=np.array([reading.sigma for reading in counted]),
                level=level,
            ),
            course,
        ),
        views=missed_rows({one.name: one.refused for one in result.readings if not one}),
        facts=facts(("rig before", str(request.rig)), ("target", str(request.target))),
    )
