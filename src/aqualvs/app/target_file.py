"""What the lasers hit, as a word or a short file (`net.yaml`).

::

    kind: net                 # auto, net or solid
    mesh_filter:              # only for --mesh-filter paper; its parameters, section 5.2
      rd_theta_mm: 10
      dd_mm: 1
      r_min_mm: 15
      r_max_mm: 35
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from aqualvs.errors import OptionError
from aqualvs.scanning.mesh import MeshFilterOptions
from aqualvs.scanning.target import TargetKind

_KINDS = ", ".join(kind.value for kind in TargetKind)
_LENGTHS = ("rd_theta_mm", "dd_mm", "r_min_mm", "r_max_mm")


@dataclass(frozen=True, slots=True)
class TargetFacts:
    """What is known of the target beforehand.

    Attributes
    ----------
    kind : TargetKind
        What the posture is measured to.
    mesh_filter : MeshFilterOptions
        Parameters of the paper's mesh filter.
    """

    kind: TargetKind = TargetKind.AUTO
    mesh_filter: MeshFilterOptions = field(default_factory=MeshFilterOptions)


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
    if not path.is_file():
        raise OptionError(f"--target {text}: neither a file nor one of {_KINDS}")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as fault:
        raise OptionError(f"{path}: cannot be read as YAML; check the file") from fault
    if not isinstance(content, dict):
        raise OptionError(f"{path}: holds no keys; write for example 'kind: net'")
    _refuse_unknown(path, "", content, ("kind", "mesh_filter"))
    kind = content.get("kind", TargetKind.AUTO.value)
    if kind not in set(TargetKind):
        raise OptionError(f"{path}: kind is {kind!r}; use one of {_KINDS}")
    return TargetFacts(TargetKind(kind), _mesh_filter(path, content.get("mesh_filter") or {}))


def _mesh_filter(path: Path, content: Any) -> MeshFilterOptions:
    if not isinstance(content, dict):
        raise OptionError(f"{path}: mesh_filter holds no keys; give {', '.join(_LENGTHS)}")
    _refuse_unknown(path, "mesh_filter.", content, _LENGTHS)
    lengths = {}
    for name, value in content.items():
        if isinstance(value, bool) or not isinstance(value, int | float):
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
