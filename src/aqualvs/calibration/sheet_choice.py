"""Whether the light of a laser behind a window is a plane in the water: by the residuals."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from aqualvs.calibration.laser_names import like
from aqualvs.calibration.laser_report import Solved
from aqualvs.calibration.stripe_groups import correlation_factor
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Laser, Rig
from aqualvs.optics.sheet import Sheet, sheet_in

# Difference of the Bayesian information criterion (Kass & Raftery 1995,
# doi:10.1080/01621459.1995.10476572) from which the evidence is strong.
_STRONG = 6.0


@dataclass(frozen=True, slots=True)
class _Fit:
    rms_px: float
    n_effective: float


def start_sheets(rig: Rig, lasers: Sequence[Laser], *, bent: bool) -> tuple[Sheet, ...]:
    """Return the sheets to start from: planes, or bent where a laser has a window.

    Parameters
    ----------
    rig : Rig
        In the medium of the pictures.
    lasers : sequence of Laser
        `plane` is the one that fits the light in that medium.
    bent : bool
        Whether windows count.
    """
    sheets = []
    for laser in lasers:
        flat = Sheet(plane=laser.plane, window=None, n_air=rig.n_air, n_water=rig.n_water)
        sheets.append(_bent(rig, laser) if bent and laser.window is not None else flat)
    return tuple(sheets)


def _bent(rig: Rig, laser: Laser) -> Sheet:
    """Find the plane in air of which the light in the medium is nearly `laser.plane`."""
    in_air = laser.plane
    for _ in range(5):
        sheet = sheet_in(Laser(laser.name, in_air, laser.window), rig.n_air, rig.n_water)
        reached = like(sheet.best_plane(rig.camera(), rig.working_range), laser.plane)
        in_air = Plane.from_normal(
            in_air.normal + laser.plane.normal - reached.normal,
            in_air.offset + laser.plane.offset - reached.offset,
        )
    return sheet_in(Laser(laser.name, in_air, laser.window), rig.n_air, rig.n_water)


def choose_sheets(
    flat: Solved,
    rig: Rig,
    lasers: Sequence[Laser],
    solve_with: Callable[[tuple[Sheet, ...]], Solved],
) -> tuple[Solved, list[str]]:
    """Choose plane or bent sheet for every laser that has a window.

    Parameters
    ----------
    flat : Solved
        With all lasers as planes.
    rig : Rig
        In the medium of the pictures.
    lasers : sequence of Laser
        With their windows, and the planes of `flat`.
    solve_with : callable
        Solves again with the sheets it is given as start.

    Returns
    -------
    solved : Solved
        With the chosen sheets.
    words : list of str
        For every laser, what was chosen and why.
    """
    if all(laser.window is None for laser in lasers):
        return flat, ["plane"] * len(lasers)
    bent = solve_with(start_sheets(rig, lasers, bent=True))
    chosen, words = [], []
    for i, laser in enumerate(lasers):
        if laser.window is None:
            chosen.append(flat.state.sheets[i])
            words.append("plane")
            continue
        keep_window, why = _choice(_fit(flat, i), _fit(bent, i))
        chosen.append((bent if keep_window else flat).state.sheets[i])
        words.append(why)
    return solve_with(tuple(chosen)), words


def _choice(flat: _Fit, bent: _Fit) -> tuple[bool, str]:
    # Both have three unknowns, so that only the residuals weigh.
    n = min(flat.n_effective, bent.n_effective)
    evidence = 2.0 * n * float(np.log(max(flat.rms_px, 1e-9) / max(bent.rms_px, 1e-9)))
    residuals = f"residuals {bent.rms_px:.3f} px if bent at the window, {flat.rms_px:.3f} px if not"
    if evidence > _STRONG:
        return True, f"bent at its window: {residuals}"
    if evidence < -_STRONG:
        return False, f"plane, its window left out: {residuals}"
    return True, f"bent at its window as the rig says, though stripes cannot tell: {residuals}"


def _fit(solved: Solved, i_laser: int) -> _Fit:
    squares: list[FloatArray] = []
    sequences: list[FloatArray] = []
    for i in solved.groups_of(laser=i_laser):
        residuals, inside = solved.stripe_residuals_px(i)
        squares.append(residuals[inside] ** 2)
        surface = solved.problem.groups[i].surface
        known = np.where(inside, residuals, np.nan)
        sequences += [known[surface == k] for k in np.unique(surface)]
    everything = np.concatenate(squares)
    # Bent light fitted by a plane leaves long waves; only their shape counts, not how many points.
    n_effective = len(everything) / correlation_factor(sequences)
    return _Fit(float(np.sqrt(np.mean(everything))), n_effective)
