"""What is said of a net in a target file, against what is seen."""

from pathlib import Path

import numpy as np
import pytest

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.nets.target_file import NetCheck, NetFacts, bar_of, strand_distance, target_dict
from aqualvs.report.findings import warnings_of
from aqualvs.report.run_data import Track
from aqualvs.scanning.paper.mesh_filter import MeshFilterOptions
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.scanning.scan import Label, Scan, ScanPoints

LASERS = (
    Plane.from_normal([0.0, 0.0, 1.0], -0.1),
    Plane.from_normal([1.0, 0.0, 0.0], -0.1),
    Plane.from_normal([0.7, 0.0, 0.7], 0.05),
)
RANGE = 0.6


def crossings(bar: float, laser: Plane, roll: float) -> FloatArray:
    """Points on the 2 mm strands of a square mesh that a laser's line crosses at y = RANGE."""
    along = np.cross(laser.normal, [0.0, 1.0, 0.0])
    s = np.arange(-0.25, 0.25, 0.4e-3)
    line = laser.normal * laser.offset + s[:, None] * along + np.array([0.0, RANGE, 0.0])
    lit = np.zeros(len(s), np.bool_)
    for angle in (roll, roll + np.pi / 2):
        across = -np.sin(angle) * line[:, 0] + np.cos(angle) * line[:, 2]
        lit |= np.abs(across - bar * np.rint(across / bar)) < 1e-3
    return line[lit]


def scan_of(bar: float, roll: float, index: int = 0, *, valid: bool = True) -> Scan:
    found = [crossings(bar, laser, roll) for laser in LASERS]
    points = np.concatenate(found)
    n = len(points)
    posture = Posture(
        range=RANGE,
        pitch=0.0,
        yaw=0.0,
        covariance=np.eye(3) * 1e-6,
        normal_in_dome=np.array([0.0, 1.0, 0.0]),
        slant_range=RANGE,
        nearest=RANGE,
        n_points=n,
        rms=1e-3,
    )
    return Scan(
        index,
        0.04 * index,
        posture if valid else Refusal(Reason.COLLINEAR),
        ScanPoints(
            laser=np.repeat(np.arange(3), [len(one) for one in found]).astype(np.int8),
            pixels=np.zeros((n, 2)),
            points_in_dome=points,
            sigma=np.full(n, 1e-3),
            intensity=np.full(n, 90.0),
            width=np.full(n, 4.0),
            quality=np.full(n, 0.8),
            label=np.full(n, Label.NET, np.uint8),
            used=np.ones(n, np.bool_),
        ),
        1.34,
    )


def check_of(said: float, seen: float, n_frames: int = 60) -> NetCheck:
    check = NetCheck(NetFacts("square", said), "net.yaml", LASERS)
    for index in range(n_frames):
        check.add(scan_of(seen, 0.2 + 0.01 * index, index))
    return check


def test_the_distance_between_strands() -> None:
    strands = np.concatenate([k * 0.03 + np.linspace(0.0, 0.002, 6) for k in range(8)])
    # What lies before the net leaves a hole, which does not count.
    with_hole = strands[(strands < 0.085) | (strands > 0.2)]
    for along in (strands, with_hole, np.random.default_rng(0).permutation(strands)):
        assert strand_distance(along) == pytest.approx(0.03, abs=1e-6)
    assert strand_distance(strands[:18]) is None
    assert strand_distance(np.zeros(0)) is None


@pytest.mark.parametrize("bar", [0.02, 0.03, 0.045])
def test_the_bar_comes_out_roughly(bar: float) -> None:
    found = [bar_of(scan_of(bar, roll), LASERS, NetFacts("square", 0.9)) for roll in (0.2, 0.5)]
    for value in found:
        # The mean over all directions, for three of them; a lattice that is seen whole comes out
        # short by the share of strands that real pictures do not show.
        assert value is not None
        assert 0.7 * bar < value < 1.2 * bar


def test_the_right_net_is_passed_over_in_silence() -> None:
    check = check_of(0.03, 0.03)
    assert check.sentence() == ""
    assert check.to_dict()["words"] == ""
    assert check.to_dict()["n_frames"] == 12


@pytest.mark.parametrize("factor", [2.0, 0.5])
def test_a_net_that_looks_otherwise_is_named(factor: float) -> None:
    check = check_of(0.03 * factor, 0.03)
    seen = check.bar()
    assert seen is not None
    sentence = check.sentence()
    assert f"about {1e3 * seen:.2g} mm" in sentence
    assert f"net.yaml says {30 * factor:g} mm" in sentence
    assert "\n" not in sentence
    assert check.to_dict()["bar_said_mm"] == pytest.approx(30 * factor)


def test_little_is_not_enough_to_say_anything() -> None:
    assert check_of(0.06, 0.03, n_frames=18).bar() is None
    check = NetCheck(NetFacts("square", 0.06), "net.yaml", LASERS)
    for index in range(60):
        check.add(scan_of(0.03, 0.2, index, valid=False))
    assert check.sentence() == ""
    assert "bar_seen_mm" not in check.to_dict()


def test_the_report_warns() -> None:
    nothing = np.full((2, 3), np.nan)
    track = Track(
        frame=np.arange(2),
        time_s=np.arange(2.0),
        valid=np.ones(2, np.bool_),
        reason=np.zeros(2, np.int64),
        reasons=("",),
        posture=np.ones((2, 3)),
        sigma=nothing,
        sigma_total=nothing,
        n_points=np.full(2, 200.0),
        n_water=np.full(2, 1.34),
    )
    words = check_of(0.06, 0.03).to_dict()
    told = warnings_of(track, None, {}, {"summary": {"net_check": words}}, None, [])
    assert any(text.startswith("The net looks like one with a bar length") for text in told)
    quiet = check_of(0.03, 0.03).to_dict()
    assert not warnings_of(track, None, {}, {"summary": {"net_check": quiet}}, None, [])


def test_the_file_says_what_the_net_is(tmp_path: Path) -> None:
    path = tmp_path / "net.yaml"
    path.write_text("kind: net\nnet: {mesh: hexagon, bar_mm: 20, twine_mm: 2}\n")
    facts = target_dict(str(path))
    assert facts.net == NetFacts("hexagon", 0.02, 0.002)
    # Side and diameter of a hexagon; a reflection five times as long as the twine is thick.
    assert facts.mesh_filter == MeshFilterOptions(rd_theta=0.01, r_min=0.02, r_max=0.04)
    path.write_text("net: {bar_mm: 20, twine_mm: 8}\nmesh_filter: {r_max_mm: 50}\n")
    facts = target_dict(str(path))
    assert facts.net == NetFacts("diamond", 0.02, 0.008)
    assert facts.mesh_filter.r_max == 0.05
    assert facts.mesh_filter.rd_theta == facts.mesh_filter.r_min == pytest.approx(0.02 / 2**0.5)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("net: {twine_mm: 2}", "net.bar_mm is missing; add it, for example"),
        ("net: 25", "net is 25; write keys and values, for example"),
        ("net: {bar_mm: wide}", "net.bar_mm is 'wide'; write a plain number"),
        ("net: {bar_mm: 0}", "net.bar_mm is 0; it must be greater than 0"),
        (
            "net: {bar_mm: 20, mesh: knitted}",
            "net.mesh is 'knitted'; write 'diamond', 'square' or 'hexagon'",
        ),
        (
            "net: {bar_mm: 20, colour: green}",
            "net.colour is not a key of a net.yaml; allowed here: bar_mm",
        ),
    ],
)
def test_bad_nets_are_named(tmp_path: Path, content: str, words: str) -> None:
    path = tmp_path / "net.yaml"
    path.write_text(content)
    with pytest.raises(OptionError, match=str(path)) as caught:
        target_dict(str(path))
    assert words in str(caught.value)
