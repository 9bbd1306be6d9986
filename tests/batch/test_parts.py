"""What pieces keep for the watchers over a dive is all that these will look at."""

import itertools
from array import array

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aqualvs.batch.parts import NoteTaker, stand_ins, stored_bars, stored_ranges, write_notes
from aqualvs.nets.target_file import NetCheck, NetFacts
from aqualvs.results.summary import Tally
from aqualvs.scanning.agreement import LaserAgreement
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.scanning.scan import Scan, ScanPoints
from aqualvs.simulation.scenarios import example_rig
from aqualvs.sources.spans import UnlikeSurveyError
from shell_cases import scan

RIG = example_rig()


class Spy(LaserAgreement):
    """Remembers what it was shown of the frames that it looked at."""

    def __init__(self):
        super().__init__(RIG)
        self.seen = []

    def add(self, one):
        spy = self

        class Watched:
            posture = one.posture

            @property
            def points(self):
                spy.seen.append((one.points.pixels.tobytes(), one.posture.range))
                return one.points

        super().add(Watched())


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
    posture = Refusal(Reason.ONE_LASER) if refused else one.posture
    return Scan(index, index / 25.0, posture, one.points, 1.33)


def serial(scans):
    spy = Spy()
    for one in scans:
        spy.add(one)
    return spy


def joined(scans, cuts, folder):
    """What a watcher sees that is shown the notes of pieces."""
    spy = Spy()
    edges = [0, *cuts, len(scans)]
    for number, (first, stop) in enumerate(itertools.pairwise(edges)):
        taker = NoteTaker(first, LaserAgreement(RIG), None)
        for one in scans[first:stop]:
            taker.add(one)
        path = folder / f"{number}.npz"
        write_notes(taker.notes, path)
        for one in stand_ins(path):
            spy.add(one)
    return spy


@given(
    n=st.integers(1, 500),
    cuts=st.lists(st.integers(1, 699), max_size=6),
    refused=st.lists(st.tuples(st.integers(0, 699), st.integers(0, 300)), max_size=4),
)
@settings(max_examples=12, deadline=None)
def test_a_watcher_sees_the_same_frames_wherever_the_dive_is_cut(
    tmp_path_factory, n, cuts, refused
):
    """The longest are long enough for the watcher to thin out its frames twice."""
    gone = {i for first, length in refused for i in range(first, first + length)}
    scans = [scan_of(i, i in gone) for i in range(n)]
    whole = serial(scans)
    parts = joined(scans, sorted({c for c in cuts if c < n}), tmp_path_factory.mktemp("notes"))
    assert parts.seen == whole.seen


def test_few_frames_are_kept_of_many():
    taker = NoteTaker(1000, LaserAgreement(RIG), None)
    for i in range(1500):
        taker.add(scan_of(1000 + i, False))
    assert len(taker.notes) == 1500
    assert 48 < len(taker.notes.watched) < 150


def test_a_watcher_that_wants_more_than_was_kept_is_told_so(tmp_path):
    """A wrong verdict must not come of it: the dive is then measured in one piece."""
    taker = NoteTaker(0, LaserAgreement(RIG), None)
    for i in range(4):
        taker.add(scan_of(i, False))
    write_notes(taker.notes, tmp_path / "notes.npz")
    first = next(stand_ins(tmp_path / "notes.npz"))
    with pytest.raises(UnlikeSurveyError):
        len(first.points.pixels)


def test_the_summary_is_that_of_the_frames(tmp_path):
    scans = [scan_of(i, i in (3, 4)) for i in range(9)]
    taker = NoteTaker(0, None, None)
    whole, parts = Tally(), Tally()
    for one in scans:
        taker.add(one)
        whole.add(one)
    write_notes(taker.notes, tmp_path / "notes.npz")
    for one in stand_ins(tmp_path / "notes.npz"):
        parts.add(one)
    assert parts.facts() == whole.facts()
    assert parts.refused == {"one_laser": 2}
    expected = [one.posture.range if isinstance(one.posture, Posture) else np.nan for one in scans]
    np.testing.assert_array_equal(stored_ranges(tmp_path / "notes.npz"), expected)


def test_the_net_is_looked_at_in_the_same_frames(tmp_path, monkeypatch):
    """Its watcher looks at every fifth frame of the dive, not of the piece."""
    monkeypatch.setattr(
        "aqualvs.nets.target_file.bar_of", lambda one, *_: float(one.index) if one.posture else None
    )

    def check():
        return NetCheck(NetFacts("square", 0.025), "net.yaml", ())

    def bars(scans, n_before):
        taker = NoteTaker(n_before, None, check())
        for one in scans:
            taker.add(one)
        write_notes(taker.notes, tmp_path / "notes.npz")
        return stored_bars(tmp_path / "notes.npz")

    scans = [scan_of(i, False) for i in range(23)]
    whole = check()
    for one in scans:
        whole.add(one)
    parts = array("d")
    for first, stop in ((0, 7), (7, 8), (8, 23)):
        parts.extend(bars(scans[first:stop], first))
    assert parts == whole.bars
    assert len(parts) == 5
