"""The index of a medium from a set of pictures, as `calibrate water` reports it."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from aqualvs.calibration.index_estimator import IndexEstimator
from aqualvs.calibration.index_prior import IndexPrior
from aqualvs.calibration.index_reading import IndexOptions, IndexReading, IndexStep
from aqualvs.calibration.index_state import FIRST_CAMERA, IndexState, N
from aqualvs.calibration.view import View
from aqualvs.errors import CalibrationError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.rig import Rig
from aqualvs.optics.uncertainty import RigUncertainty

N_WATER = "n_water"
_DEFAULT_OPTIONS = IndexOptions()


@dataclass(frozen=True, slots=True, kw_only=True)
class WaterCalibration:
    """A rig in its medium.

    Attributes
    ----------
    rig : Rig
        With the index found, that of the last picture.
    uncertainty : RigUncertainty
        Of the rig's numbers, `n_water` and what it owes to the others among them.
    sigma, sigma_random : float
        Standard deviation of the index, and the part that more pictures reduce.
    observable : bool
        False where the index does not rest on the pictures; `remarks` says why.
    steps : tuple of IndexStep
        Alarms.
    readings : tuple of IndexReading
        What was known after each picture.
    rms_px : float
        Root mean square residual of the corners that counted.
    remarks : tuple of str
        What a user should know, one sentence each.
    """

    rig: Rig
    uncertainty: RigUncertainty
    sigma: float
    sigma_random: float
    observable: bool
    steps: tuple[IndexStep, ...]
    readings: tuple[IndexReading, ...] = field(repr=False)
    rms_px: float
    remarks: tuple[str, ...]

    @property
    def n(self) -> float:
        """Index of the medium, relative to vacuum."""
        return self.rig.n_water


def calibrate_water(
    rig: Rig,
    views: Sequence[View],
    times: Sequence[float] | None = None,
    *,
    uncertainty: RigUncertainty | None = None,
    prior: IndexPrior | None = None,
    options: IndexOptions = _DEFAULT_OPTIONS,
) -> WaterCalibration:
    """Find the index of the medium from pictures of a target fixed on the vehicle.

    Parameters
    ----------
    rig : Rig
        Behind a dome; its own index is where the search begins when there is no prior.
    views : sequence of View
        Points of the target in `dome`, metres.
    times : sequence of float, optional
        Of the pictures, in seconds, ascending. Without them all are of one moment.
    uncertainty : RigUncertainty, optional
        How well the rig is known; without it the rig is taken as exact.
    prior : IndexPrior, optional
        What is known of the medium in the first picture.
    options : IndexOptions
        What is assumed of the target and the medium.

    Returns
    -------
    WaterCalibration

    Raises
    ------
    CalibrationError
        If the rig has no dome or no picture can be used.
    """
    known = RigUncertainty.none() if uncertainty is None else uncertainty
    estimator = IndexEstimator(rig, uncertainty=known, options=options, prior=prior)
    moments = np.zeros(len(views)) if times is None else np.asarray(times, np.float64)
    readings = tuple(
        estimator.add(float(time), view) for time, view in zip(moments, views, strict=True)
    )
    state = estimator.state
    if state is None:
        raise CalibrationError(_why_none(readings))
    last = readings[-1]
    return WaterCalibration(
        rig=rig.in_water(max(state.n, 1.0)),
        uncertainty=_with_index(known, state, estimator.camera_names),
        sigma=last.sigma,
        sigma_random=last.sigma_random,
        observable=last.observable,
        steps=tuple(estimator.steps),
        readings=readings,
        rms_px=_rms(readings),
        remarks=last.remarks,
    )


def _why_none(readings: Sequence[IndexReading]) -> str:
    if not readings:
        return "no pictures of the target; give some on which the whole target is seen"
    first = readings[0]
    return (
        f"none of {len(readings)} pictures can be used: {first.name}: {first.refused}; check that "
        "target.yaml gives the target's corners in the frame of the dome, in millimetres"
    )


def _rms(readings: Sequence[IndexReading]) -> float:
    counted = [r for r in readings if r and r.n_points]
    weights = np.array([r.n_points for r in counted], np.float64)
    squares = np.array([r.rms_px for r in counted]) ** 2
    return float(np.sqrt(np.sum(weights * squares) / np.sum(weights)))


def _with_index(
    known: RigUncertainty, state: IndexState, camera_names: tuple[str, ...]
) -> RigUncertainty:
    """Return the covariance of the rig's numbers as they were, and of the index found with them.

    The estimate of the camera's errors is left aside, as the rig keeps its numbers: errors of
    these and of the index have the covariance that the state has between its two. Lasers are
    correlated with the index by way of the camera alone.
    """
    old = known.only([name for name in known.names if name != N_WATER])
    camera = slice(FIRST_CAMERA, FIRST_CAMERA + len(camera_names))
    with_camera = state.covariance[camera, N]
    reach = np.zeros(len(old.names))
    if camera_names:
        columns = [old.names.index(name) for name in camera_names]
        reach = old.covariance[:, columns] @ _solve(old.of(camera_names), with_camera)
    covariance = np.zeros((len(old.names) + 1,) * 2)
    covariance[:-1, :-1] = old.covariance
    covariance[-1, :-1] = covariance[:-1, -1] = reach
    covariance[-1, -1] = state.sigma**2
    return RigUncertainty((*old.names, N_WATER), covariance)


def _solve(covariance: FloatArray, right: FloatArray) -> FloatArray:
    """Solve with a covariance that may be singular and whose units differ."""
    size = np.sqrt(np.diag(covariance))
    scaled = np.linalg.pinv(covariance / np.outer(size, size), hermitian=True)
    solved: FloatArray = scaled @ (right / size) / size
    return solved
