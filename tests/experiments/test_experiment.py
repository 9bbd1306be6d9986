"""Every experiment of the catalogue runs, in small pictures and on a few frames of its dives."""

from dataclasses import replace
from functools import cached_property, partial, partialmethod
from itertools import chain
from pathlib import Path

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from aqualvs import experiments
from aqualvs.experiments import ablation_stages, growth_and_sun, mesh_filter, page, sea, water_index
from aqualvs.experiments import laboratory as tank
from aqualvs.experiments.experiment import MODULES, experiment
from aqualvs.experiments.laboratory import Laboratory
from aqualvs.experiments.mesh_filter import PrecisionRecall
from aqualvs.experiments.page import save_outcome
from aqualvs.follow import sensor_model
from aqualvs.follow.case import Trials
from aqualvs.report import figure_style
from aqualvs.report.figure_style import STYLE
from aqualvs.simulation import dive
from aqualvs.simulation.calibration_set import SetSize
from aqualvs.simulation.render import Renderer
from camera_cases import half_size_rig
from dome_cases import leave_bare_lenses_out
from whole import WHOLE, part_of

N_FRAMES = 4
# Of the frames of the net before the wall that are compared with their true points, two; frame 8 is
# drawn.
JUDGED = (2, 8)
# Bars for full pictures and whole dives; all others are reached by these, too.
FOR_FULL_PICTURES = {
    "changes of the medium detected, including the entry into the water",
    "pitch and yaw error that remains, largest (°)",
    "largest error of the range to the net (%)",
    "largest error of a single point with the dome model (%)",
}


class BriefLaboratory(Laboratory):
    """A laboratory with pictures of half the size and few frames of each dive."""

    @cached_property
    def rig(self):
        return half_size_rig()

    def dive(self, scenario, rig=None, *, recording=None, point_frames=()):
        n_frames = max(N_FRAMES, max(point_frames, default=0) + 1)
        if scenario.n_frames > n_frames:
            scenario = replace(scenario, fps=n_frames / scenario.duration)
        return super().dive(scenario, rig, recording=recording, point_frames=point_frames)


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory):
    """Dives and the calibration are made once, as `reproduce` does it."""
    with pytest.MonkeyPatch.context() as patch:
        # One ray for each pixel: rendering would be most of the time.
        for module in (dive, growth_and_sun, sensor_model):
            patch.setattr(module, "Renderer", partial(Renderer, samples=1))
        patch.setattr(tank, "_SIZE", SetSize(camera=6, dome=6, box=2, index=1, dive=0))
        leave_bare_lenses_out(patch)
        yield BriefLaboratory(tmp_path_factory.mktemp("tank"))


def _canvas_without_layout(width_in, height_in):
    # A layout has everything drawn twice.
    figure = Figure(figsize=(width_in, height_in))
    FigureCanvasAgg(figure)
    return figure


@pytest.fixture
def plain_figures(monkeypatch):
    """Figures in one format, coarse, not laid out: `test_command.py` writes others, as they are."""
    monkeypatch.setattr(page, "_FORMATS", {"png": {}})
    monkeypatch.setattr(page, "STYLE", {**STYLE, "savefig.dpi": 60})
    monkeypatch.setattr(figure_style, "new_canvas", _canvas_without_layout)


@pytest.fixture
def brief_loops(monkeypatch):
    """A shorter way along the net: test_closed_loop.py goes the same one for a minute."""
    monkeypatch.setattr(Trials, "follow", partialmethod(Trials.follow, 40.0 if WHOLE else 20.0))
    monkeypatch.setattr(sea, "_VEHICLES", dict(part_of([*sea._VEHICLES.items()])))
    # A picture every two seconds of half a dive at sea.
    monkeypatch.setattr(sea, "_SETUP", sea._SETUP._replace(every=50, seconds=20.0))


@pytest.fixture
def few_waters(monkeypatch):
    """The freshest water, a middle one and the saltiest; three places of the lens."""
    if WHOLE:
        return
    few = water_index.WATERS[:1] + water_index.WATERS[3::2]
    monkeypatch.setattr(water_index, "cruise", partial(water_index.cruise, waters=few))
    few_mm = (0.0, 4.0, 41.7)
    monkeypatch.setattr(water_index, "decentred", partial(water_index.decentred, lens_mm=few_mm))


@pytest.mark.parametrize("name", MODULES)
def test_an_experiment_gives_its_results(
    laboratory, plain_figures, brief_loops, few_waters, tmp_path, monkeypatch, name
):
    monkeypatch.setattr(growth_and_sun, "_SHOWN", N_FRAMES // 2)
    monkeypatch.setattr(mesh_filter, "_JUDGED", JUDGED)
    # Every eighth set of parameters that is tried.
    few = {kind: sets[:: 4 if WHOLE else 8] for kind, sets in ablation_stages._KINDS.items()}
    monkeypatch.setattr(ablation_stages, "_KINDS", few)
    found = experiment(name)
    record = save_outcome(name, found, found.run(laboratory), tmp_path)
    told = [record.sentence, *(row.ours for row in record.findings)]
    assert all(told)
    assert "nan" not in " ".join(told)
    missed = {row.what for row in record.findings if row.met is False}
    assert missed <= FOR_FULL_PICTURES
    assert record.pictures
    for one in record.pictures:
        # Something is drawn: more than axes without a curve.
        assert (tmp_path / "figures" / f"{one.file}.png").stat().st_size > 5_000


def test_bars_for_full_pictures_are_bars_of_experiments():
    """An ordinary run may meet none of them; by another name, each would fail in full only."""
    texts = [path.read_text("utf-8") for path in Path(experiments.__file__).parent.glob("*.py")]
    assert [bar for bar in FOR_FULL_PICTURES if not any(bar in text for text in texts)] == []


def test_the_filters_sentence_states_the_worst_net_and_range(monkeypatch):
    good, poor = [PrecisionRecall(1.0, 1.0)], [PrecisionRecall(1.0, 0.5)]
    frames = 2 * poor + 2 * (len(ablation_stages._RANGES) - 1) * good
    seen = ablation_stages._Seen
    papers = dict.fromkeys(chain(*ablation_stages._KINDS.values()), frames)
    monkeypatch.setattr(ablation_stages, "_see", lambda _, net: seen(net, frames, papers))
    monkeypatch.setattr(ablation_stages, "net_dive", lambda _: None)
    monkeypatch.setattr(ablation_stages, "_postures", lambda *_: [])
    monkeypatch.setattr(ablation_stages, "variants_picture", lambda *_: None)
    assert "keeps at least 50 %" in ablation_stages._run_filters(None).sentence
