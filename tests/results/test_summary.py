"""Truth files: which plane counts."""

from pathlib import Path

import pytest

from aqualvs.errors import SourceError
from aqualvs.results.summary import read_truth

_LIT = "visible_fit_range_mm,visible_fit_pitch_deg,visible_fit_yaw_deg"


def test_the_lit_plane_counts_where_it_is_known(tmp_path: Path) -> None:
    path = tmp_path / "truth.csv"
    path.write_text(
        f"frame,range_mm,pitch_deg,yaw_deg,{_LIT}\n0,500,1,2,499,1.5,2.5\n1,600,3,4,,,\n2,,3,4,,,\n"
    )
    truth = read_truth(path)
    assert truth[0] == pytest.approx((0.499, 1.5, 2.5))
    assert truth[1] == pytest.approx((0.6, 3.0, 4.0))
    assert 2 not in truth


def test_the_lit_plane_is_in_millimetres_whatever_the_range_column(tmp_path: Path) -> None:
    path = tmp_path / "truth.csv"
    path.write_text(f"frame,range_m,pitch_deg,yaw_deg,{_LIT}\n0,0.5,1,2,499,1,2\n1,0.5,1,2,,,\n")
    assert read_truth(path)[0][0] == pytest.approx(0.499)
    assert read_truth(path)[1][0] == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("frame,range_mm,pitch_deg,yaw_deg\n0,0.6,1,2\n", "range_mm is 0.6 in the first row"),
        ("frame,range_m,pitch_deg,yaw_deg\n0,600,1,2\n", "range_m is 600 in the first row"),
        ("frame,range_m,pitch_deg,yaw_deg\n3,0.6,1,2\n3,0.7,1,2\n", "has frame 3 twice"),
    ],
)
def test_a_truth_that_cannot_be_meant_is_refused(table: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "truth.csv"
    path.write_text(table)
    with pytest.raises(SourceError, match=words):
        read_truth(path)
