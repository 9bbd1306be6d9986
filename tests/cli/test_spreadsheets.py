"""Files as spreadsheets and editors of other countries save them, and ports that do not exist."""

import pytest
import yaml

from aqualvs.results.summary import read_truth
from shell_cases import rig_file


@pytest.mark.parametrize("encoding", ["utf-16", "latin-1"])
def test_a_rig_in_another_encoding_is_to_be_saved_as_utf_8(encoding, tmp_path, refused):
    rig = rig_file(tmp_path)
    rig.write_bytes(f"# Größe\n{rig.read_text()}".encode(encoding))
    assert refused("check", rig) == f"{rig}: is not text in UTF-8; save it as UTF-8"


def test_a_decimal_comma_in_a_list_of_keys_is_named(tmp_path, refused):
    rig = rig_file(tmp_path)
    content = yaml.safe_load(rig.read_text())
    del content["water"]
    rig.write_text(f"{yaml.safe_dump(content)}water: {{n: 1,3333}}\n")
    assert refused("check", rig) == (
        f"{rig}: water has the key 3333, which is not a word; write numbers with a decimal point, "
        "such as 1.5, not 1,5"
    )


SEMICOLONS = "is separated by semicolons; save it with commas"


def test_semicolons_are_named(tmp_path, refused):
    rig = rig_file(tmp_path)
    table = tmp_path / "table.csv"
    table.write_text("frame;range_m;pitch_deg;yaw_deg\n0;0,5;1,0;-2,0\n")
    said = refused("run", tmp_path, "--rig", rig, "--truth", table, "-o", "out")
    assert said == f"{table}: {SEMICOLONS}"
    table.write_text("dive;rig;name\na.mp4;rig.yaml;a\n")
    assert refused("batch", table, "-o", tmp_path / "out") == f"{table}: {SEMICOLONS}"


def test_a_truth_with_a_byte_order_mark_is_read(tmp_path):
    table = tmp_path / "truth.csv"
    table.write_text("frame,range_m,pitch_deg,yaw_deg\n3,0.5,1,-2\n", encoding="utf-8-sig")
    assert read_truth(table) == {3: (0.5, 1.0, -2.0)}


@pytest.mark.parametrize(
    ("option", "address"), [("--json", "127.0.0.1:99999"), ("--mavlink", "udpout:127.0.0.1:99999")]
)
def test_ports_that_do_not_exist_are_told(option, address, tmp_path, refused):
    rig = rig_file(tmp_path)
    said = refused("live", "udp://127.0.0.1:1", "--rig", rig, option, address)
    assert address in said
    assert "with a port from 1 to 65535" in said
