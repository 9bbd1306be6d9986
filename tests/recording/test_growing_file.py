"""The growing file: readable by independent readers after every step of writing it."""

import errno
import os
from dataclasses import replace

import pytest

from aqualvs.recording import growing_file
from aqualvs.recording.encoding import POSTURE, TOPICS
from aqualvs.recording.growing_file import PAGE, GrowingFile
from aqualvs.sources.mcap_file import FOOTER_BYTES, HEAD_BYTES, McapFile, Op, padding_head
from recorder_cases import HistoryFile, chunk_of, played, read_by_mcap, read_by_rosbags

ALL = [topic.name for topic in TOPICS]


@pytest.fixture
def small_steps(monkeypatch):
    """Extensions as small as they can be, so that a short file has many of them."""
    monkeypatch.setattr(growing_file, "_DATA_BYTES", 2 * PAGE)
    monkeypatch.setattr(growing_file, "_INDEX_BYTES", PAGE)
    monkeypatch.setattr(growing_file, "_DATA_PER_SUMMARY", 0)


@pytest.fixture
def begin():
    """Begin a file that is closed after the test in any case."""
    files = []

    def make(path, open_file=None):
        files.append(GrowingFile(path, open_file))
        return files[-1]

    yield make
    for file in files:
        file.abandon()


def history_of(tmp_path, chunks, *, close=True):
    """Steps of writing a file, and how many of them its beginning and each chunk took."""
    opened = []

    def open_file(path):
        path.touch()
        opened.append(HistoryFile())
        return opened[0]

    file = GrowingFile(tmp_path / "dive.mcap", open_file)
    after = [len(opened[0].steps)]
    for chunk in chunks:
        file.append(chunk)
        after.append(len(opened[0].steps))
    if close:
        file._file.fileno = lambda: os.open(os.devnull, os.O_RDONLY)
        file.sync = lambda: None
        file.close()
    return opened[0].steps, after


def test_every_step_leaves_a_file_that_readers_take(tmp_path, small_steps):
    chunks = [chunk_of(n, n_messages=2 + n % 3, n_bytes=100 + 977 * (n % 7)) for n in range(1, 41)]
    steps, after = history_of(tmp_path, chunks)
    image, path = bytearray(), tmp_path / "image.mcap"
    n_extensions = 0
    for i, step in enumerate(steps, 1):
        size = len(image)
        played(image, step)
        if i < after[0]:
            continue
        n_extensions += len(image) > size
        n_whole = sum(i >= n for n in after[1:])
        n_seen = {}
        for linear in (False, True):
            found = read_by_mcap(bytes(image), linear=linear)
            n_seen[linear] = len({at_ns // 10**9 for _, at_ns, _ in found})
            # Whole chunks, in their order, none that was finished missing, none ahead of its time.
            assert [at_ns for _, at_ns, _ in found] == sorted(at_ns for _, at_ns, _ in found)
            assert n_whole <= n_seen[linear] <= n_whole + 1
            assert len(found) == sum(2 + n % 3 for n in range(1, n_seen[linear] + 1))
        assert n_seen[False] <= n_seen[True]
        if i % 5 == 0 or i == len(steps):
            path.write_bytes(image)
            own = list(McapFile(path).messages(ALL))
            assert len(own) == len(read_by_mcap(bytes(image)))
        if (len(image) > size and size) or i == len(steps):
            path.write_bytes(image)
            assert len(read_by_rosbags(path)) == len(read_by_mcap(bytes(image)))
    assert n_extensions >= 5
    assert len(found) == sum(2 + n % 3 for n in range(1, 41))


def test_a_step_cut_off_between_two_pages_does_no_harm(tmp_path, small_steps):
    """A kill stops a write where a page ends; what changes what readers see lies in one page."""
    chunks = [chunk_of(n, n_messages=3, n_bytes=50 + 1309 * (n % 5)) for n in range(1, 31)]
    steps, after = history_of(tmp_path, chunks)
    image = bytearray()
    for i, (kind, at, content) in enumerate(steps, 1):
        first_end = PAGE - at % PAGE
        if kind == "write" and i > after[0] and first_end < len(content):
            before = read_by_mcap(bytes(image))
            before_linear = read_by_mcap(bytes(image), linear=True)
            for end in (first_end, len(content) // PAGE * PAGE):
                torn = bytearray(image)
                played(torn, (kind, at, content[:end]))
                assert read_by_mcap(bytes(torn)) == before
                assert read_by_mcap(bytes(torn), linear=True) == before_linear
        played(image, (kind, at, content))


def test_what_readers_see_changes_within_a_page(tmp_path):
    """Chunks that end where a page does, as near to it as can be, and summaries of many pages."""
    opened = []

    def open_file(path):
        path.touch()
        opened.append(HistoryFile())
        return opened[0]

    file = GrowingFile(tmp_path / "dive.mcap", open_file)
    begun = len(opened[0].steps)
    for n in range(1, 700):
        chunk = chunk_of(n, n_messages=1 + n % 2, n_bytes=20)
        if n < 40:
            left = (PAGE - n % 13 - file.n_bytes - len(chunk.content)) % PAGE + PAGE
            filler = padding_head(left) + bytes(left - HEAD_BYTES)
            chunk = replace(chunk, content=chunk.content + filler)
            assert (file.n_bytes + len(chunk.content)) % PAGE == -(n % 13) % PAGE
        file.append(chunk)
    writes = [(at, content) for _, at, content in opened[0].steps[begun:]]
    heads = [(at, content) for at, content in writes if len(content) <= FOOTER_BYTES]
    counts = [(at, content) for at, content in writes if content[0] == Op.STATISTICS]
    assert len(heads) >= 2 * 699
    assert len(counts) >= 699
    for at, content in heads + counts:
        assert at // PAGE == (at + len(content) - 1) // PAGE
    file.abandon()


def test_summary_has_no_record_that_strict_readers_refuse(tmp_path, small_steps):
    """Foxglove's reader takes no footer inside a summary, nor two statistics."""
    steps, after = history_of(
        tmp_path, [chunk_of(n, n_bytes=900) for n in range(1, 150)], close=False
    )
    image = bytearray()
    sizes = set()
    for i, step in enumerate(steps, 1):
        played(image, step)
        if i < after[0] or (i % 7 and len(image) in sizes):
            continue
        sizes.add(len(image))
        at = int.from_bytes(image[-28:-20], "little")
        assert image[at - 13] == 0x0F
        kinds = []
        while at < len(image) - 37:
            kinds.append(image[at])
            at += 9 + int.from_bytes(image[at + 1 : at + 9], "little")
        assert at == len(image) - 37
        assert set(kinds) <= {0x03, 0x04, 0x08, 0x0B, 0x80}
        assert kinds.count(0x0B) == 1
    assert len(sizes) > 4


def test_closing_leaves_nothing_too_much(tmp_path, begin):
    path = tmp_path / "dive.mcap"
    file = begin(path)
    chunks = [chunk_of(n) for n in range(1, 6)]
    for chunk in chunks:
        file.append(chunk)
    assert path.stat().st_size > 8 << 20
    file.close()
    file.close()
    assert path.stat().st_size < 20_000
    assert len(read_by_mcap(path)) == len(read_by_rosbags(path)) == 15
    assert McapFile(path).count(POSTURE.name) == 10


def test_a_file_that_exists_is_left_alone(tmp_path):
    path = tmp_path / "dive.mcap"
    path.write_bytes(b"mine")
    with pytest.raises(FileExistsError):
        GrowingFile(path)
    assert path.read_bytes() == b"mine"
    assert [one.name for one in tmp_path.iterdir()] == ["dive.mcap"]


def test_works_without_hard_links(tmp_path, monkeypatch):
    def refused(*_):
        raise PermissionError(errno.EPERM, "no links here")

    monkeypatch.setattr(os, "link", refused)
    path = tmp_path / "dive.mcap"
    GrowingFile(path).close()
    assert read_by_mcap(path) == []
    with pytest.raises(FileExistsError):
        GrowingFile(path)


class FullDisk:
    """A file on a disk that takes so many bytes beyond the first ones, part of a write too."""

    def __init__(self, path):
        self._file = path.open("w+b", buffering=0)
        self.room = None

    def write(self, content):
        if self.room is None:
            return self._file.write(content)
        part = bytes(content)[: self.room]
        if not part:
            raise OSError(errno.ENOSPC, "No space left on device")
        self.room -= len(part)
        return self._file.write(part)

    def __getattr__(self, name):
        return getattr(self._file, name)

    def __enter__(self):
        return self

    def __exit__(self, *fault):
        self._file.close()


def appended_until_full(file):
    """Append chunks until the disk refuses; returns the number of the last one that it took."""
    n = 1
    while True:
        try:
            file.append(chunk_of(n + 1, n_bytes=1500))
        except OSError as full:
            if full.errno == errno.ENOSPC:
                return n
            raise
        n += 1


@pytest.mark.parametrize("room", [*range(0, 400, 37), *range(500, 60_000, 3777)])
def test_a_full_disk_spoils_nothing_and_may_be_tried_again(tmp_path, small_steps, begin, room):
    disks = []

    def open_file(path):
        disks.append(FullDisk(path))
        return disks[0]

    path = tmp_path / "dive.mcap"
    file = begin(path, open_file)
    file.append(chunk_of(1))
    disks[0].room = room
    n = appended_until_full(file)
    stored = [at_ns // 10**9 for _, at_ns, _ in read_by_mcap(path, linear=True)]
    assert sorted(set(stored)) == list(range(1, n + 1))
    assert len(set(read_by_mcap(path))) >= 3 * (n - 1)
    disks[0].room = None
    file.append(chunk_of(n + 1, n_bytes=1500))
    file.close()
    for found in (read_by_mcap(path), read_by_mcap(path, linear=True), read_by_rosbags(path)):
        assert len(found) == len(set(found)) == 3 * (n + 1)


def test_closing_on_a_full_disk_leaves_a_readable_file(tmp_path, begin):
    disks = []

    def open_file(path):
        disks.append(FullDisk(path))
        return disks[0]

    path = tmp_path / "dive.mcap"
    file = begin(path, open_file)
    file.append(chunk_of(1))
    disks[0].room = 0
    with pytest.raises(OSError, match="No space"):
        file.close()
    assert len(read_by_mcap(path)) == len(read_by_rosbags(path)) == 3
    file.close()


def test_cost_of_a_chunk_does_not_grow_with_the_dive(tmp_path):
    """Bytes written beyond the data itself, after the equivalent of hours: a fixed share."""
    opened = []

    class Counting(HistoryFile):
        n_bytes = 0

        def write(self, content):
            Counting.n_bytes += len(content)
            self._at += len(content)
            return len(content)

    def open_file(path):
        path.touch()
        opened.append(Counting())
        return opened[0]

    file = GrowingFile(tmp_path / "dive.mcap", open_file)
    chunk = chunk_of(1, n_messages=3, n_bytes=60)
    content = chunk.content + b"\x80" + (40_000).to_bytes(8, "little") + bytes(40_000)
    chunk = chunk.__class__(
        content, chunk.length, chunk.index_offsets, chunk.times_ns, chunk.sizes, chunk.counts
    )
    overhead = []
    for _ in range(4):
        before = Counting.n_bytes
        for _ in range(3600):
            file.append(chunk)
        overhead.append((Counting.n_bytes - before) / (3600 * len(content)) - 1.0)
    # Two copies of the summary for every eight of data, at the worst.
    assert max(overhead) < 0.3
