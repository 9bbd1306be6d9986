"""What is logged for Rerun, by a stand-in for its SDK, and where that is installed by itself.

The SDK (500 MB installed) is no part of the development set: without it, the tests with `real` in
their names are skipped.
"""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from aqualvs.errors import OptionError
from aqualvs.geometry.planes import upright_axes
from aqualvs.scanning.posture import Posture, Reason, Refusal, range_pitch_yaw
from aqualvs.scanning.scan import Label
from rerun_stand_in import Stream, replace_sdk


@pytest.fixture(scope="module")
def samples():
    from live_cases import demo_samples

    return demo_samples(8)


@pytest.fixture
def streams(monkeypatch) -> list[Stream]:
    return replace_sdk(monkeypatch)


def refused(sample, reason=Reason.NO_STRIPES, index=20):
    scan = replace(sample.scan, index=index, time_s=0.04 * index, posture=Refusal(reason, "dark"))
    return replace(sample, scan=scan, frame=None)


def test_posture_and_refusal(streams, samples, tmp_path):
    from aqualvs.recording.rerun_log import RerunLog

    with RerunLog() as log:
        log.save(tmp_path / "dive.rrd")
        for sample in samples:
            log.write(sample)
        log.write(refused(samples[-1]))
        log.write(refused(samples[-1], Reason.NO_FRAMES, 21))
        log.write(refused(samples[-1], Reason.NO_FRAMES, 21))
    (stream,) = streams
    assert stream.closed == 1
    ranges = stream.at("posture/range_m", "Scalars")
    assert [when["frame"] for when, _ in ranges] == [one.scan.index for one in samples]
    posture = samples[3].scan.posture
    value, low, high = ranges[3][1].args[0]
    sigma = posture.total_covariance[0, 0] ** 0.5
    assert (value, low, high) == pytest.approx(
        (posture.range, posture.range - sigma, posture.range + sigma)
    )
    value, low, high = stream.at("posture/yaw_deg", "Scalars")[3][1].args[0]
    assert value == pytest.approx(np.degrees(posture.yaw))
    assert high - value == pytest.approx(np.degrees(posture.total_covariance[2, 2] ** 0.5))
    told = [(when["frame"], one.args[0]) for when, one in stream.at("refusals", "TextLog")]
    assert told == [(20, "no_stripes: dark"), (21, "no_frames: dark")]
    assert stream.at("target/plane", "Clear")[0][0] == {"frame": 20, "dive": pytest.approx(0.8)}
    assert len(stream.at("posture/yaw_deg", "Clear")) == 2


def test_pictures_at_their_rate_with_their_points(streams, samples):
    from aqualvs.recording.rerun_log import RerunLog

    log = RerunLog(picture_hz=5.0, points_hz=0.0)
    for sample in samples:
        log.write(sample)
    (stream,) = streams
    pictures = stream.at("target/vehicle/camera/picture", "EncodedImage")
    marks = stream.at("target/vehicle/camera/picture/points", "Points2D")
    # 40 ms apart, at most five a second.
    assert [when["frame"] for when, _ in pictures] == [0, 5]
    assert [when for when, _ in marks] == [when for when, _ in pictures]
    assert pictures[0][1].contents.startswith(b"\xff\xd8")
    points = samples[5].scan.points
    assert np.array_equal(marks[1][1].args[0], points.pixels)
    assert np.array_equal(marks[1][1].class_ids, points.label)
    assert not stream.at("target/vehicle/points", "Points3D")
    (labels,) = stream.at("target", "AnnotationContext")
    assert {one.args[0] for one in labels[1].args[0]} == {int(one) for one in Label}


def test_target_stands_still_in_its_frame(streams, samples):
    from aqualvs.recording.rerun_log import RerunLog

    log = RerunLog(points_hz=1000.0)
    log.write(samples[0])
    ((_, pose),) = streams[0].at("target/vehicle", "Transform3D")
    ((_, cloud),) = streams[0].at("target/vehicle/points", "Points3D")
    posture, used = samples[0].scan.posture, samples[0].scan.points.used
    inliers = cloud.args[0][used] @ pose.mat3x3.T + pose.translation
    assert abs(np.median(inliers[:, 1])) < 3.0 * posture.rms
    assert np.linalg.norm(pose.translation) == pytest.approx(posture.range)
    # The dome's centre lies straight before the target's origin.
    assert pose.translation == pytest.approx([0.0, -posture.range, 0.0], abs=1e-12)


def test_plane_sigma_is_that_of_planes_drawn_from_the_covariance(streams):
    from aqualvs.recording.rerun_log import plane_sigma

    rng = np.random.default_rng(3)
    m = np.array([0.3, 1.5, -0.4])
    distance, pitch, yaw = range_pitch_yaw(m)
    root = np.diag([0.004, 0.006, 0.008]) @ [[1.0, 0.0, 0.0], [0.5, 1.0, 0.0], [-0.4, 0.2, 1.0]]
    normal = m / np.linalg.norm(m)
    posture = Posture(
        range=distance,
        pitch=pitch,
        yaw=yaw,
        covariance=root @ root.T,
        normal_in_dome=normal,
        slant_range=0.7,
        nearest=0.6,
        n_points=100,
        rms=0.001,
    )
    places = np.array([(0.0, 0.0), (0.3, 0.0), (0.0, 0.3), (-0.3, 0.2)])
    drawn = np.array([distance, pitch, yaw]) + rng.standard_normal((20000, 3)) @ root.T
    normals = np.stack([np.tan(drawn[:, 2]), np.ones(20000), np.tan(drawn[:, 1])], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    axes = upright_axes(normal)
    on_plane = distance * normal + places @ axes[:, [0, 2]].T
    # Along the old normal from the old plane to the new one.
    away = (drawn[:, :1] - normals @ on_plane.T) / (normals @ normal)[:, None]
    # 20,000 draws give a standard deviation to 0.5 %.
    assert plane_sigma(posture, places) == pytest.approx(away.std(axis=0), rel=0.03)


def test_missing_sdk(monkeypatch):
    from aqualvs.recording.rerun_log import RerunLog

    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(OptionError, match=r"pip install 'aqualvs\[rerun\]'"):
        RerunLog()


@pytest.fixture(scope="module")
def real_file(samples, tmp_path_factory):
    pytest.importorskip("rerun")
    from aqualvs.recording.rerun_log import RerunLog

    path = tmp_path_factory.mktemp("rerun") / "dive.rrd"
    with RerunLog() as log:
        log.save(path)
        for sample in (*samples, refused(samples[-1])):
            log.write(sample)
    return path


def test_real_file_is_sound(real_file):
    done = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "verify", str(real_file)],
        capture_output=True,
        text=True,
        timeout=60.0,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_real_file_read_back(real_file, samples):
    columns = {}
    for batch in read_rrd(real_file):
        columns.setdefault(batch["path"], []).extend(batch["rows"])
    ranges = [row for row in columns["/posture/range_m"] if "Scalars:scalars" in row]
    values = {row["frame"]: row["Scalars:scalars"] for row in ranges if row["Scalars:scalars"]}
    assert sorted(values) == [one.scan.index for one in samples]
    for one in samples:
        assert values[one.scan.index][0] == pytest.approx(one.scan.posture.range)
    (told,) = columns["/refusals"]
    assert (told["frame"], told["TextLog:text"]) == (20, ["no_stripes: dark"])
    (first, second) = columns["/target/vehicle/camera/picture/points"]
    assert len(first["Points2D:positions"]) == len(samples[0].scan.points)
    assert second["Points2D:class_ids"] == samples[5].scan.points.label.tolist()


def read_rrd(path):
    """Rows of a file by entity, without what is static."""
    from rerun.chunk import RrdReader

    for chunk in RrdReader(path).stream():
        if not chunk.is_static:
            found = chunk.to_record_batch()
            # Times of logging are finer than what Python's can hold.
            ours = [name for name in found.schema.names if not name.startswith("log_")]
            yield {"path": chunk.entity_path, "rows": found.select(ours).to_pylist()}
