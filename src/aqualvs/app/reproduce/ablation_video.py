"""What video coding costs: H.264 at several qualities against uncompressed pictures."""

from dataclasses import replace

from aqualvs.app.reproduce.experiment import Experiment, Outcome, Picture
from aqualvs.app.reproduce.growth_and_sun import scene
from aqualvs.app.reproduce.laboratory import Dive, Laboratory
from aqualvs.app.reproduce.variants import Variant, drawn, findings, series
from aqualvs.simulation.video import Recording

_CRFS = (20, 26, 32, 38)
_DEFAULT = 20


def _run(laboratory: Laboratory) -> Outcome:
    # The clear net of the growth experiment, whose H.264 at the default quality is there already.
    course = scene("clear")
    raw = laboratory.dive(course, recording=Recording(codec="lossless"))
    variants = [_variant(laboratory, raw, "uncompressed")]
    for crf in _CRFS:
        dive = laboratory.dive(course, recording=Recording(crf=crf))
        variants.append(_variant(laboratory, dive, f"H.264 crf {crf}", ours=crf == _DEFAULT))
    first, last = variants[1], variants[-1]
    return Outcome(
        sentence=f"Against uncompressed pictures H.264 of good quality changes the range error "
        f"from {variants[0].rms[0]:.3f} to {first.rms[0]:.3f} %; at {last.name} it is "
        f"{last.rms[0]:.3f} %.",
        findings=findings(variants),
        pictures=(
            Picture(
                name="ablation_video",
                caption="Root mean square errors on a clear net from the same pictures, "
                "uncompressed and coded ever more coarsely.",
                figure=drawn(variants),
            ),
        ),
        series=(series("ablation_video", variants),),
    )


def _variant(laboratory: Laboratory, dive: Dive, name: str, ours: bool = False) -> Variant:
    frames = dive.scenario.n_frames
    rate = 8e-6 * dive.video.stat().st_size * dive.scenario.fps / frames
    named = Variant(f"{name}, {rate:.1f} Mbit/s", (laboratory.measure(dive),))
    return replace(named, ours=ours)


EXPERIMENT = Experiment(
    name="video",
    title="What H.264 costs",
    paper="",
    about="The same pictures of a clear net, uncompressed and as H.264 at four qualities.",
    run=_run,
)
