"""What a solved dome means, in plain words."""

import numpy as np

from aqualvs.calibration.board_sets import PoseKind
from aqualvs.calibration.bundle import BundleState
from aqualvs.calibration.dome_problem import LENS, ROTATION, DomeProblem
from aqualvs.calibration.dome_result import DomeCalibration, HeldBack
from aqualvs.calibration.least_squares import Solution
from aqualvs.calibration.observability import Observability, observability
from aqualvs.calibration.rig_priors import rig_difference

_DOME = ("inner_radius", "thickness", "n_acrylic")
_WORDS = {
    "inner_radius": "inner radius",
    "thickness": "thickness",
    "n_acrylic": "acrylic index",
    "lens_x": "lens x",
    "lens_y": "lens y",
    "lens_z": "lens z",
    "rotation_x": "rotation about x",
    "rotation_y": "rotation about y",
    "rotation_z": "rotation about z",
}
# Shares of the prior's sigma: nothing learnt, something learnt.
_NOTHING, _SOMETHING = 0.9, 0.5
_CORRELATED = 0.95
_FAR_FROM_PRIOR = 3.5


def findings(
    problem: DomeProblem, solution: Solution[BundleState], result: DomeCalibration
) -> list[str]:
    """Return one sentence for everything worth knowing."""
    bundle, uncertainty = problem.bundle, result.uncertainty
    seen = observability(bundle, solution, uncertainty, _DOME)
    lines = [_lens(result), _rotation(problem, result), *_dome(result, seen), *_untold(seen)]
    lens = observability(bundle, solution, uncertainty, result.rig.lens.parameter_names)
    lines += _intrinsics(problem, result, lens)
    lines += _entangled(result)
    lines += _media(problem, result)
    lines += _against_priors(problem, solution)
    lines += _held_back(result.held_back)
    lines += [f"left out, {label}: {why}" for label, why in result.left_out.items()]
    return lines


def _lens(result: DomeCalibration) -> str:
    sigmas = result.uncertainty.sigmas
    position = 1e3 * result.rig.dome_from_cam.translation
    told = ", ".join(
        f"{axis} {value:.3f} ± {1e3 * sigmas[name]:.4f}"
        for axis, value, name in zip("xyz", position, LENS, strict=True)
    )
    return f"lens position: {told} mm"


def _rotation(problem: DomeProblem, result: DomeCalibration) -> str:
    if not result.rotation_is_solved:
        return (
            "camera rotation: taken from the rig; boards at unknown poses say nothing about it, "
            "and the lens position is told in axes turned by it"
        )
    sigma = np.rad2deg([result.uncertainty.sigmas[name] for name in ROTATION])
    told = ", ".join(f"{axis} {value:.4f}" for axis, value in zip("xyz", sigma, strict=True))
    exact = any(shot.kind is PoseKind.EXACT for shot in problem.shots)
    source = "boards at known poses" if exact else "most boards standing square to the dome"
    return f"camera rotation: from {source}; uncertain by {told} deg about the dome's axes"


def _dome(result: DomeCalibration, seen: Observability) -> list[str]:
    lines = []
    nothing = seen.undetermined(_DOME, _NOTHING)
    some = [n for n in seen.undetermined(_DOME, _SOMETHING) if n not in nothing]
    told = [n for n in _DOME if n in seen.shrinkage and n not in nothing and n not in some]
    for names, what in (
        (nothing, "not determined by the pictures, taken as given"),
        (some, "hardly determined by the pictures, mostly taken as given"),
        (told, "determined by the pictures"),
    ):
        if names:
            listed = ", ".join(f"{_WORDS[name]} (± {_size(name, result)})" for name in names)
            lines.append(f"{listed}: {what}")
    exact = [_WORDS[name] for name in _DOME if name not in seen.shrinkage]
    if exact:
        lines.append(f"{', '.join(exact)}: taken as exact")
    return lines


def _size(name: str, result: DomeCalibration) -> str:
    sigma = result.uncertainty.sigmas[name]
    return f"{sigma:.4f}" if name == "n_acrylic" else f"{1e3 * sigma:.3f} mm"


def _intrinsics(problem: DomeProblem, result: DomeCalibration, seen: Observability) -> list[str]:
    names = result.rig.lens.parameter_names
    refined = [name for name in names if name in seen.shrinkage]
    if refined:
        share = np.median([seen.shrinkage[name] for name in refined])
        focal = result.uncertainty.sigmas["fx"] if "fx" in refined else float("nan")
        return [
            f"intrinsics: refined within what the camera's calibration says of them; their "
            f"uncertainty is {100.0 * share:.0f} % of what it was, that of fx {focal:.2f} px"
        ]
    if problem.held.names:
        return ["intrinsics: held as they were; their uncertainty is passed on to the result"]
    return [
        "intrinsics: taken as exact, as the rig does not say how well they are known; "
        "calibrate the camera with this version to mend that"
    ]


def _untold(seen: Observability) -> list[str]:
    """Name the combinations of which the pictures tell nothing."""
    untold = seen.untold()
    if not untold:
        return []
    told = "; ".join(" with ".join(_WORDS.get(n, n) for n in d.main) for d in untold)
    return [
        f"of the {len(seen.directions)} combinations of the dome's numbers the pictures tell "
        f"{len(seen.directions) - len(untold)}; they tell nothing of: {told}"
    ]


def _entangled(result: DomeCalibration) -> list[str]:
    """Name the pair of numbers that the data tell apart worst, if they hardly do."""
    uncertainty = result.uncertainty
    sigma = np.sqrt(np.diag(uncertainty.covariance))
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = uncertainty.covariance / np.outer(sigma, sigma)
    worst, pair = _CORRELATED, None
    for i, name in enumerate(uncertainty.names):
        for j, other in enumerate(uncertainty.names):
            if name in LENS and other not in LENS and abs(correlation[i, j]) > worst:
                worst, pair = abs(float(correlation[i, j])), (name, other)
    if pair is None:
        return []
    one, other = (_WORDS.get(name, name) for name in pair)
    return [
        f"{one} and {other}: known together only (correlation {worst:.3f}); an error of one is "
        "made up for by the other"
    ]


def _media(problem: DomeProblem, result: DomeCalibration) -> list[str]:
    return [
        f"{medium.name}: n = {medium.n:.5f} ± {medium.sigma:.5f}"
        for i, medium in enumerate(result.media)
        if i in problem.bundle.free_media
    ]


def _against_priors(problem: DomeProblem, solution: Solution[BundleState]) -> list[str]:
    """Name what moved further than its prior allows."""
    bundle = problem.bundle
    names = [name for name in bundle.free if name in bundle.priors.names]
    moved = rig_difference(bundle.start.rig, solution.state.rig, names)
    sigmas = bundle.priors.sigmas
    off = {n: float(m) / sigmas[n] for n, m in zip(names, moved, strict=True)}
    return [
        f"{_WORDS.get(name, name)}: moved by {abs(value):.1f} sigma of what was known of it; check "
        "that figure"
        for name, value in off.items()
        if abs(value) > _FAR_FROM_PRIOR
    ]


def _held_back(held: HeldBack | None) -> list[str]:
    if held is None:
        return []
    told = (
        f"{held.n_points} corners of {held.n_views} views, each held back once, are predicted to "
        f"{held.dome_rms_px:.3f} px with the dome, to {held.bare_rms_px:.3f} px with a bare lens; "
        f"the dome is better in {held.n_dome_better} of the views"
    )
    if held.dome_is_better:
        return [f"{told}: the dome model is needed"]
    return [f"{told}: the pictures do not show that there is a dome"]
