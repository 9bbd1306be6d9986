"""Truth files: which plane counts, and of which dive they are."""

from pathlib import Path

import pytest

from aqualvs.errors import SourceError
from aqualvs.results.summary import TruthComparison, compare_with_truth, read_truth

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


def compared(
    tmp_path: Path,
    frames: range,
    run_fps: float,
    true_fps: float,
    *,
    run_from_s: float = 0.0,
    header: str = "frame,time_s",
) -> TruthComparison:
    """Compare a run of some frames with a truth of the first 3000."""
    for name, numbers, fps, from_s, head in (
        ("posture.csv", frames, run_fps, run_from_s, "frame,time_s"),
        ("truth.csv", range(3000), true_fps, 0.0, header),
    ):
        lines = [f"{i},{from_s + i / fps:.4f},0.5,1,2" for i in numbers]
        (tmp_path / name).write_text("\n".join([f"{head},range_m,pitch_deg,yaw_deg", *lines]))
    return compare_with_truth(tmp_path / "posture.csv", tmp_path / "truth.csv")


def test_a_truth_with_the_times_of_another_dive_is_doubted(tmp_path: Path) -> None:
    assert compared(tmp_path, range(16), 8.0, 12.0).lines()[-1] == (
        f"warning: {tmp_path / 'truth.csv'}: frame 2 is 0.167 s after frame 0, but 0.250 s in "
        f"{tmp_path / 'posture.csv'}; is it the truth of this dive, or does the run of images lack "
        "--fps?"
    )
    # The truth of whole pictures, and a run of their fields.
    said = compared(tmp_path, range(16), 50.0, 25.0).doubt
    assert "frame 1 is 0.040 s after frame 0, but 0.020 s" in said
    said = compared(tmp_path, range(800, 2000, 100), 25.0, 24.0).doubt
    assert "frame 900 is 4.167 s after frame 800, but 4.000 s" in said


def test_the_times_of_the_same_dive_may_begin_elsewhere_and_drift(tmp_path: Path) -> None:
    # A part of the frames of a recording, by the clock of its computer.
    found = compared(tmp_path, range(700, 900, 3), 25.0, 25.0, run_from_s=1.7e9)
    assert (found.n_compared, found.doubt) == (67, "")
    # Rates that are called the same: half a frame apart after 500 of them.
    found = compared(tmp_path, range(3000), 30000.0 / 1001.0, 30.0)
    assert (found.n_compared, found.doubt) == (3000, "")


def test_a_truth_without_times_is_compared_by_its_frames(tmp_path: Path) -> None:
    found = compared(tmp_path, range(16), 8.0, 12.0, header="frame,clock")
    assert (found.n_compared, found.doubt) == (16, "")
