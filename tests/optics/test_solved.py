"""What calibrations note down in a rig: there and back through the file, and what is refused."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aqualvs.errors import RigError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Rig, RigUncertainty, Window, rig_parameter_names
from aqualvs.optics.rigfile import load_rig, save_rig
from aqualvs.optics.solved import (
    SolvedStep,
    file_parameter_name,
    rig_uncertainty,
    solved_steps,
    with_step,
    with_uncertainty,
)
from aqualvs.simulation.scenarios import example_rig


def random_covariance(rng: np.random.Generator, n: int, smallest: float) -> FloatArray:
    """Covariance whose numbers differ by six orders of magnitude and may nearly cancel."""
    turn, _ = np.linalg.qr(rng.normal(size=(n, n)))
    scale = 10.0 ** rng.uniform(-6.0, 0.0, n)
    covariance: FloatArray = (turn * np.geomspace(1.0, smallest, n)) @ turn.T
    return covariance * np.outer(scale, scale)


def there_and_back(rig: Rig, folder: Path) -> Rig:
    save_rig(rig, folder / "rig.yaml")
    return load_rig(folder / "rig.yaml")


def ratio_of_variances(found: FloatArray, given: FloatArray) -> FloatArray:
    """Extreme ratios of the variances of all linear combinations."""
    scale = np.sqrt(np.diag(given))
    root = np.linalg.inv(np.linalg.cholesky(given / np.outer(scale, scale)))
    return np.linalg.eigvalsh(root @ (found / np.outer(scale, scale)) @ root.T)[[0, -1]]


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 9999), smallest=st.sampled_from([1.0, 1e-3, 1e-6, 1e-10]))
def test_every_combination_survives_the_file(
    tmp_path_factory: pytest.TempPathFactory, seed: int, smallest: float
) -> None:
    rig = example_rig()
    names = rig_parameter_names(rig)
    given = random_covariance(np.random.default_rng(seed), len(names), smallest)
    noted = with_uncertainty(rig, RigUncertainty(names, given))
    found = rig_uncertainty(there_and_back(noted, tmp_path_factory.mktemp("rig")))
    assert found.names == names
    # A thousandth is promised; the smallest eigenvalue itself is only known to 1e-16 / 1e-10.
    np.testing.assert_allclose(ratio_of_variances(found.covariance, given), 1.0, rtol=2e-3)


def test_errors_that_cancel_to_five_nines_do_so_after_the_file(tmp_path: Path) -> None:
    correlation = 0.99999
    covariance = np.array([[1.0, correlation], [correlation, 1.0]]) * 1e-6
    rig = with_uncertainty(example_rig(), RigUncertainty(("lens_y", "inner_radius"), covariance))
    found = rig_uncertainty(there_and_back(rig, tmp_path)).covariance
    difference = np.array([1.0, -1.0])
    # The variance of the difference, 2e-11, comes back to the promised thousandth.
    assert difference @ found @ difference == pytest.approx(2e-11, rel=1e-3)


def test_singular_and_exact_numbers_survive(tmp_path: Path) -> None:
    names = ("lens_x", "lens_y", "n_air")
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = 4e-8
    rig = with_uncertainty(example_rig(), RigUncertainty(names, covariance))
    found = rig_uncertainty(there_and_back(rig, tmp_path))
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-12, atol=0.0)
    assert found.sigmas["n_air"] == 0.0


def test_the_file_is_short_and_speaks_in_units(tmp_path: Path) -> None:
    rig = example_rig()
    sigmas = {"lens_x": 1e-5, "rotation_z": np.deg2rad(0.01), "k1": 2e-3, "left:tilt_1": 1e-4}
    noted = with_uncertainty(rig, RigUncertainty.independent(sigmas))
    save_rig(noted, tmp_path / "rig.yaml")
    lines = (tmp_path / "rig.yaml").read_text().splitlines()
    assert "    parameters: [lens_x_mm, rotation_z_deg, k1, 'left:tilt_1_deg']" in lines
    assert "    sigma: [0.01, 0.01, 0.002, 0.0057296]" in lines
    assert lines[-3:] == ["    - [0.0]", "    - [0.0, 0.0]", "    - [0.0, 0.0, 0.0]"]


def test_every_name_of_a_rig_has_its_unit() -> None:
    named = {name: file_parameter_name(name) for name in rig_parameter_names(example_rig())}
    without = {name for name, in_file in named.items() if name == in_file}
    assert without == {"n_air", "n_acrylic", "n_water", "k1", "k2", "p1", "p2"}
    assert named["thickness"] == "thickness_mm"
    assert named["left:offset"] == "left:offset_mm"


def test_a_rig_without_uncertainty_has_none() -> None:
    assert rig_uncertainty(example_rig()).names == ()
    noted = with_uncertainty(example_rig(), RigUncertainty.independent({"fx": 1.0}))
    assert with_uncertainty(noted, RigUncertainty.none()).solved_from == {}


def test_numbers_of_a_laser_that_is_gone_are_left_out() -> None:
    rig = example_rig()
    noted = with_uncertainty(rig, RigUncertainty.independent({"fx": 1.0, "top:offset": 1e-3}))
    assert rig_uncertainty(noted).names == ("fx",)


@pytest.mark.parametrize(
    "window", [None, Window(Plane(np.array([0.0, 0.0, 1.0]), 0.1), np.zeros(3))]
)
def test_a_laser_that_is_taken_out_of_the_file_takes_its_numbers_along(
    tmp_path: Path, window: Window | None
) -> None:
    rig = example_rig()
    first = replace(rig.lasers[0], window=window)
    rig = replace(rig, lasers=(first, *rig.lasers[1:]))
    names = rig_parameter_names(rig)
    root = np.random.default_rng(3).normal(size=(len(names), len(names))) * 1e-4
    noted = with_uncertainty(rig, RigUncertainty(names, root @ root.T))
    found = rig_uncertainty(there_and_back(replace(noted, lasers=rig.lasers[1:]), tmp_path))
    kept = [i for i, name in enumerate(names) if not name.startswith(f"{first.name}:")]
    assert found.names == tuple(names[i] for i in kept)
    expected = (root @ root.T)[np.ix_(kept, kept)]
    np.testing.assert_allclose(found.covariance, expected, rtol=2e-3, atol=1e-11)


def test_a_laser_that_is_renamed_is_not_one_taken_out() -> None:
    rig = example_rig()
    noted = with_uncertainty(
        rig,
        RigUncertainty.independent(
            dict.fromkeys((f"{laser.name}:offset" for laser in rig.lasers), 1e-3)
        ),
    )
    renamed = replace(rig.lasers[0], name="port")
    with pytest.raises(RigError, match="which this rig does not have"):
        rig_uncertainty(replace(noted, lasers=(renamed, *rig.lasers[1:])))


def test_steps_are_kept_in_order(tmp_path: Path) -> None:
    rig = example_rig()
    date = datetime(2026, 5, 4, 9, 30, 7, tzinfo=UTC)
    lasers = SolvedStep(
        date=date, pictures=6, points=2400, rms_px=0.1234567, extras={"views": ["a.png", "b.png"]}
    )
    rig = with_uncertainty(rig, RigUncertainty.independent({"fx": 1.0}))
    rig = with_step(rig, "lasers", lasers)
    rig = with_step(rig, "camera", replace(lasers, extras={}))
    loaded = there_and_back(rig, tmp_path)
    assert list(loaded.solved_from) == ["lasers", "camera", "uncertainty"]
    assert solved_steps(loaded) == {
        "camera": replace(lasers, rms_px=0.1235, extras={}),
        "lasers": replace(lasers, rms_px=0.1235),
    }


def test_notes_of_the_user_are_no_steps() -> None:
    rig = replace(example_rig(), solved_from={"camera": "by hand", "dome": {"views": 3}, "x": 1})
    assert solved_steps(rig) == {}


def test_dates_that_yaml_has_read() -> None:
    note = {"date": datetime(2026, 5, 4, 9, 30, tzinfo=UTC).date(), "pictures": 3}
    step = solved_steps(replace(example_rig(), solved_from={"dome": note}))["dome"]
    assert step.date == datetime(2026, 5, 4, tzinfo=UTC)


@pytest.mark.parametrize(
    ("note", "words"),
    [
        ({"date": "yesterday"}, r"solved_from\.dome\.date is 'yesterday'; write date and time"),
        ({"date": "2026-05-04", "rms_px": "low"}, r"solved_from\.dome\.rms_px is 'low'"),
    ],
)
def test_malformed_steps_are_refused(note: dict[str, Any], words: str) -> None:
    with pytest.raises(RigError, match=words):
        solved_steps(replace(example_rig(), solved_from={"dome": note}))


def noted(**changes: Any) -> dict[str, Any]:
    content = {
        "parameters": ["fx_px", "fy_px", "left:offset_mm"],
        "sigma": [0.1, 0.2, 0.3],
        "correlation": [[0.5], [0.0, 0.1]],
    }
    return {**content, **changes}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("good", "does not have the keys parameters, sigma, correlation"),
        ({"sigma": [1.0]}, "does not have the keys"),
        (noted(extra=1), "does not have the keys"),
        (noted(parameters="fx_px"), "parameters is not a list"),
        (noted(parameters=["fx_px", "fy", "k1"]), r"\[1\] is 'fy'.*did you mean 'fy_px'"),
        (noted(parameters=["fx_px", ["fy_px"], "k1"]), r"\[1\] is \['fy_px'\]"),
        (noted(parameters=["fx_px", "fy_px", "up:offset_mm"]), "which this rig does not have"),
        (noted(parameters=["fx_px", "fy_px", "fx_px"]), "name every number once"),
        (noted(sigma=[1.0, 2.0]), "sigma does not have 3 numbers"),
        (noted(sigma=[1.0, 2.0, -1.0]), "sigma holds -1"),
        (noted(sigma=[1.0, 2.0, float("nan")]), r"sigma\[2\] is nan"),
        (noted(sigma=[1.0, 2.0, True]), r"sigma\[2\] is True"),
        (noted(correlation=[[0.5]]), "does not have 2 rows"),
        (noted(correlation=[[0.5], [0.1]]), r"correlation\[1\] does not have 2 numbers"),
        (noted(correlation=[[1.5], [0.0, 0.1]]), "is not that of any numbers"),
        (noted(correlation=[[0.9], [0.9, -0.9]]), "is not that of any numbers"),
    ],
)
def test_malformed_uncertainty_is_refused(content: object, words: str) -> None:
    rig = replace(example_rig(), solved_from={"uncertainty": content})
    with pytest.raises(RigError, match=words) as caught:
        rig_uncertainty(rig)
    assert "\n" not in str(caught.value)


def test_misuse_of_steps_is_a_programming_error() -> None:
    step = SolvedStep(pictures=1, points=1, rms_px=0.1)
    with pytest.raises(ValueError, match="is none of"):
        with_step(example_rig(), "sonar", step)
    with pytest.raises(ValueError, match="have fields of their own"):
        SolvedStep(pictures=1, points=1, rms_px=0.1, extras={"points": 3})
    with pytest.raises(ValueError, match="has no time zone"):
        replace(step, date=datetime(2026, 5, 4))
