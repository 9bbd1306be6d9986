"""The experiments by name, in the paper's order; each is imported when it is run."""

from collections.abc import Mapping, Sequence
from importlib import import_module
from types import MappingProxyType

from aqualvs.app.reproduce.experiment import Experiment
from aqualvs.errors import OptionError

_PACKAGE = "aqualvs.app.reproduce"

MODULES: Mapping[str, str] = MappingProxyType(
    {
        "rig": "rig_table",
        "dome": "dome_boards",
        "index": "water_index",
        "box": "laser_box",
        "mesh": "mesh_filter",
        "distance": "distance",
        "angles": "angles",
        "dome-or-not": "dome_or_not",
        "sea": "sea_run",
        "control": "distance_and_yaw",
        "failures": "growth_and_sun",
        "stripes": "ablation_stripes",
        "filters": "ablation_filters",
        "fits": "ablation_fits",
        "sheets": "ablation_sheets",
        "beliefs": "ablation_beliefs",
        "video": "ablation_video",
    }
)
"""Module of each experiment; `beliefs` are a wrong index and a wrong place of the lens."""


def ordered(names: Sequence[str]) -> list[str]:
    """Return these names in the catalogue's order, each once; all of them for none.

    Raises
    ------
    OptionError
        If a name is not in the catalogue.
    """
    for name in names:
        if name not in MODULES:
            raise OptionError(f"{name}: no such experiment; choose from {', '.join(MODULES)}")
    return [name for name in MODULES if not names or name in names]


def experiment(name: str) -> Experiment:
    """Return an experiment of the catalogue."""
    module = import_module(f"{_PACKAGE}.{MODULES[name]}")
    found: Experiment = module.EXPERIMENT
    return found
