"""What the lasers hit, as a word or a short file (`net.yaml`).

::

    kind: net                 # auto, net or solid
    net:                      # what the net is said to be; a run says if it looks otherwise
      mesh: diamond           # diamond (default), square or hexagon
      bar_mm: 25
      twine_mm: 2
    mesh_filter:              # only for --mesh-filter paper; its parameters, section 5.2
      rd_theta_mm: 10
      dd_mm: 1
      r_min_mm: 15
      r_max_mm: 35

The adaptive filter needs none of this. Where the net is given, the paper's filter takes what
`mesh_filter` leaves out from it.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from aqualvs.errors import OptionError
from aqualvs.scanning.mesh import MeshFilterOptions
from aqualvs.scanning.target import TargetKind
from aqualvs.yamlfile import read_yaml

_KINDS = ", ".join(kind.value for kind in TargetKind)
_LENGTHS = ("rd_theta_mm", "dd_mm", "r_min_mm", "r_max_mm")
_NET_KEYS = ("mesh", "bar_mm", "twine_mm")
# Crossings with a line on a bar's length, on the mean of all directions (Crofton).
_CROSSINGS = {
    "diamond": 4.0 / math.pi,
    "square": 4.0 / math.pi,
    "hexagon": 4.0 / (math.sqrt(3.0) * math.pi),
}
# Least and greatest distance between strands in bars (paper, section 4.2): half a diagonal and a
# diagonal of a square mesh, side and diameter of a hexagon.
_DISTANCES = {
    "diamond": (math.sqrt(0.5), math.sqrt(2.0)),
    "square": (math.sqrt(0.5), math.sqrt(2.0)),
    "hexagon": (1.0, 2.0),
}
# Reflection over twine, as for the paper's net (section 5.2).
_REFLECTION = 5.0


@dataclass(frozen=True, slots=True)
class NetFacts:
    """What the net is said to be.

    Attributes
    ----------
    mesh : {"diamond", "square", "hexagon"}
    bar : float
        Length of one side of an opening, in metres.
    twine : float or None
        Diameter of the twine, in metres.
    """

    mesh: str
    bar: float
    twine: float | None = None

    @property
    def crossings_per_bar(self) -> float:
        """Strands that a line crosses on the length of a bar, on the mean of all directions."""
        return _CROSSINGS[self.mesh]

    def filter_lengths(self) -> dict[str, float]:
        """Return the lengths of `MeshFilterOptions` that follow from the net, in metres."""
        least, greatest = (self.bar * share for share in _DISTANCES[self.mesh])
        lengths = {"r_min": least, "r_max": greatest}
        if self.twine is not None:
            lengths["rd_theta"] = min(_REFLECTION * self.twine, least)
        return lengths


@dataclass(frozen=True, slots=True)
class TargetFacts:
    """What is known of the target beforehand.

    Attributes
    ----------
    kind : TargetKind
        What the posture is measured to.
    mesh_filter : MeshFilterOptions
        Parameters of the paper's mesh filter.
    net : NetFacts or None
        What the net is said to be, where the file says it.
    """

    kind: TargetKind = TargetKind.AUTO
    mesh_filter: MeshFilterOptions = field(default_factory=MeshFilterOptions)
    net: NetFacts | None = None


def target_facts(text: str) -> TargetFacts:
    """Return what a word (auto, net, solid) or the path of a target file says.

    Raises
    ------
    OptionError
        If it is neither, or the file says what cannot be.
    """
    if text in set(TargetKind):
        return TargetFacts(TargetKind(text))
    path = Path(text)
    if not path.exists():
        raise OptionError(f"--target {text}: neither a file nor one of {_KINDS}")
    content = read_yaml(path, "a net.yaml", OptionError)
    if not isinstance(content, dict):
        raise OptionError(f"{path}: holds no keys; write for example 'kind: net'")
    _refuse_unknown(path, "", content, ("kind", "mesh_filter", "net"))
    kind = content.get("kind", TargetKind.AUTO.value)
    if kind not in set(TargetKind):
        raise OptionError(f"{path}: kind is {kind!r}; use one of {_KINDS}")
    net = _net(path, content["net"]) if "net" in content else None
    filtering = _mesh_filter(path, content.get("mesh_filter") or {}, net)
    return TargetFacts(TargetKind(kind), filtering, net)


def _net(path: Path, content: Any) -> NetFacts:
    if not isinstance(content, dict) or "bar_mm" not in content:
        raise OptionError(f"{path}: net holds no bar_mm; give it, or leave net out")
    _refuse_unknown(path, "net.", content, _NET_KEYS)
    mesh = content.get("mesh", "diamond")
    if mesh not in _CROSSINGS:
        raise OptionError(f"{path}: net.mesh is {mesh!r}; use one of {', '.join(_CROSSINGS)}")
    twine = _metres(path, "net.twine_mm", content["twine_mm"]) if "twine_mm" in content else None
    return NetFacts(mesh, _metres(path, "net.bar_mm", content["bar_mm"]), twine)


def _metres(path: Path, place: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise OptionError(f"{path}: {place} is {value!r}; give millimetres")
    if not (math.isfinite(value) and value > 0.0):
        raise OptionError(f"{path}: {place} is {value:g}; it must be positive")
    return 1e-3 * float(value)


def _mesh_filter(path: Path, content: Any, net: NetFacts | None) -> MeshFilterOptions:
    if not isinstance(content, dict):
        raise OptionError(f"{path}: mesh_filter holds no keys; give {', '.join(_LENGTHS)}")
    _refuse_unknown(path, "mesh_filter.", content, _LENGTHS)
    lengths = {} if net is None else net.filter_lengths()
    for name, value in content.items():
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not math.isfinite(value):
            raise OptionError(f"{path}: mesh_filter.{name} is {value!r}; give millimetres")
        lengths[name.removesuffix("_mm")] = 1e-3 * value
    try:
        return MeshFilterOptions(**lengths)
    except OptionError as fault:
        raise OptionError(f"{path}: {fault}") from fault


def _refuse_unknown(
    path: Path, place: str, content: dict[Any, Any], known: tuple[str, ...]
) -> None:
    for name in content:
        if name not in known:
            raise OptionError(f"{path}: unknown key {place}{name}; known are {', '.join(known)}")
