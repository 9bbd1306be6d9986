"""`aqualvs check --against`: what it says moved, and what that would cost."""

import io
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from aqualvs.check.comparison import run_compare
from aqualvs.errors import RigError
from aqualvs.geometry.planes import Plane
from aqualvs.optics.lens import LensModel
from aqualvs.optics.rig import Rig, RigUncertainty, rig_moved_by, rig_parameter_names
from aqualvs.optics.rigfile import save_rig
from aqualvs.optics.shutter import Shutter, ShutterKind
from aqualvs.optics.solved import with_uncertainty
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig

NAMES = rig_parameter_names(example_rig())
SIGMAS = np.array([1e-4 if name[:2] in ("fx", "fy", "cx", "cy") else 2e-5 for name in NAMES])
KNOWN = RigUncertainty(NAMES, np.diag(SIGMAS**2))


def estimated(rig: Rig, seed: int) -> Rig:
    """Return the rig as a calibration would find it."""
    noise = SIGMAS * np.random.default_rng(seed).normal(size=len(NAMES))
    return with_uncertainty(rig_moved_by(rig, NAMES, noise), KNOWN)


def compared(new: Rig, old: Rig, folder: Path) -> str:
    save_rig(new, folder / "new.yaml")
    save_rig(old, folder / "old.yaml")
    page = io.StringIO()
    assert run_compare(folder / "new.yaml", folder / "old.yaml", Console(file=page, width=400)) == 0
    return page.getvalue()


def turned(rig: Rig, degrees: float) -> Rig:
    return rig_moved_by(rig, ("left:tilt_1",), np.array([np.tan(np.deg2rad(degrees))]))


def test_the_laser_that_moved_is_named(tmp_path: Path) -> None:
    page = compared(
        estimated(turned(example_rig(), 0.42), 1), estimated(example_rig(), 2), tmp_path
    )
    assert re.search(r"Laser 'left' moved by 0\.42 deg, [\d.]+ mm at 0\.6 m \(\d+ sigma\);", page)
    assert re.search(r"the lens stayed \([\d.]+ sigma\)", page)
    assert re.search(r"laser 'right' stayed \([\d.]+ sigma\)", page)
    assert "left turned by deg" in page


def test_chance_is_not_taken_for_a_move(tmp_path: Path) -> None:
    page = compared(estimated(example_rig(), 1), estimated(example_rig(), 2), tmp_path)
    assert "Nothing has moved that matters; the lens stayed (" in page


def test_equal_rigs_are_equal(tmp_path: Path) -> None:
    rig = estimated(example_rig(), 1)
    page = compared(rig, rig, tmp_path)
    assert "Nothing has changed: the lens, the camera, the intrinsics, the dome" in page
    assert "would read" not in page


def test_the_consequence_is_what_the_old_rig_reads(tmp_path: Path) -> None:
    """A bare camera and parallel sheets at offset b: the range is in proportion to b."""
    rig = replace(example_rig(), housing=None)
    lengths = np.array(
        [*rig.dome_from_cam.translation, *(laser.plane.offset for laser in rig.lasers)]
    )
    names = ["lens_x", "lens_y", "lens_z", *(f"{laser.name}:offset" for laser in rig.lasers)]
    longer = rig_moved_by(rig, names, 0.01 * lengths)
    page = compared(rig, longer, tmp_path)
    assert "would read 606.0 mm (+1.00%), pitch +0.00 and yaw" in page
    assert "Laser 'lower' moved by 0 deg, 1.4 mm at 0.6 m" in page


def test_without_sigmas_only_what_matters_counts(tmp_path: Path) -> None:
    page = compared(turned(example_rig(), 0.3), example_rig(), tmp_path)
    assert "Neither rig states its uncertainty" in page
    assert "Laser 'left' moved by 0.3 deg" in page
    assert "not changed at all: the lens" in page
    page = compared(turned(example_rig(), 0.01), example_rig(), tmp_path)
    assert "Nothing has moved that matters; laser 'left' moved by 0.01 deg" in page


def test_one_rig_alone_may_know_its_sigmas(tmp_path: Path) -> None:
    page = compared(estimated(turned(example_rig(), 0.42), 1), example_rig(), tmp_path)
    assert "old.yaml does not state its uncertainty; sigmas are those of the other rig." in page
    assert "Laser 'left' moved by 0.42 deg" in page


def test_what_is_significant_may_not_matter(tmp_path: Path) -> None:
    page = compared(
        estimated(turned(example_rig(), 0.02), 1), estimated(example_rig(), 2), tmp_path
    )
    assert re.search(r"Laser 'left' moved by 0\.0\d+ deg.* sigma\), too little to matter", page)


def test_lasers_of_other_names_are_compared_where_they_lie(tmp_path: Path) -> None:
    old, same = estimated(example_rig(), 2), estimated(turned(example_rig(), 0.42), 1)
    words = {"lower": "horizontal", "left": "vertical", "right": "diagonal"}
    # In another order, as a calibration may find them, with normals the other way round.
    lasers = [
        replace(
            laser, name=words[laser.name], plane=Plane(-laser.plane.normal, -laser.plane.offset)
        )
        for laser in reversed(same.lasers)
    ]
    names = tuple(
        f"{words[name.partition(':')[0]]}:{name.partition(':')[2]}" if ":" in name else name
        for name in NAMES
    )
    known = RigUncertainty(names, np.diag(SIGMAS**2))
    other = with_uncertainty(replace(same, lasers=tuple(lasers), solved_from={}), known)
    page = compared(other, old, tmp_path)
    assert "'diagonal' as 'right', 'vertical' as 'left', 'horizontal' as 'lower'." in page
    # All else is as if they had their old names.
    assert page.splitlines()[1:-1] == compared(same, old, tmp_path).splitlines()[1:]
    assert "Laser 'left' moved by 0.42 deg" in page


@pytest.mark.parametrize(
    ("new", "words"),
    [
        (bluerov2_rig(), "The pictures are 1920x1080 px and were 720x576 px"),
        (replace(example_rig(), housing=None), "Only the old rig has a dome."),
        (
            replace(example_rig(), lens=replace(example_rig().lens, model=LensModel.FISHEYE)),
            "The intrinsics cannot be compared",
        ),
        (replace(example_rig(), lasers=example_rig().lasers[:2]), "Laser 'right' is gone."),
        (
            replace(
                example_rig(),
                lasers=(*example_rig().lasers, replace(bluerov2_rig().lasers[0], name="top")),
            ),
            "Laser 'top' is new.",
        ),
        (
            replace(
                example_rig(),
                lasers=(replace(example_rig().lasers[0], name="low"), *example_rig().lasers[1:]),
            ),
            "Lasers with new names are matched by their planes: 'low' as 'lower'.",
        ),
        (
            replace(example_rig(), lasers=example_rig().lasers[:1], name="one"),
            "cannot be measured with the lasers that both rigs have",
        ),
    ],
    ids=["size", "dome", "model", "gone", "new", "renamed", "one left"],
)
def test_what_cannot_be_compared_is_said(tmp_path: Path, new: Rig, words: str) -> None:
    old = turned(example_rig(), 0.2) if new.name == "one" else example_rig()
    if new.name == "one":
        new = rig_moved_by(new, ("lens_y",), np.array([1e-3]))
    assert words in compared(new, old, tmp_path)


@pytest.mark.parametrize(
    ("distortion", "words"),
    [
        ((0.0,), "Nothing has changed: the lens, the camera, the intrinsics"),
        ((0.0, 0.0, 0.0, 0.0), "Nothing has changed: the lens, the camera, the intrinsics"),
        ((3.0,), "by distortion (no sigma is known); not changed at all: the lens, the camera"),
    ],
)
def test_coefficients_that_are_left_out_are_zero(
    tmp_path: Path, distortion: tuple[float, ...], words: str
) -> None:
    old = example_rig()
    lens = replace(old.lens, distortion=(*old.lens.distortion, *distortion))
    new = replace(old, lens=lens)
    assert words in " ".join(compared(new, old, tmp_path).split())
    assert words in " ".join(compared(old, new, tmp_path).split())


@pytest.mark.parametrize(("aspect_px", "moved"), [(0.01, False), (1.0, True)])
def test_thousandths_of_a_pixel_are_no_change_of_the_lens(
    tmp_path: Path, aspect_px: float, moved: bool
) -> None:
    """Views that agree make a combination of numbers look better known than any detector is."""
    sigmas = np.where([name in ("fx", "fy") for name in NAMES], 0.05, SIGMAS)
    covariance = np.diag(sigmas**2)
    fx, fy = NAMES.index("fx"), NAMES.index("fy")
    # fx - fy is known to 5e-4 px in each rig, or so the covariance says.
    covariance[fx, fy] = covariance[fy, fx] = (1.0 - 5e-5) * 0.05**2
    old = with_uncertainty(example_rig(), RigUncertainty(NAMES, covariance))
    step = np.array([0.01 + aspect_px, 0.01])
    page = compared(rig_moved_by(old, ("fx", "fy"), step), old, tmp_path)
    assert ("ntrinsics changed by" in page) == moved
    assert ("ntrinsics stayed" in page) != moved


ROLLING = Shutter(kind=ShutterKind.ROLLING, readout=0.02)


@pytest.mark.parametrize(
    ("new", "words"),
    [
        (
            replace(example_rig(), shutter=ROLLING),
            "The shutter is rolling, readout 20 ms and was global.",
        ),
        (
            replace(example_rig(), shutter=Shutter(exposure=0.004)),
            "The shutter is global, exposure 4 ms and was global.",
        ),
        (
            replace(example_rig(), working_range=(0.3, 0.9)),
            "The working range is 300 to 900 mm and was {near:g} to {far:g} mm.",
        ),
        (
            replace(
                example_rig(),
                lasers=(
                    replace(example_rig().lasers[0], wavelength_nm=640.0),
                    *example_rig().lasers[1:],
                ),
            ),
            "The wavelength of laser 'lower' is 640 nm and was not stated.",
        ),
    ],
    ids=["shutter", "exposure", "range", "wavelength"],
)
def test_what_has_no_sigma_is_compared_too(tmp_path: Path, new: Rig, words: str) -> None:
    near, far = example_rig().working_range
    page = compared(new, example_rig(), tmp_path)
    assert words.format(near=near * 1e3, far=far * 1e3) in page
    assert "othing has changed" not in page
    assert "Not changed at all: the lens, the camera" in page


def test_malformed_notes_name_the_file(tmp_path: Path) -> None:
    bad = replace(example_rig(), solved_from={"uncertainty": 3})
    with pytest.raises(RigError, match=r"old\.yaml: solved_from\.uncertainty"):
        compared(example_rig(), bad, tmp_path)
