"""The target that a user expects: a word or a short file (`net.yaml`), and the check against it.

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

The adaptive filter needs none of this. Where the net is given, the paper's filter derives from it
what `mesh_filter` leaves out. `NetRequest` holds the options of a run's net condition.

`NetCheck` compares the net in view with the file. Along a laser's line the distances between
strands depend on the roll of the mesh; over three lasers and a dive their mean gives the bar. For
parallel lines thrown at random on a net with a length L of twine on every square metre it is
pi / (2 L) (Crofton); L is 2 / bar for square and diamond meshes and 2 / (sqrt(3) bar) for hexagons.
"""

import math
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Rig
from aqualvs.optics.sheet import sheets_of
from aqualvs.scanning.posture import Posture
from aqualvs.scanning.scan import Label, Scan
from aqualvs.scanning.target import TargetKind
from aqualvs.schema import Positive, SchemaWords, StrictPart, twine_fault, validated
from aqualvs.yamlfile import read_yaml

if TYPE_CHECKING:
    from aqualvs.nets.condition import NetConditionOptions
    from aqualvs.scanning.paper.mesh_filter import MeshFilterOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class NetRequest:
    """Request for the condition of a net, with its options."""

    twine_mm: float | None = None  # Diameter of the bare twine, where it is known.
    stretch_m: float = 0.5  # Length of a stretch of net.
    log: Path | None = None  # The vehicle's log.
    log_offset_s: float | None = None  # Its clock minus the dive's, where it is known.

    def __post_init__(self) -> None:
        """Refuse values that cannot be."""
        for option, value in (("twine-mm", self.twine_mm), ("stretch-m", self.stretch_m)):
            if value is not None and not 0.0 < value < math.inf:
                raise OptionError(f"--{option} {value:g}: must be positive; correct it")
        # Thinner is a length in metres; thicker is the rope at a net's edge.
        thinnest_mm, thickest_mm = 0.1, 50.0
        twine = self.twine_mm
        if twine is not None and not thinnest_mm <= twine <= thickest_mm:
            raise OptionError(
                f"--twine-mm {twine:g}: give the diameter of one twine in millimetres, "
                f"{thinnest_mm:g} to {thickest_mm:g}"
            )
        if self.log_offset_s is not None and not math.isfinite(self.log_offset_s):
            raise OptionError(f"--log-offset-s {self.log_offset_s:g}: give a number of seconds")

    def options(self) -> "NetConditionOptions":
        """Return the options of the evaluation."""
        from aqualvs.nets.condition import NetConditionOptions

        twine = None if self.twine_mm is None else 1e-3 * self.twine_mm
        return NetConditionOptions(stretch=self.stretch_m, twine=twine)

    def to_dict(self) -> dict[str, Any]:
        """Return the options for the files that are written."""
        return {"twine_mm": self.twine_mm, "stretch_m": self.stretch_m}


def net_request(
    *, wanted: bool, twine_mm: float | None, stretch_m: float | None
) -> NetRequest | None:
    """Return the request for the condition of a net, None if it is not wanted.

    Raises `OptionError` if an option is given although the condition is not wanted, or a value is
    not valid.
    """
    given = {"twine_mm": twine_mm, "stretch_m": stretch_m}
    known: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    if wanted:
        return NetRequest(**known)
    if known:
        option = next(iter(known)).replace("_", "-")
        raise OptionError(f"--{option}: is for the condition of the net; add --net")
    return None


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


@dataclass(frozen=True, slots=True)
class NetFacts:
    """The net as described by the target file."""

    mesh: str  # "diamond", "square" or "hexagon".
    bar: float  # Length of one side of an opening, in metres.
    twine: float | None = None  # Diameter of the twine, in metres.

    def filter_lengths(self) -> dict[str, float]:
        """Return the lengths of `MeshFilterOptions` that follow from the net, in metres."""
        least, greatest = (self.bar * share for share in _DISTANCES[self.mesh])
        lengths = {"r_min": least, "r_max": greatest}
        if self.twine is not None:
            # Reflection over twine, as for the paper's net (section 5.2).
            lengths["rd_theta"] = min(5.0 * self.twine, least)
        return lengths


class _NetPart(StrictPart):
    bar_mm: Positive
    mesh: Literal["diamond", "square", "hexagon"] = "diamond"
    twine_mm: Positive | None = None


class _FilterPart(StrictPart):
    rd_theta_mm: Positive | None = None
    dd_mm: Positive | None = None
    r_min_mm: Positive | None = None
    r_max_mm: Positive | None = None


class _TargetFile(StrictPart):
    kind: Literal["auto", "net", "solid"] = "auto"
    net: _NetPart | None = None
    mesh_filter: _FilterPart | None = None


_WORDS = SchemaWords(
    file="a net.yaml",
    examples={"net": "net: {mesh: diamond, bar_mm: 25}", "mesh_filter": "mesh_filter: {dd_mm: 1}"},
)


@dataclass(frozen=True, slots=True)
class TargetFacts:
    """Prior information on the target."""

    kind: TargetKind = TargetKind.AUTO  # What the posture is measured to.
    # Parameters of the paper's mesh filter in metres, those that differ from the defaults.
    filter_lengths: Mapping[str, float] = field(default_factory=dict)
    # What the net is said to be, where the file says it.
    net: NetFacts | None = None

    @property
    def mesh_filter(self) -> "MeshFilterOptions":
        """Parameters of the paper's mesh filter."""
        # Few runs use the filter, and all read what the target is.
        from aqualvs.scanning.paper.mesh_filter import MeshFilterOptions

        return MeshFilterOptions(**self.filter_lengths)


def target_dict(text: str) -> TargetFacts:
    """Return what a word (auto, net, solid) or the path of a target file says.

    Raises `OptionError` if it is neither, or the file says what cannot be.
    """
    if text in set(TargetKind):
        return TargetFacts(TargetKind(text))
    path = Path(text)
    if not path.exists():
        raise OptionError(f"--target {text}: neither a file nor one of {', '.join(TargetKind)}")
    content = read_yaml(path, "a net.yaml", OptionError)
    if not isinstance(content, dict):
        raise OptionError(f"{path}: holds no keys; write for example 'kind: net'")
    file = validated(_TargetFile, content, path, OptionError, _WORDS)
    said, lengths = None, {}
    if (net := file.net) is not None:
        if net.twine_mm is not None and (fault := twine_fault(net.twine_mm, net.bar_mm)):
            raise OptionError(f"{path}: {fault}")
        twine = None if net.twine_mm is None else 1e-3 * net.twine_mm
        said = NetFacts(net.mesh, 1e-3 * net.bar_mm, twine)
        lengths = said.filter_lengths()
    if file.mesh_filter is not None:
        own = file.mesh_filter.model_dump(exclude_none=True)
        lengths |= {name.removesuffix("_mm"): 1e-3 * value for name, value in own.items()}
    facts = TargetFacts(TargetKind(file.kind), lengths, said)
    try:
        _ = facts.mesh_filter
    except OptionError as fault:
        raise OptionError(f"{path}: {fault}") from fault
    return facts


@dataclass(slots=True)
class NetCheck:
    """Comparison of the distances between strands with those of the described net."""

    said: NetFacts  # The target file's net.
    source: str  # The target file's name, for the sentence.
    planes: Sequence[Plane]  # Of the lasers, in `dome`.
    # Bar of the frames that were evaluated, in metres.
    bars: "array[float]" = field(default_factory=lambda: array("d"))

    def add(self, scan: Scan) -> None:
        """Evaluate a frame, if it is sampled (by its number in the dive) and shows a net."""
        every = 5  # A frame now and then is enough, and costs the run nothing.
        if scan.index % every == 0:
            bar = bar_of(scan, self.planes, self.said)
            if bar is not None:
                self.bars.append(bar)

    def bar(self) -> float | None:
        """Return the estimated bar over the dive, in metres; None where too little was seen."""
        enough_frames = 5
        return float(np.median(self.bars)) if len(self.bars) >= enough_frames else None

    def sentence(self) -> str:
        """Return the contradiction to the file in one line, "" if there is none."""
        bar = self.bar()
        # On those nets the bar of single frames is estimated at 0.67 to 1.45 of its true length.
        too_short, too_long = 0.62, 1.6
        if bar is None or too_short <= bar / self.said.bar <= too_long:
            return ""
        return (
            f"the net looks like one with a bar length of about {1e3 * bar:.2g} mm, where "
            f"{self.source} says {1e3 * self.said.bar:g} mm; postures do not depend on it"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the result for `run.yaml`."""
        bar = self.bar()
        found: dict[str, Any] = {"bar_said_mm": round(1e3 * self.said.bar, 2)}
        if bar is not None:
            found["bar_seen_mm"] = round(1e3 * bar, 1)
        return found | {"n_frames": len(self.bars), "words": self.sentence()}


def net_check(target: str, rig: Rig) -> NetCheck | None:
    """Return the check of the net that a target file describes; None where it describes none.

    `target`: a word or the path of a target file, as `target_dict` takes it. Raises `OptionError`
    as `target_dict`.
    """
    said = target_dict(target).net
    if said is None:
        return None
    camera = rig.camera()
    planes = [sheet.best_plane(camera, rig.working_range) for sheet in sheets_of(rig)]
    return NetCheck(said, target, planes)


def bar_of(scan: Scan, planes: Sequence[Plane], said: NetFacts) -> float | None:
    """Return the likely bar from the distances between strands in one frame, in metres.

    Of points labelled net, with the planes of the lasers in `dome`; the shape of the mesh is taken
    as `said`.
    """
    min_lasers = 2
    posture = scan.posture
    if not isinstance(posture, Posture):
        return None
    on_net = scan.points.label == Label.NET
    densities = []
    for index, plane in enumerate(planes):
        along = np.cross(plane.normal, posture.normal_in_dome)
        along /= np.linalg.norm(along)
        mine = on_net & (scan.points.laser == index)
        distance = strand_distance(scan.points.points_in_dome[mine] @ along)
        if distance is not None:
            densities.append(1.0 / distance)
    if len(densities) < min_lasers:
        return None
    # Strands that meet at a knot count once and dim ones are missed: found on random simulated
    # nets.
    missed = 1.2
    return float(_CROSSINGS[said.mesh] / (missed * np.mean(densities)))


def strand_distance(along: FloatArray) -> float | None:
    """Return the mean distance between the strands on one stripe, in metres.

    `along`, shape (N,): places of points on the net along the stripe, in metres, in any order.
    """
    # Largest gap in the light of one strand, in metres; least number of points of a strand, of
    # strands of a stripe, and of stripes of a frame.
    gap = 3e-3
    min_points = 3
    min_strands = 4
    if len(along) < min_strands * min_points:
        return None
    along = np.sort(along)
    gaps = np.flatnonzero(np.diff(along) > gap)
    first, last = np.append(0, gaps + 1), np.append(gaps, len(along) - 1)
    strand = last - first + 1 >= min_points
    if np.count_nonzero(strand) < min_strands:
        return None
    apart = np.diff(0.5 * (along[first] + along[last])[strand])
    # Gaps wider than this many usual distances are holes, or objects before the net.
    hole = 2.5
    return float(np.mean(apart[apart <= hole * np.median(apart)]))
