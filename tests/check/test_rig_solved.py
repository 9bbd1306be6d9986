"""`aqualvs check`: what it says about how a rig was calibrated, and what it does not believe."""

import io
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from aqualvs.check.rig import age_text, check_rig, run_check
from aqualvs.errors import RigError
from aqualvs.optics.rig import Rig, RigUncertainty
from aqualvs.optics.rigfile import save_rig
from aqualvs.optics.solved import SolvedStep, with_step, with_uncertainty
from aqualvs.simulation.scenarios import example_rig
from aqualvs.text import Severity

NOW = datetime(2026, 5, 20, 12, 0, tzinfo=UTC)
GOOD = {
    "lens_x": 2e-5,
    "lens_y": 2e-5,
    "lens_z": 2e-5,
    **{f"rotation_{axis}": 1e-4 for axis in "xyz"},
    "fx": 0.3,
    "fy": 0.3,
    **{f"{name}:tilt_1": 5e-5 for name in ("lower", "left", "right")},
    **{f"{name}:tilt_2": 5e-5 for name in ("lower", "left", "right")},
    **{f"{name}:offset": 2e-5 for name in ("lower", "left", "right")},
}


def solved_rig(sigmas: dict[str, float] | None = None, **steps: SolvedStep) -> Rig:
    rig = with_uncertainty(example_rig(), RigUncertainty.independent(GOOD | (sigmas or {})))
    for name, step in steps.items():
        rig = with_step(rig, name, step)
    return rig


def step(days: float = 3.0, **changes: Any) -> SolvedStep:
    fields = {"pictures": 14, "points": 3040, "rms_px": 0.09} | changes
    return SolvedStep(date=NOW - timedelta(days=days), **fields)


def said(rig: Rig, severity: Severity) -> str:
    return " ".join(f.sentence for f in check_rig(rig, NOW) if f.severity is severity)


def test_a_good_calibration_is_told_and_not_doubted() -> None:
    rig = solved_rig(
        camera=step(9), dome=step(3), lasers=step(0, extras={"surfaces": ["floor", "left"]})
    )
    assert said(rig, Severity.WARN) == ""
    told = said(rig, Severity.OK)
    assert "The camera was calibrated 9 days ago from 14 pictures with 3040 points" in told
    assert "The lasers were calibrated today" in told
    assert "At 600 mm the uncertainty of the rig leaves a systematic error of" in told


def test_a_board_in_several_pictures_is_more_than_one_surface() -> None:
    rig = solved_rig(camera=step(9), dome=step(3), lasers=step(0, extras={"surfaces": ["board"]}))
    assert said(rig, Severity.WARN) == ""


@pytest.mark.parametrize(
    ("steps", "words"),
    [
        ({"dome": step(rms_px=2.3)}, "to 2.3 px rms: good pictures leave 0.3 px or less"),
        ({"dome": step(rms_px=0.0)}, "no real picture fits that well"),
        ({"dome": step(400)}, "The calibration of the dome is more than a year old"),
        ({"dome": step(-3)}, "The date of solved_from.dome, 2026-05-23, is in the future"),
        ({"dome": step(pictures=1)}, "used 1 picture; take at least 2"),
        ({"camera": step(pictures=3)}, "used 3 pictures; take at least 5"),
        (
            {"lasers": step(pictures=1, extras={"surfaces": 1})},
            "The lasers were seen on one surface of one picture only",
        ),
        ({"lasers": step(pictures=1, extras={"surfaces": ["wall"]})}, "seen on one surface of one"),
        (
            {"dome": step(1), "lasers": step(5)},
            "The dome was calibrated after the lasers, which were found with the dome as it was",
        ),
        ({"camera": step(1), "dome": step(5)}, "run 'aqualvs calibrate dome' again"),
    ],
)
def test_confident_nonsense_is_doubted(steps: dict[str, SolvedStep], words: str) -> None:
    assert words in said(solved_rig(**steps), Severity.WARN)


@pytest.mark.parametrize(
    ("sigmas", "words"),
    [
        ({"lens_y": 3e-3}, "position of the lens in the dome is known only to 3.0 mm"),
        ({"rotation_z": np.deg2rad(1.0)}, "rotation in the dome is known only to 1.0 degrees"),
        ({"fx": 9.0}, "The focal length is known only to 1.0%"),
        ({"n_water": 5e-3}, "The water's index is known only to 0.005"),
        ({"left:tilt_2": np.deg2rad(0.6)}, "Laser 'left' is known only to 0.6 degrees and"),
        ({"left:offset": 5e-3}, "and 5 mm (one sigma); show its stripe on more surfaces"),
        (
            {"left:offset": 5e-3},
            "At 600 mm the uncertainty of the rig leaves a systematic error of",
        ),
    ],
)
def test_what_is_hardly_known_is_doubted(sigmas: dict[str, float], words: str) -> None:
    assert words in said(solved_rig(sigmas), Severity.WARN)


def test_a_spread_that_no_single_number_shows_is_found() -> None:
    """Three lens coordinates of 1.4 mm each, whose errors go together, are 2.4 mm."""
    names = ("lens_x", "lens_y", "lens_z")
    rig = with_uncertainty(example_rig(), RigUncertainty(names, np.full((3, 3), 1.4e-3**2)))
    assert "known only to 2.4 mm" in said(rig, Severity.WARN)


def test_what_is_not_written_down_is_named() -> None:
    rig = with_uncertainty(example_rig(), RigUncertainty.independent({"fx": 0.5, "left:offset": 0}))
    told = said(rig, Severity.OK)
    assert "No uncertainty is given for the lens's place; assumed (one sigma): 1 mm" in told
    assert "No uncertainty is given for the laser 'lower', the laser 'right'" in told
    assert "laser 'left'," not in told
    assert "intrinsics" not in told


@pytest.mark.parametrize(
    ("days", "words"),
    [
        (0.4, "today"),
        (1.2, "1 day ago"),
        (13.0, "13 days ago"),
        (20.0, "3 weeks ago"),
        (152.0, "5 months ago"),
        (1100.0, "3 years ago"),
    ],
)
def test_ages_in_words(days: float, words: str) -> None:
    assert age_text(NOW - timedelta(days=days), NOW) == words


def page_of(rig: Rig, folder: Path) -> list[str]:
    save_rig(rig, folder / "rig.yaml")
    page = io.StringIO()
    assert run_check(folder / "rig.yaml", Console(file=page, width=200)) == 0
    return page.getvalue().splitlines()


def rows_of(page: Sequence[str], word: str) -> list[list[float]]:
    """Numbers behind a word in the table of errors, one row for each range."""
    rows = [line.split(word)[1].split() for line in page if word in line and "ok" not in line]
    return [[float(cell) for cell in row] for row in rows if row and row[0][0].isdigit()]


def test_the_table_adds_both_errors(tmp_path: Path) -> None:
    page = page_of(solved_rig(), tmp_path)
    calibration, noise, both = (
        np.array(rows_of(page, word)) for word in (" rig ", " pixel noise ", " both ")
    )
    assert calibration.shape == (3, 4)
    # Three digits are shown.
    np.testing.assert_allclose(both, np.hypot(calibration, noise), rtol=0.01)
    np.testing.assert_allclose(both[:, 1], 0.1 * both[:, 0] / [0.3, 0.6, 1.0], rtol=0.01)


def test_a_rig_of_unknown_accuracy_has_no_such_rows(tmp_path: Path) -> None:
    page = page_of(example_rig(), tmp_path)
    assert rows_of(page, " pixel noise ")
    assert not rows_of(page, " calibration ")


def test_malformed_notes_name_the_file(tmp_path: Path) -> None:
    save_rig(replace(example_rig(), solved_from={"uncertainty": 3}), tmp_path / "rig.yaml")
    with pytest.raises(RigError, match=r"rig\.yaml: solved_from\.uncertainty does not have"):
        run_check(tmp_path / "rig.yaml")
