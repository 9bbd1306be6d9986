"""What a robust, weighted fit is worth over the paper's pseudo-inverse."""

from aqualvs.app.reproduce.distance import wall_dive
from aqualvs.app.reproduce.experiment import Experiment, Outcome, Picture
from aqualvs.app.reproduce.growth_and_sun import scene
from aqualvs.app.reproduce.laboratory import Laboratory
from aqualvs.app.reproduce.mesh_filter import net_dive
from aqualvs.app.reproduce.variants import Variant, drawn, findings, series, told
from aqualvs.scanning.measure import FitMethod
from aqualvs.scanning.pipeline import ScannerOptions

_FITS = {"robust": FitMethod.ROBUST, "pseudo-inverse": FitMethod.PSEUDO_INVERSE}


def _run(laboratory: Laboratory) -> Outcome:
    dives = {
        "wall": wall_dive(laboratory),
        "net": net_dive(laboratory),
        "grown net": laboratory.dive(scene("growth")),
    }
    variants = [
        Variant(
            f"{fit}, {where}",
            (laboratory.measure(dive, ScannerOptions(fit=method)),),
            ours=method is FitMethod.ROBUST,
        )
        for where, dive in dives.items()
        for fit, method in _FITS.items()
    ]
    times = [b.rms[0] / a.rms[0] for a, b in zip(variants[::2], variants[1::2], strict=True)]
    return Outcome(
        sentence="Fitted by the paper's pseudo-inverse to the same target points, the range error "
        f"is {told(times)} times that of the robust fit on {', '.join(dives)}.",
        findings=findings(variants),
        pictures=(
            Picture(
                name="ablation_fits",
                caption="Root mean square errors with the robust fit and with the pseudo-inverse "
                "of Eq. 24, on the same points of the target.",
                figure=drawn(variants),
            ),
        ),
        series=(series("ablation_fits", variants),),
        notes=(
            "The points are those that our own search has assigned to the target; it has removed "
            "what the pseudo-inverse would suffer from most.",
        ),
    )


EXPERIMENT = Experiment(
    name="fits",
    title="Why a robust fit",
    paper="",
    about="The points of the target in three dives, fitted robustly with their covariances, and "
    "all alike by pseudo-inverse.",
    run=_run,
)
