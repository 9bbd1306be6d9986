"""Calibration records of a rig: date, data and residuals of each step, and the uncertainty.

They are kept in `Rig.solved_from`, and so in the rig file, in millimetres and degrees
(docs/rig.md)::

    solved_from:
      dome: {date: '2026-05-04T09:30:00Z', pictures: 14, points: 3040, rms_px: 0.09}
      uncertainty:
        parameters: [lens_x_mm, rotation_x_deg, n_acrylic, fx_px, k1, 'left:tilt_1_deg', ...]
        sigma: [0.012, 0.0031, ...]
        correlation:            # below the diagonal: of the second with the first, and so on
        - [0.93]
        - [-0.2, 0.1]

`uncertainty: exact` marks a rig whose numbers are the truth because pictures were rendered with it.
Numbers that were never calibrated, such as those written by hand, get stated default uncertainties
(`assumptions`, `completed_uncertainty`).
"""

import difflib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import reduce
from typing import Any, NamedTuple, Self

import numpy as np

from aqualvs.errors import RigError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import rotvec_from_rotation
from aqualvs.optics.camera import POSE_PARAMETERS
from aqualvs.optics.rig import (
    DOME_FROM_CAM_NOMINAL,
    LASER_PARAMETERS,
    LASER_WINDOW_PARAMETERS,
    Rig,
    RigUncertainty,
    combined,
    rig_parameter_names,
)

STEPS = ("camera", "dome", "lasers", "water")
"""Keys of `solved_from` under which calibrations leave a `SolvedStep`."""

ASSUMED = "assumed"
"""Extra of a `SolvedStep`: numbers that it took with a default uncertainty, by their file names."""
EXACT = "exact"
"""Value in place of an uncertainty where a rig's numbers are exact."""

_UNCERTAINTY = "uncertainty"
_PLACE = f"solved_from.{_UNCERTAINTY}"
_KEYS = ("parameters", "sigma", "correlation")
_UNITS = {
    ("mm", 1e3): "lens_x lens_y lens_z inner_radius thickness port_distance offset window_offset "
    "source_1 source_2",
    ("deg", 180.0 / math.pi): "rotation_x rotation_y rotation_z port_tilt_x port_tilt_y tilt_1 "
    "tilt_2 window_tilt_1 window_tilt_2",
    ("px", 1.0): "fx fy cx cy",
}
_UNIT_OF = {name: unit for unit, names in _UNITS.items() for name in names.split()}


@dataclass(frozen=True, slots=True, kw_only=True)
class SolvedStep:
    """Record of a calibration step: its date, data and residuals."""

    date: datetime = field(default_factory=lambda: datetime.now(UTC))  # With a time zone.
    # Number used; points are corners or stripe points.
    pictures: int
    points: int
    # Root mean square residual of a coordinate, in pixels.
    rms_px: float
    # Other values to keep: numbers, strings, lists of them.
    extras: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.date.tzinfo is None:
            raise ValueError(f"{self.date=} has no time zone")
        taken = {"date", "pictures", "points", "rms_px"} & set(self.extras)
        if taken:
            raise ValueError(f"extras hold {sorted(taken)}, which have fields of their own")

    def to_mapping(self) -> dict[str, Any]:
        """Return the step as written in a rig file; the date to the second, in UTC."""
        utc = self.date.astimezone(UTC)
        return {
            "date": utc.strftime("%Y-%m-%dT%H:%M:%SZ"),
            "pictures": int(self.pictures),
            "points": int(self.points),
            "rms_px": float(f"{self.rms_px:.4g}"),
            **self.extras,
        }

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any], place: str) -> Self:
        """Read a step from a rig file.

        Raises `RigError` with one line that names the place, the value and the remedy.
        """
        rest = dict(mapping)
        date = _date(rest.pop("date", None), f"{place}.date")
        pictures, points, rms_px = (
            _number(rest.pop(key, 0), f"{place}.{key}") for key in ("pictures", "points", "rms_px")
        )
        return cls(
            date=date, pictures=int(pictures), points=int(points), rms_px=rms_px, extras=rest
        )


def with_step(rig: Rig, name: str, step: SolvedStep) -> Rig:
    """Return the rig with the record of one of `STEPS` added; an older one is replaced."""
    if name not in STEPS:
        raise ValueError(f"{name!r} is none of {STEPS}")
    return _noting(rig, {name: step.to_mapping()})


def solved_steps(rig: Rig) -> dict[str, SolvedStep]:
    """Return the records of calibrations, by the names in `STEPS`, in that order.

    An entry under one of these names without a date is a note of the user and is left out.

    Raises `RigError` with one line, if a record is malformed.
    """
    notes = ((name, rig.solved_from.get(name)) for name in STEPS)
    return {
        name: SolvedStep.from_mapping(note, f"solved_from.{name}")
        for name, note in notes
        if isinstance(note, Mapping) and "date" in note
    }


def with_uncertainty(rig: Rig, uncertainty: RigUncertainty) -> Rig:
    """Return the rig with its uncertainty written down in place of any older one.

    Numbers that the rig does not have, such as those of a removed laser, are left out.
    """
    kept = uncertainty.only(rig_parameter_names(rig))
    return _noting(rig, {_UNCERTAINTY: _to_mapping(kept) if kept.names else None})


def with_exact_numbers(rig: Rig) -> Rig:
    """Return the rig with the note that its numbers are exact, as in simulations."""
    return _noting(rig, {_UNCERTAINTY: EXACT})


def is_exact(rig: Rig) -> bool:
    """Return whether the rig carries the note of `with_exact_numbers`."""
    return bool(rig.solved_from.get(_UNCERTAINTY) == EXACT)


def rig_uncertainty(rig: Rig) -> RigUncertainty:
    """Return the uncertainty written down in a rig; zero for one that is exact or has none.

    The numbers of a laser that was taken out of the rig by hand are left out.

    Raises `RigError` with one line, if it is malformed, not a covariance, or of numbers that the
    rig does not have.
    """
    content = rig.solved_from.get(_UNCERTAINTY)
    if content is None:
        return RigUncertainty.none()
    if is_exact(rig):
        names = rig_parameter_names(rig)
        return RigUncertainty(names, np.zeros((len(names), len(names))))
    if not isinstance(content, Mapping) or set(content) != set(_KEYS):
        raise RigError(
            f"{_PLACE} does not have the keys {', '.join(_KEYS)}; take it out, or calibrate again"
        )
    found = _names(content["parameters"], rig)
    kept = [i for i, name in enumerate(found) if name is not None]
    names = tuple(name for name in found if name is not None)
    sigma = _sigmas(content["sigma"], len(found))[kept] / [_unit(name)[1] for name in names]
    correlation = _correlation(content["correlation"], len(found))[np.ix_(kept, kept)]
    return RigUncertainty(names, correlation * np.outer(sigma, sigma))


def _noting(rig: Rig, notes: Mapping[str, Any]) -> Rig:
    """Return the rig with notes added or replaced; the uncertainty, which is long, comes last."""
    merged_notes = {**rig.solved_from, **notes}
    uncertainty = merged_notes.pop(_UNCERTAINTY, None)
    if uncertainty is not None:
        merged_notes[_UNCERTAINTY] = uncertainty
    return replace(rig, solved_from=merged_notes)


def rig_numbers(rig: Rig) -> dict[str, float]:
    """Return the numbers of a rig's camera by their names, SI units and radians.

    The rotation is the rig file's: a vector that is applied after the nominal mounting.
    """
    turn = rig.dome_from_cam.rotation @ DOME_FROM_CAM_NOMINAL.T
    pose = [*rig.dome_from_cam.translation.tolist(), *rotvec_from_rotation(turn).tolist()]
    return {
        **rig.lens.numbers(),
        **dict(zip(POSE_PARAMETERS, pose, strict=True)),
        **({} if rig.housing is None else rig.housing.numbers()),
        "n_air": rig.n_air,
        "n_water": rig.n_water,
    }


def file_parameter_name(name: str) -> str:
    """Return the name of a number of the rig in a rig file, with its unit."""
    unit, _ = _unit(name)
    return f"{name}_{unit}" if unit else name


def _unit(name: str) -> tuple[str, float]:
    """Return the unit of a number in a file, and its ratio to the unit in SI and radians."""
    return _UNIT_OF.get(name.rpartition(":")[2], ("", 1.0))


def _to_mapping(uncertainty: RigUncertainty) -> dict[str, Any]:
    sigma = np.sqrt(np.diag(uncertainty.covariance))
    # What is exact correlates with nothing.
    inverse = np.divide(1.0, sigma, out=np.zeros_like(sigma), where=sigma > 0.0)
    correlation = uncertainty.covariance * np.outer(inverse, inverse)
    sigma *= [_unit(name)[1] for name in uncertainty.names]
    sigma, correlation = _shortened(sigma, correlation)
    return {
        "parameters": [file_parameter_name(name) for name in uncertainty.names],
        "sigma": sigma.tolist(),
        "correlation": [correlation[i, :i].tolist() for i in range(1, len(sigma))],
    }


def _shortened(sigma: FloatArray, correlation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return both with as few digits as keep every combination's variance."""
    known = sigma > 0.0
    exact = correlation[np.ix_(known, known)]
    if not known.any():
        return sigma, correlation
    smallest = float(np.linalg.eigvalsh(exact)[0])
    # Enough digits that the variance of every combination of numbers, however nearly their errors
    # cancel, comes back within this share.
    numbers_of_digits = (5, 7, 9, 11, 13, 15)
    lost_share = 1e-3
    for digits in numbers_of_digits:
        short_sigma = np.array([float(f"{value:.{digits}g}") for value in sigma])
        short = np.round(correlation, digits)
        np.fill_diagonal(short, np.diag(correlation))
        ratio = short_sigma[known] / sigma[known]
        lost = short[np.ix_(known, known)] * np.outer(ratio, ratio) - exact
        if np.linalg.norm(lost, 2) < lost_share * smallest:
            return short_sigma, short + 0.0
    return sigma, correlation


def _names(values: object, rig: Rig) -> list[str | None]:
    """Return the names of a file's parameters; None for those of a laser that was taken out."""
    known = {file_parameter_name(name): name for name in rig_parameter_names(rig)}
    if not isinstance(values, list):
        raise RigError(f"{_PLACE}.parameters is not a list; take {_PLACE} out, or calibrate again")
    removed = _of_removed_lasers(values, rig)
    for i, value in enumerate(values):
        place = f"{_PLACE}.parameters[{i}] is {value!r}"
        if value in removed:
            continue
        if not isinstance(value, str) or value not in known:
            close = difflib.get_close_matches(str(value), known, n=1, cutoff=0.5)
            remedy = f"did you mean {close[0]!r}?" if close else f"take {_PLACE} out"
            raise RigError(f"{place}, which this rig does not have; {remedy}")
        if value in values[:i]:
            raise RigError(f"{place} as another one is; name every number once")
    return [known.get(value) for value in values]


def _of_removed_lasers(values: list[object], rig: Rig) -> list[object]:
    """Return those of a file's parameters that are of lasers which the rig does not have.

    None if a laser of the rig has no number among them: then one was renamed, not removed.
    """
    every = (*LASER_PARAMETERS, *LASER_WINDOW_PARAMETERS)
    endings = tuple(f":{file_parameter_name(name)}" for name in every)
    of_lasers = [one for one in values if isinstance(one, str) and one.endswith(endings)]
    named = {one.rpartition(":")[0] for one in of_lasers}
    present = {laser.name for laser in rig.lasers}
    if not present <= named:
        return []
    return [one for one in of_lasers if one.rpartition(":")[0] not in present]


def _sigmas(values: object, n: int) -> FloatArray:
    sigma = np.array(_numbers(values, n, f"{_PLACE}.sigma"))
    if (sigma < 0.0).any():
        raise RigError(f"{_PLACE}.sigma holds {sigma.min():g}; a standard deviation is at least 0")
    return sigma


def _correlation(rows: object, n: int) -> FloatArray:
    place = f"{_PLACE}.correlation"
    if not isinstance(rows, list) or len(rows) != max(n - 1, 0):
        raise RigError(f"{place} does not have {max(n - 1, 0)} rows; calibrate again")
    correlation = np.eye(n)
    for i, row in enumerate(rows, start=1):
        correlation[i, :i] = correlation[:i, i] = _numbers(row, i, f"{place}[{i - 1}]")
    # Rounding in a file written by hand or by others; what is more negative is no covariance.
    not_negative = -1e-6
    if n and not np.linalg.eigvalsh(correlation)[0] >= not_negative:
        raise RigError(f"{place} is not that of any numbers; restore it, or calibrate again")
    return correlation


def _numbers(values: object, n: int, place: str) -> list[float]:
    if not isinstance(values, list) or len(values) != n:
        raise RigError(f"{place} does not have {n} numbers; restore it, or calibrate again")
    return [_number(value, f"{place}[{i}]") for i, value in enumerate(values)]


def _number(value: object, place: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise RigError(f"{place} is {value!r}; write a plain number")
    return float(value)


def _date(value: object, place: str) -> datetime:
    # YAML makes a date of one that stands without quotation marks.
    text = value.isoformat() if hasattr(value, "isoformat") else value
    try:
        date = datetime.fromisoformat(str(text))
    except ValueError:
        raise RigError(
            f"{place} is {value!r}; write date and time as '2026-05-04T09:30:00Z'"
        ) from None
    return date if date.tzinfo is not None else date.replace(tzinfo=UTC)


class DefaultSigmas(NamedTuple):
    """Standard deviations of numbers that were never calibrated, in metres and radians."""

    # Of the focal length. Calibrations of one camera from other pictures differ by 0.2 to 0.4 %.
    focal_share: float = 0.002
    # Of fy over fx: pixels are made far better than a focal length is measured.
    aspect_share: float = 0.0005
    # Of the image centre, along each axis, as a share of the picture's width.
    centre_share: float = 0.002
    # Of the first distortion coefficient, where the rig has any.
    distortion_k1: float = 0.005
    # Of the lens's place in the dome along each axis, or its distance from a flat port: measured
    # with a caliper.
    lens_m: float = 1e-3
    # Of the dome: the tolerances of the part that `calibrate dome` assumes as well.
    radius_m: float = 1e-4
    thickness_m: float = 1e-4
    n_acrylic: float = 3e-3
    # Of a flat port from square to the optical axis, about each axis: a camera mounted by hand.
    port_tilt: float = math.radians(0.5)
    # Of the water's index: between fresh and sea water, with which `calibrate dome` starts as well.
    n_water: float = 3e-3
    # Of a laser's plane, its normal in each direction and its offset: a mount measured by hand.
    laser_tilt: float = math.radians(0.2)
    laser_offset_m: float = 1e-3


SIGMAS = DefaultSigmas()


_LENS = ("lens_x", "lens_y", "lens_z")


@dataclass(frozen=True, slots=True)
class Assumption:
    """Default uncertainty of numbers of a rig that belong together."""

    what: str  # Name of the group of numbers.
    words: str  # The standard deviations as text.
    uncertainty: RigUncertainty


def assumptions(rig: Rig) -> tuple[Assumption, ...]:
    """Return the default uncertainties of the numbers that have none in the rig.

    A group of numbers (intrinsics, place of the lens, dome, water, each laser) of which
    `solved_from.uncertainty` names one was calibrated; the others of the group were held fixed and
    count as exact. The origin and the axes of the frame `dome` are exact by definition where
    nothing physical fixes them: the camera's rotation, and the place of a lens without a dome.

    Raises `RigError` as `rig_uncertainty` does.
    """
    known, found = set(rig_uncertainty(rig).names), []
    for one in _defaults(rig):
        names = one.uncertainty.names
        # The calibration of the dome decides which of its sizes are uncertain.
        if known.isdisjoint((*names, *_LENS) if one.what == "dome" else names):
            found.append(one)
    return tuple(found)


def completed_uncertainty(rig: Rig) -> RigUncertainty:
    """Return the uncertainty written down in a rig, with the defaults for the other numbers.

    Raises `RigError` as `rig_uncertainty` does.
    """
    return reduce(combined, (one.uncertainty for one in assumptions(rig)), rig_uncertainty(rig))


def _defaults(rig: Rig) -> Iterator[Assumption]:
    """Yield the default uncertainty of every group of numbers that a rig has."""
    yield _intrinsics(rig)
    lens, thickness = f"{SIGMAS.lens_m * 1e3:g} mm", f"{SIGMAS.thickness_m * 1e3:g} mm"
    if rig.dome is not None:
        yield _independent("lens's place", lens, _LENS, [SIGMAS.lens_m] * 3)
        yield _independent(
            "dome",
            f"{SIGMAS.radius_m * 1e3:g} mm in radius and thickness, {SIGMAS.n_acrylic:g} in index",
            rig.dome.numbers(),
            (SIGMAS.radius_m, SIGMAS.thickness_m, SIGMAS.n_acrylic),
        )
    if rig.flat_port is not None:
        tilt = SIGMAS.port_tilt
        yield _independent(
            "flat port",
            f"{lens} in distance, {thickness} in thickness, {SIGMAS.n_acrylic:g} in index, "
            f"{math.degrees(tilt):g} degrees in tilt",
            rig.flat_port.numbers(),
            (SIGMAS.lens_m, SIGMAS.thickness_m, SIGMAS.n_acrylic, tilt, tilt),
        )
    refracts = rig.housing is not None or any(laser.window is not None for laser in rig.lasers)
    # The index of air is known.
    if refracts and not rig.is_air(rig.n_water):
        yield _independent("water's index", f"{SIGMAS.n_water:g}", ["n_water"], [SIGMAS.n_water])
    for laser in rig.lasers:
        yield _independent(
            f"laser '{laser.name}'",
            f"{math.degrees(SIGMAS.laser_tilt):g} degrees and {SIGMAS.laser_offset_m * 1e3:g} mm",
            [f"{laser.name}:{name}" for name in LASER_PARAMETERS],
            (SIGMAS.laser_tilt, SIGMAS.laser_tilt, SIGMAS.laser_offset_m),
        )


def _independent(
    group: str, words: str, names: Iterable[str], sigmas: Sequence[float]
) -> Assumption:
    sigma_of = dict(zip(names, sigmas, strict=True))
    return Assumption(group, words, RigUncertainty.independent(sigma_of))


def _intrinsics(rig: Rig) -> Assumption:
    """Return the assumption on the lens: fx and fy share one error but for the pixels' aspect."""
    lens = rig.lens
    centre = SIGMAS.centre_share * rig.size_px[0]
    sigmas = {
        "fx": SIGMAS.focal_share * lens.fx,
        "fy": SIGMAS.focal_share * lens.fy,
        "cx": centre,
        "cy": centre,
    }
    words = (
        f"{SIGMAS.focal_share:.1%} in focal length, "
        f"{SIGMAS.centre_share:.1%} of the width in principal point"
    )
    if "k1" in lens.parameter_names:
        sigmas["k1"] = SIGMAS.distortion_k1
        words += f", {SIGMAS.distortion_k1:g} in k1"
    covariance = RigUncertainty.independent(sigmas).covariance
    covariance[0, 1] = covariance[1, 0] = SIGMAS.focal_share**2 * lens.fx * lens.fy
    covariance[0, 0] += (0.5 * SIGMAS.aspect_share * lens.fx) ** 2
    covariance[1, 1] += (0.5 * SIGMAS.aspect_share * lens.fy) ** 2
    covariance[0, 1] -= 0.25 * SIGMAS.aspect_share**2 * lens.fx * lens.fy
    covariance[1, 0] = covariance[0, 1]
    return Assumption("set of intrinsics", words, RigUncertainty(tuple(sigmas), covariance))
