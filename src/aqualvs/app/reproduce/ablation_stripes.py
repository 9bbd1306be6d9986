"""What a sub-pixel stripe detector is worth over the paper's threshold."""

from aqualvs.app.reproduce.distance import wall_dive
from aqualvs.app.reproduce.experiment import Experiment, Outcome, Picture
from aqualvs.app.reproduce.growth_and_sun import scene
from aqualvs.app.reproduce.laboratory import Dive, Laboratory
from aqualvs.app.reproduce.variants import Variant, drawn, findings, series, told
from aqualvs.scanning.pipeline import ScannerOptions
from aqualvs.scanning.stripe import StripeOptions
from aqualvs.scanning.threshold import ThresholdOptions

_LEVELS = (100, 140, 180)
_NETS = {"sun": "net in sun", "growth": "grown net"}


def _run(laboratory: Laboratory) -> Outcome:
    dives = {"wall": wall_dive(laboratory)} | {
        where: laboratory.dive(scene(name)) for name, where in _NETS.items()
    }
    variants = [one for where, dive in dives.items() for one in _variants(laboratory, dive, where)]
    return Outcome(
        sentence=_sentence(variants, list(dives)),
        findings=findings(variants),
        pictures=(
            Picture(
                name="ablation_stripes",
                caption="Root mean square errors with the sub-pixel detector and with thresholds.",
                figure=drawn(variants),
            ),
        ),
        series=(series("ablation_stripes", variants),),
        notes=(
            "Everything behind the detector is the same: filter, target and robust fit. Where a "
            "threshold suits a scene it is as exact as the sub-pixel detector: a stripe has many "
            "points, and their half pixels cancel. What it lacks is a level that suits every "
            "scene.",
        ),
    )


def _sentence(variants: list[Variant], places: list[str]) -> str:
    """Say what each way is worth in the scene that suits it least."""
    shares = {
        what: min(v.valid_percent for v in variants if v.name.startswith(what))
        for what in ("sub-pixel", *(f"threshold {level}" for level in _LEVELS))
    }
    worst = {
        what: max(float(v.rms[0]) for v in variants if v.name.startswith(what)) for what in shares
    }
    ours = f"{worst['sub-pixel']:.2f} % in {shares['sub-pixel']:.0f} % of the frames"
    others = "; ".join(
        f"{what} has {told([worst[what]])} % in {shares[what]:.0f} %"
        for what in shares
        if what != "sub-pixel"
    )
    return (
        f"In the scene that suits it least ({', '.join(places)}) the sub-pixel detector has a "
        f"range error of {ours}; {others}."
    )


def _variants(laboratory: Laboratory, dive: Dive, where: str) -> list[Variant]:
    ours = ScannerOptions(detector=StripeOptions())
    found = [Variant(f"sub-pixel, {where}", (laboratory.measure(dive, ours),), ours=True)]
    for level in _LEVELS:
        options = ScannerOptions(detector=ThresholdOptions(level=level))
        name = f"threshold {level}, {where}"
        found.append(Variant(name, (laboratory.measure(dive, options),)))
    return found


EXPERIMENT = Experiment(
    name="stripes",
    title="Why a sub-pixel detector",
    paper="",
    about="The wall at the paper's four distances, and the net in the sun, with the sub-pixel "
    "stripe detector and with fixed thresholds as in section 3.1.",
    run=_run,
)
