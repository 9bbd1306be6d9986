"""What the report reads of a run's folder."""

import pytest

from aqualvs.errors import SourceError
from aqualvs.report.run_data import read_track
from report_cases import make_dive


def test_a_row_without_frame_or_time_is_left_out(tmp_path):
    path = make_dive(tmp_path / "dive").folder / "posture.csv"
    whole = read_track(path)
    lines = path.read_text().splitlines(keepends=True)
    for row, column in ((2, 0), (4, 1)):
        cells = lines[row].split(",")
        cells[column] = "nan"
        lines[row] = ",".join(cells)
    path.write_text("".join(lines))
    assert len(read_track(path)) == len(whole) - 2
    path.write_text(lines[0] + lines[4])
    with pytest.raises(SourceError, match="holds no frame"):
        read_track(path)
