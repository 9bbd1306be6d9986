"""Results of a rolling shutter are corrected alike however they come."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.batch.parts import join_dive, measure_piece
from aqualvs.batch.work import probe
from aqualvs.errors import SourceError
from aqualvs.optics.rigfile import load_rig, save_rig
from aqualvs.optics.shutter import Shutter, ShutterKind
from aqualvs.pipeline import run
from aqualvs.results.run_request import RunRequest
from aqualvs.scanning.posture import Posture
from aqualvs.scanning.scan import Scan, ScanPoints
from aqualvs.simulation.scenarios import example_rig
from aqualvs.workers import pool
from aqualvs.workers.frame_results import FrameResult, corrected_rows
from batch_cases import DEMO, RESULTS, demo_dive, without_times, work_for

RIG = replace(example_rig(), shutter=Shutter(kind=ShutterKind.ROLLING, readout=0.02))
RATES = np.array([0.1, 0.2, -0.3])
BY_RATES = np.array([[0.009, 0.0, 0.0], [0.08, -0.008, -0.005], [0.001, 0.0, -0.003]])
BY_MOTION = np.hstack([BY_RATES, np.zeros((3, 3))])


def result(i):
    """A frame of a vehicle that moves at constant rates, as its rows show it."""
    distance, pitch, yaw = np.array([0.6, 0.02, -0.01]) + RATES * 0.04 * i + BY_RATES @ RATES
    normal = np.array([np.tan(yaw), 1.0, np.tan(pitch)])
    posture = Posture(
        range=distance,
        pitch=pitch,
        yaw=yaw,
        covariance=1e-8 * np.eye(3),
        normal_in_dome=normal / np.linalg.norm(normal),
        slant_range=0.6,
        nearest=0.6,
        n_points=100,
        rms=0.0,
        by_motion=BY_MOTION,
    )
    scan = Scan(i, 0.04 * i, posture, ScanPoints.none(), 1.33)
    return FrameResult(scan, replace(posture, range=distance + 0.02))


def in_blocks_of(length, n=20, fault=None):
    for first in range(0, n, length):
        yield [result(i) for i in range(first, min(first + length, n))]
    if fault is not None:
        raise fault


def flat(blocks):
    return [one for block in blocks for one in block]


@pytest.mark.parametrize("length", [1, 2, 3, 8, 20])
def test_blocks_of_any_length_give_the_same(length):
    whole = flat(corrected_rows(in_blocks_of(20), RIG))
    found = flat(corrected_rows(in_blocks_of(length), RIG))
    assert [one.scan.index for one in found] == list(range(20))
    for one, other in zip(found, whole, strict=True):
        assert np.array_equal(one.scan.posture.numbers, other.scan.posture.numbers)
        assert np.array_equal(one.bare.numbers, other.bare.numbers)
        true = np.array([0.6, 0.02, -0.01]) + RATES * one.scan.time_s
        assert np.abs(one.scan.posture.numbers - true).max() < 2e-4
        assert one.bare.range - one.scan.posture.range == pytest.approx(0.02)


def test_none_is_lost_where_the_source_breaks_off():
    blocks = corrected_rows(in_blocks_of(3, 7, SourceError("torn")), RIG)
    found = []
    with pytest.raises(SourceError, match="torn"):
        found.extend(one.scan.index for block in blocks for one in block)
    assert found == list(range(7))


def test_results_of_other_shutters_are_as_they_were():
    blocks = list(corrected_rows(in_blocks_of(4), example_rig()))
    assert [len(block) for block in blocks] == 5 * [4]
    assert blocks[0][0].scan.posture.by_motion is BY_MOTION


def test_runs_and_batches_of_a_rolling_shutter_are_the_same(tmp_path, monkeypatch):
    monkeypatch.setattr(pool, "_MIN_FRAMES", 8)
    monkeypatch.setattr(pool, "_PART_FRAMES", 6)
    dive = demo_dive(tmp_path / "dive.mp4", 18, 6)
    rolling = replace(load_rig(DEMO / "rig.yaml"), shutter=RIG.shutter)
    save_rig(rolling, tmp_path / "rig.yaml")

    def files(name, n_processes, source=dive, rig=tmp_path / "rig.yaml", **more):
        out = tmp_path / name
        run(
            RunRequest(
                source=str(source), rig=rig, out=out, report=False, n_processes=n_processes, **more
            )
        )
        return [without_times(out / file) for file in RESULTS[:-1]]

    alone = files("alone", 1, mcap=True)
    assert files("shared", 2) == alone
    assert files("at once", 1, rig=DEMO / "rig.yaml") != alone
    # The stripes of the recording, measured again.
    assert files("again", 1, tmp_path / "alone" / "dive.mcap") == alone
    # Pieces measure the frames beside them, too.
    work = work_for(tmp_path / "batch", dive, rig=tmp_path / "rig.yaml")
    found = probe(work)
    assert [(one.first, one.lead, one.trail) for one in found.spans] == [
        (0, 0, 6),
        (0, 6, 6),
        (6, 6, 0),
    ]
    results = [measure_piece(work, found.only(number)) for number in range(3)]
    assert [one.n_frames for one in results] == [6, 6, 6]
    join_dive(work, found, results)
    assert [without_times(work.request.out / file) for file in RESULTS[:-1]] == alone
