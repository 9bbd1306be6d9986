"""Summaries of parts of a dive add up to that of the dive."""

import itertools

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from aqualvs.batch.work import _FORMAT
from aqualvs.nets.target_file import NetCheck, NetFacts
from aqualvs.results.agreement import LaserAgreement
from aqualvs.results.summary import RunSummary
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.scanning.scan import Scan, ScanPoints
from aqualvs.simulation.scenarios import example_rig
from shell_cases import scan

RIG = example_rig()


def stripes(index):
    """A scan whose points lie along the picture, so that every laser shows enough pieces."""
    rng = np.random.default_rng(index)
    n = 90
    base = scan(index)
    points = ScanPoints(
        laser=np.repeat(np.arange(3, dtype=np.int8), n),
        pixels=np.tile(np.stack([np.linspace(0, 719, n), np.linspace(0, 575, n)], 1), (3, 1))
        + rng.normal(0.0, 0.1, (3 * n, 2)),
        points_in_dome=np.tile([0.0, base.posture.range, 0.0], (3 * n, 1)),
        sigma=np.full(3 * n, 1e-3),
        intensity=rng.uniform(10, 200, 3 * n),
        width=rng.uniform(1, 5, 3 * n),
        quality=np.ones(3 * n),
        label=np.zeros(3 * n, np.uint8),
        used=np.ones(3 * n, np.bool_),
    )
    return Scan(index, base.time_s, base.posture, points, 1.33)


STRIPES = [stripes(i) for i in range(40)]


def scan_of(index, refused):
    one = STRIPES[index % len(STRIPES)]
    detail = f"stripes of laser {index}" if index % 3 else ""
    posture = Refusal(Reason.ONE_LASER, detail) if refused else one.posture
    return Scan(index, index / 25.0, posture, one.points, 1.33)


def summary():
    return RunSummary(agreement=LaserAgreement(RIG), net_check=None)


def of(scans, empty=summary):
    found = empty()
    for one in scans:
        found.add(one)
    return found


def joined(scans, cuts, folder, empty=summary):
    """The summary from the stored ones of parts."""
    found = empty()
    for first, stop in itertools.pairwise([0, *cuts, len(scans)]):
        of(scans[first:stop], empty).save(folder / "part.npz")
        found.extend(folder / "part.npz")
    return found


@given(
    n=st.integers(1, 500),
    cuts=st.lists(st.integers(1, 699), max_size=6),
    refused=st.lists(st.tuples(st.integers(0, 699), st.integers(0, 300)), max_size=4),
)
@settings(max_examples=12, deadline=None)
def test_the_parts_add_up_to_the_dive_wherever_it_is_cut(tmp_path_factory, n, cuts, refused):
    """The longest are long enough for the monitor of the lasers to thin out its frames twice."""
    gone = {i for first, length in refused for i in range(first, first + length)}
    scans = [scan_of(i, i in gone) for i in range(n)]
    whole = of(scans)
    parts = joined(scans, sorted({c for c in cuts if c < n}), tmp_path_factory.mktemp("parts"))
    np.testing.assert_array_equal(parts.ranges, whole.ranges)
    # The order counts, too: reasons that are equally frequent are listed as they came.
    assert list(parts.refused.items()) == list(whole.refused.items())
    assert parts.n_valid == whole.n_valid == n - len(gone & set(range(n)))
    for name, sampled in whole.agreement.arrays().items():
        np.testing.assert_array_equal(parts.agreement.arrays()[name], sampled, err_msg=name)


def test_few_frames_are_kept_of_many():
    found = of(scan_of(1000 + i, False) for i in range(1500))
    assert found.n_frames == 1500
    assert 24 <= len(found.agreement.arrays()["frames"]) < 48


def test_the_summary_is_that_of_the_frames(tmp_path):
    scans = [scan_of(i, i in (3, 4)) for i in range(9)]
    whole, parts = of(scans), joined(scans, [4], tmp_path)
    assert parts.to_dict() == whole.to_dict()
    assert parts.refused == {"one_laser": 2}
    expected = [one.posture.range if isinstance(one.posture, Posture) else np.nan for one in scans]
    np.testing.assert_array_equal(parts.ranges, expected)


def test_the_net_is_looked_at_in_the_same_frames(tmp_path, monkeypatch):
    """Every fifth frame of the dive is, not of the part."""
    monkeypatch.setattr(
        "aqualvs.nets.target_file.bar_of", lambda one, *_: float(one.index) if one.posture else None
    )

    def checked():
        return RunSummary(net_check=NetCheck(NetFacts("square", 0.025), "net.yaml", ()))

    scans = [scan_of(i, False) for i in range(23)]
    whole, parts = of(scans, checked), joined(scans, [7, 8], tmp_path, checked)
    assert parts.net_check.bars == whole.net_check.bars
    assert len(whole.net_check.bars) == 5


def test_other_arrays_in_the_file_need_another_format_of_pieces(tmp_path):
    """A batch goes on with the pieces of an earlier version unless the format differs."""
    found = RunSummary(net_check=NetCheck(NetFacts("square", 0.025), "net.yaml", ()))
    found.save(tmp_path / "part.npz")
    with np.load(tmp_path / "part.npz") as file:
        assert (_FORMAT, set(file.files)) == (4, {"ranges", "refusals", "bars"})


def test_a_refusal_for_the_commonest_reason_is_told_in_words():
    found = RunSummary()
    ambiguous = Refusal(Reason.AMBIGUOUS, "does the rig name all lasers?")
    for index, posture in enumerate([Refusal(Reason.NO_STRIPES), ambiguous, ambiguous]):
        found.add(Scan(index, index / 25.0, posture, ScanPoints.none(), 1.33))
    assert found.lines()[1:] == [
        "no posture: 2 ambiguous, 1 no_stripes",
        "  frame 1, ambiguous: does the rig name all lasers?",
    ]
    assert found.to_dict()["refused_example"].endswith("does the rig name all lasers?")
