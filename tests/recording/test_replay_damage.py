"""A bit that flips anywhere in a recording costs the half second that it is in, and no more."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from aqualvs.errors import SourceError
from aqualvs.optics.rigfile import save_rig
from aqualvs.pipeline import run
from aqualvs.recording import DiveRecording, Recorder, RecorderOptions, Recording, is_recording
from aqualvs.recording.encoding import RIG, STRIPES, options_text, rig_exact
from aqualvs.results.run_request import RunRequest
from aqualvs.sources.mcap_file import FOOTER_BYTES, McapFile
from live_cases import demo_samples
from whole import WHOLE

N_FRAMES, STEP_NS = 48, 250_000_000
# Times four in each file.
N_FLIPS = 40 if WHOLE else 10


@pytest.fixture(scope="module")
def samples():
    """Frames of a quarter of a second each, all with stripes of their own."""
    few, found = demo_samples(3), []
    for i in range(N_FRAMES):
        sample = few[i % 3]
        at = 10**9 + STEP_NS * i
        scan = replace(sample.scan, index=i, time_s=1e-9 * STEP_NS * i)
        instants = replace(sample.instants, arrived_ns=at, scanned_ns=at + 1000)
        found.append(replace(sample, scan=scan, instants=instants, utc_ns=sample.utc_ns + at))
    return found


@pytest.fixture(scope="module")
def recordings(samples, tmp_path_factory):
    """A file that was closed, and one whose process was killed."""
    folder = tmp_path_factory.mktemp("damage")
    recording = Recording(folder / "closed.mcap", RecorderOptions(points_hz=1.0))
    for sample in samples:
        recording.write(sample)
    shutil.copyfile(folder / "closed.mcap", folder / "killed.mcap")
    recording.close()
    return folder


def content(recording):
    """Bits of every frame, by its number."""
    return {
        frame.index: b"".join(
            getattr(found, name).tobytes()
            for found in frame.peaks.values()
            for name in ("line", "position", "height", "width", "likelihood")
        )
        for frame in recording.frames(with_pictures=False)
    }


def parts(path):
    """Frames of every chunk."""
    file, found = McapFile(path), []
    for at in list(file._chunks):
        file._chunks = [at]
        found.append(sum(1 for _ in file.messages([STRIPES.name])))
    return [n for n in found if n]


def places(path, rng):
    """Return places all over a file, the heads of its records and its two ends above all."""
    size = path.stat().st_size
    chunks = np.array(McapFile(path)._chunks)
    heads = rng.choice(chunks, N_FLIPS) + rng.integers(0, 60, N_FLIPS)
    end = chunks[-1] + 4000
    return np.concatenate(
        [
            rng.integers(0, min(end, size), N_FLIPS),
            np.minimum(heads, size - 1),
            rng.integers(0, chunks[0], N_FLIPS // 2),
            size - 1 - rng.integers(0, FOOTER_BYTES, N_FLIPS // 4),
            size - 1 - rng.integers(0, min(12_000, size // 2), N_FLIPS),
        ]
    )


@pytest.mark.parametrize("name", ["closed", "killed"])
def test_a_flipped_bit_loses_at_most_its_chunk(name, recordings, samples, tmp_path):
    path = tmp_path / "dive.mcap"
    shutil.copyfile(recordings / f"{name}.mcap", path)
    whole = DiveRecording(path)
    expected, most = content(whole), max(parts(path))
    if name == "closed":
        assert len(expected) == N_FRAMES
    rig, options = rig_exact(whole.need_rig()), options_text(whole.options)
    rng = np.random.default_rng(7 if name == "closed" else 8)
    n_lost = 0
    with path.open("r+b", buffering=0) as file:
        for at in places(path, rng).tolist():
            bit = int(rng.integers(8))
            file.seek(at)
            (before,) = file.read(1)
            file.seek(at)
            file.write(bytes([before ^ (1 << bit)]))
            where = f"bit {bit} of byte {at}"
            assert is_recording(path), where
            damaged = DiveRecording(path)
            found = content(damaged)
            assert all(expected[index] == bits for index, bits in found.items()), where
            missing = sorted(set(expected) - set(found))
            assert len(missing) <= most, where
            assert missing == list(range(missing[0], missing[-1] + 1) if missing else []), where
            assert damaged.n_torn == bool(missing) or damaged.n_torn <= 1, where
            assert (rig_exact(damaged.need_rig()), options_text(damaged.options)) == (rig, options)
            n_lost += bool(missing)
            file.seek(at)
            file.write(bytes([before]))
    # Otherwise nothing was tried.
    assert n_lost > 10


def test_the_rig_is_told_again_and_at_the_end(recordings, samples, tmp_path):
    stamps = [one.log_ns for one in McapFile(recordings / "closed.mcap").messages([RIG.name])]
    seconds = [1e-9 * (stamp - stamps[0]) for stamp in stamps]
    assert seconds == pytest.approx([0.0, 1.0, 3.0, 7.0, 11.75])
    recorder = Recorder(tmp_path / "live.mcap")
    for sample in samples[:8]:
        recorder.send(sample)
    recorder.close()
    assert len(list(McapFile(tmp_path / "live.mcap").messages([RIG.name]))) >= 2


def test_an_hour_tells_its_rig_every_minute(samples, tmp_path):
    recording = Recording(tmp_path / "dive.mcap", RecorderOptions(points_hz=0.0))
    for second in range(0, 3600, 5):
        at = 10**9 * second
        instants = replace(samples[0].instants, arrived_ns=at, scanned_ns=at)
        recording.write(replace(samples[0], instants=instants, utc_ns=10**18))
    recording.close()
    found = [one.log_ns for one in McapFile(tmp_path / "dive.mcap").messages([RIG.name])]
    assert max(np.diff(found)) <= 65e9
    assert 60 <= len(found) <= 75


def test_without_any_rig_the_given_one_is_used(samples, tmp_path):
    """Recordings of earlier versions told it once; here all parts that tell it are damaged."""
    path = tmp_path / "dive.mcap"
    recording = Recording(path, RecorderOptions(points_hz=0.0))
    for sample in samples[:12]:
        recording.write(sample)
    recording.close()
    file, data = McapFile(path), bytearray(path.read_bytes())
    for at in list(file._chunks):
        file._chunks = [at]
        if any(file.messages([RIG.name])):
            data[at + 200] ^= 4
    path.write_bytes(data)
    request = RunRequest(source=str(path), rig=None, out=tmp_path / "out", report=False)
    with pytest.raises(SourceError, match=r"its rig is in none of its undamaged parts; add --rig"):
        run(request)
    save_rig(samples[0].rig, tmp_path / "rig.yaml")
    result = run(replace(request, rig=tmp_path / "rig.yaml"))
    assert "parts are damaged" in str(result.fault)
    assert 0 < result.summary.n_frames < 12
    assert result.summary.n_valid == result.summary.n_frames
