"""`aqualvs design`: from options to tables, a rig that works, and pictures."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml

from aqualvs.cli.main import main
from aqualvs.design.command import designed_rig
from aqualvs.design.file import EXAMPLE, design_of_rig
from aqualvs.design.judge import predict
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.rigfile import load_rig, save_rig
from aqualvs.scanner import Scanner
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenarios import example_rig, load_scenario
from browser import open_page
from net_dives import frame_of
from shell_cases import rig_file
from whole import part_of

SMALL = ["--image", "720x576", "--fov-deg", "48", "--dome-mm", "44.25:5.75"]
SMALL += ["--lens-mm", "0,20,0", "--range-mm", "300:900", "--no-changes"]
# Slightly askew, as lasers are.
MOUNTS = [
    {"name": "lower", "position_mm": [5, 0, -160], "stripe_deg": 2},
    {"name": "left", "position_mm": [-160, 0, -5], "stripe_deg": 91},
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What one call with a file and options writes."""
    folder = tmp_path_factory.mktemp("design")
    content = {**yaml.safe_load(EXAMPLE), "mounts": MOUNTS}
    del content["lasers"]
    (folder / "design.yaml").write_text(yaml.safe_dump(content))
    assert main(["design", str(folder / "design.yaml"), *SMALL, "-o", str(folder / "out")]) == 0
    return folder / "out"


def test_help_has_an_example(capsys):
    assert main(["design", "--help"]) == 0
    assert "Example: aqualvs design" in capsys.readouterr().out


def test_the_example_is_a_design_file(tmp_path, capsys):
    assert main(["design", "--example"]) == 0
    path = tmp_path / "design.yaml"
    path.write_text(capsys.readouterr().out)
    assert main(["design", str(path), "--no-changes"]) == 0
    said = capsys.readouterr().out
    assert "rov: 1920x1080 px" in said
    for words in ("upper_left", "Expected error", "Tolerances at", "Lens ahead", "strands"):
        assert words in said
    assert max(map(len, said.splitlines()[3:9])) <= 80


def test_options_take_the_place_of_the_files_values(tmp_path, capsys):
    path = tmp_path / "design.yaml"
    main(["design", "--example"])
    path.write_text(capsys.readouterr().out)
    options = ["--lens-mm", "0,12,0", "--lasers", "2", "--no-changes", "--no-tilt"]
    assert main(["design", str(path), *options]) == 0
    said = capsys.readouterr().out
    assert "lens at (0, 12, 0) mm" in said
    assert "upper_left" not in said
    assert "Laser 'lower' is in the picture at" in said


@pytest.mark.parametrize("options", [["--lasers", "1"], ["--range-mm", "20:60", "--no-tilt"]])
def test_a_design_without_a_posture_has_no_errors_to_compare(options, capsys):
    assert main(["design", *options]) == 0
    said = capsys.readouterr().out
    assert "there is no posture." in said
    assert "no posture" in said.split("Lasers:")[1]
    for words in ("nan", "- and -", "Change of the errors", "Lens ahead", "A lens that sits"):
        assert words not in said


def test_a_range_without_a_posture_has_a_dash(capsys):
    assert main(["design", "--lasers", "2", "--no-changes", "--no-tilt"]) == 0
    said = capsys.readouterr().out
    assert "nan" not in said
    assert re.search(r"dome: - and [+-]\d.* turns yaw by - and [+-]\d\.\d\d degrees", said)


def test_a_flat_port_takes_the_place_of_the_dome(tmp_path, capfd, refused):
    options = ["--flat-mm", "12:5", "--no-changes", "--no-tilt"]
    assert main(["design", *options, "-o", str(tmp_path)]) == 0
    said = capfd.readouterr().out
    assert "flat port 12 mm ahead, 5 mm thick, lens at (0, 0, 0) mm" in said
    rig = load_rig(tmp_path / "rig.yaml")
    assert rig.dome is None
    assert rig.flat_port is not None
    assert rig.flat_port.distance == pytest.approx(0.012)
    assert "dome and flat: both are given" in refused("design", *options, "--dome-mm", "51:6")


def test_the_rig_it_writes_is_sane_and_measures_as_predicted(folder, capsys):
    assert main(["check", str(folder / "rig.yaml")]) == 0
    assert "This rig is sane" in capsys.readouterr().out
    rig = load_rig(folder / "rig.yaml")
    assert [laser.name for laser in rig.lasers] == ["lower", "left"]
    assert rig.solved_from["design"]["mounts"][0]["position_mm"] == [5.0, 0.0, -160.0]
    scene = load_scenario("wall").scene_at(0.5)
    for wall_range in (0.35, 0.8):
        ahead = SE3(np.eye(3), np.array([0.0, wall_range, 0.0]))
        picture = Renderer(rig, threads=1).render(
            replace(scene, dome_from_scene=ahead), 0.5, np.random.default_rng(1)
        )
        posture = Scanner(rig).process(frame_of(0, 0.5, picture.image)).posture
        assert posture, posture
        told = predict(design_of_rig(rig), [wall_range]).wall[0]
        found = np.array([posture.range - wall_range, posture.pitch, posture.yaw])
        # Four sigma, and 0.01 % for the glow of the sheets in the water.
        assert np.all(np.abs(found) < 4.0 * told + [1e-4 * wall_range, 0.0, 0.0])
        # The scanner's own sigma, from real residuals and the glow of the sheets, is about that.
        stated = np.sqrt(np.diag(posture.covariance))
        assert np.all((stated > 0.65 * told) & (stated < 1.5 * told))


def test_it_draws_two_pictures(folder):
    for name in ("errors.png", "picture.png"):
        image = cv2.imread(str(folder / name))
        assert image.shape[1] > 1000
        # Something is drawn: not one colour.
        assert image.std() > 10.0


def test_a_rig_that_exists_is_judged_as_it_is_and_tilted_best(tmp_path, capsys):
    path = rig_file(tmp_path)
    assert main(["design", "--rig", str(path), "--no-changes"]) == 0
    said = capsys.readouterr().out
    first, second, *_ = said.splitlines()
    assert first.startswith("Yes: meets its goals")
    assert second.startswith("Its lasers tilted best: Yes: meets its goals")
    assert "As it is" in said
    assert "With its lasers tilted best, its errors are" in said
    assert main(["design", "--rig", str(path), "--no-changes", "--no-tilt"]) == 0
    said = capsys.readouterr().out
    assert "As it is" not in said
    assert "19.9" in said  # The lower laser's tilt, asin(0.340) = 19.9 degrees.


@pytest.mark.parametrize("near", part_of([0.15, 0.2]))
def test_the_verdict_on_a_rig_is_not_that_on_its_lasers_tilted_best(near, tmp_path, capsys):
    path = tmp_path / "near.yaml"
    save_rig(replace(example_rig(), working_range=(near, 1.0)), path)
    assert main(["design", "--rig", str(path), "--no-changes", "-o", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    first, second, *_ = said.splitlines()
    seen = re.search(r"There is (a posture only at [\d-]+ mm) in the working range", said)
    assert seen
    assert first == f"No: from {1e3 * near:.0f} to 1000 mm there is {seen[1]}."
    assert second.startswith("Its lasers tilted best: ")
    # Stripes that must be seen nearer are worse farther off, by less than a factor of two.
    gain = re.search(
        r"With its lasers tilted best, its errors are (\d+)% of that, at [\d-]+ mm", said
    )
    assert gain
    assert 60 < int(gain[1]) < 200
    page = (tmp_path / "out" / "design.html").read_text(encoding="utf-8")
    assert page.index(first) < page.index("Its lasers tilted best: ")
    assert 'class="notice warn"' in page
    assert "all stripes, coloured by range; lasers tilted best.</figcaption>" in page
    assert main(["design", "--rig", str(path), "--no-changes", "--no-tilt"]) == 0
    assert capsys.readouterr().out.splitlines()[0] == first


def test_the_note_of_the_mounts_is_read_back_by_the_rig_file(tmp_path):
    rig = designed_rig(design_of_rig(example_rig()))
    note = yaml.safe_load(yaml.safe_dump(dict(rig.solved_from)))
    assert [one["name"] for one in note["design"]["mounts"]] == ["lower", "left", "right"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--image", "1920"], "--image 1920: write 2 numbers as NxN"),
        (["--range-mm", "300,5:1200"], "write 2 numbers as N:N, decimals with a point"),
        (["--lens-mm", "0,a,0"], "--lens-mm 0,a,0: write 3 numbers"),
        (["--range-mm", "900:300"], "nearest range first"),
        (["--lasers", "0"], "lasers.count is 0"),
        (["no.yaml"], "no such file"),
        (["no.yaml", "--rig", "no.yaml"], "not both"),
        (["--rig", "no.yaml", "--lasers", "2"], "says lasers itself"),
    ],
)
def test_faults_of_the_user_become_one_line(arguments, words, refused):
    assert words in refused("design", *arguments)


def test_the_page_says_the_verdict_first_and_all_that_was_printed(folder):
    page = (folder / "design.html").read_text(encoding="utf-8")
    words = re.sub(r"<style>.*?</style>|<[^>]+>", " ", page, flags=re.DOTALL)
    words = " ".join(words.split())
    assert words.index("its goals of 0.5 % and 0.5 degrees") < words.index("Expected error")
    assert words.count("Tolerances at") >= 1
    # Pictures travel with the page, and it asks nobody for anything.
    assert page.count('src="data:image/png;base64,') == 2
    assert "http" not in words
    assert page.count("<section") == page.count("</section>")


def test_all_columns_of_the_page_are_in_sight(folder, tmp_path):
    with open_page(tmp_path / "profile") as page:
        page.size(1300, 900)
        page.call("Page.navigate", url=(folder / "design.html").as_uri())
        page.wait_for("document.readyState === 'complete' && !!document.querySelector('footer')")
        hidden = "[...document.querySelectorAll('.scroll')].map(d => d.scrollWidth - d.clientWidth)"
        assert page.evaluate(hidden) == [0] * 4


def test_a_design_that_misses_its_goals_is_told_so(tmp_path, capsys):
    content = {**yaml.safe_load(EXAMPLE), "goals": {"range_percent": 0.001, "angle_deg": 0.5}}
    (tmp_path / "design.yaml").write_text(yaml.safe_dump(content))
    assert main(["design", str(tmp_path / "design.yaml"), "--no-changes", "--no-tilt"]) == 0
    first = capsys.readouterr().out.splitlines()[0]
    assert first.startswith("No: misses its goals of 0.001 % and 0.5 degrees")
