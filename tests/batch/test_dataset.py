"""Finished work is there whole, or not at all, and counts for what it was made for only."""

import threading

import pyarrow as pa
import pytest
from pyarrow import parquet

from aqualvs.batch.dataset import (
    MANIFEST,
    drafted,
    put_dive,
    read_manifest,
    read_valid_manifest,
    write_manifest,
)


@pytest.fixture
def finished(tmp_path):
    folder = tmp_path / "piece"
    with drafted(folder) as draft:
        (draft / "rows.csv").write_bytes(b"0123456789")
        write_manifest(draft, "key", {"n": 3}, ["rows.csv"])
    return folder


def test_finished_work_is_had_back(finished):
    assert read_valid_manifest(finished, "key") == {"n": 3}


def test_another_key_makes_it_worthless(finished):
    assert read_valid_manifest(finished, "other") is None


@pytest.mark.parametrize("content", [b"012345678", b"0123456780", b"01234567890"])
def test_a_changed_file_makes_it_worthless(finished, content):
    (finished / "rows.csv").write_bytes(content)
    assert read_valid_manifest(finished, "key") is None


def test_a_lost_file_or_a_torn_seal_makes_it_worthless(finished):
    text = (finished / MANIFEST).read_text()
    (finished / MANIFEST).write_text(text[: len(text) // 2])
    assert read_valid_manifest(finished, "key") is None
    (finished / MANIFEST).write_text(text)
    (finished / "rows.csv").unlink()
    assert read_valid_manifest(finished, "key") is None


def test_work_that_is_broken_off_leaves_nothing(tmp_path):
    def break_off():
        with drafted(tmp_path / "piece") as draft:
            (draft / "rows.csv").touch()
            raise RuntimeError

    with pytest.raises(RuntimeError):
        break_off()
    assert list(tmp_path.iterdir()) == []


def test_of_two_that_do_the_same_the_first_to_finish_wins(tmp_path):
    folder, ready = tmp_path / "piece", threading.Barrier(2)

    def work(word):
        with drafted(folder) as draft:
            (draft / "rows.csv").write_text(word)
            write_manifest(draft, "key", {"word": word}, ["rows.csv"])
            ready.wait(60)

    threads = [threading.Thread(target=work, args=(word,)) for word in ("one", "two")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    facts = read_valid_manifest(folder, "key")
    assert facts is not None
    assert facts["word"] == (folder / "rows.csv").read_text()
    assert [path.name for path in tmp_path.iterdir()] == ["piece"]


def test_new_work_takes_the_place_of_damaged_work(finished):
    (finished / "rows.csv").write_bytes(b"x")
    with drafted(finished) as draft:
        (draft / "rows.csv").write_bytes(b"0123456789")
        write_manifest(draft, "key", {"n": 4}, ["rows.csv"])
    assert read_valid_manifest(finished, "key") == {"n": 4}
    assert read_manifest(finished)["files"]["rows.csv"][0] == 10


def test_postures_of_whole_pictures_and_of_fields_have_one_schema(tmp_path):
    rows = {
        "fields": "frame,valid,reason,range_m,field\n0,1,,0.6,top\n1,0,no_stripes,,bottom\n",
        "whole": "frame,valid,reason,range_m\n0,1,,0.6\n1,0,no_stripes,\n",
    }
    found = {}
    for name, text in rows.items():
        folder = tmp_path / name
        folder.mkdir()
        (folder / "posture.csv").write_text(text)
        (folder / "points.parquet").write_bytes(b"points")
        put_dive(tmp_path / "dataset", name, folder)
        place = tmp_path / "dataset" / "posture" / f"dive={name}" / "posture.parquet"
        found[name] = parquet.ParquetFile(place).read()
    assert found["fields"].schema == found["whole"].schema
    assert found["fields"].schema.field("field").type == pa.string()
    assert found["fields"]["field"].to_pylist() == ["top", "bottom"]
    assert found["whole"]["field"].to_pylist() == [None, None]
