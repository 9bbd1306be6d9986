"""Write the pictures of results that the README and the documentation show, into `docs/`.

The bundled dive as it is measured (`dive.webp`, moving), its report, the map of its net, what the
mesh filters keep of it, the errors that a design predicts, and a hold in simulation.
"""

import contextlib
import shutil
import subprocess
import tempfile
from pathlib import Path

import av
import cv2
from PIL import Image

from aqualvs.cli.main import main
from aqualvs.demo import bundled_dive

DOCS = Path(__file__).parents[1] / "docs"
# One frame of three: the dive has 25 a second.
STEP, FRAME_MS = 3, 120
WIDTH_PX, MOVING_WIDTH_PX, QUALITY = 1000, 540, 60
WINDOW_PX = (1280, 900)
BROWSER = "chromium"


def make(folder: Path) -> None:
    """Make all pictures from what the commands write into a folder."""
    # Pages show the names of their sources.
    dive, rig = Path("dive.mp4"), Path("rig.yaml")
    for given in (dive, rig):
        shutil.copy(str(bundled_dive() / str(given)), folder)
    run = folder / "run"
    _command("run", dive, "--rig", rig, "--overlay", "--net", "-o", run)
    _command("figures", run)
    lasers = ("--baseline-mm", "150", "--lasers", "3", "--range-mm", "300:1200")
    camera = ("--image", "1920x1080", "--fov-deg", "69", "--dome-mm", "51:6")
    _command("design", *camera, *lasers, "-o", folder / "design")
    _command("follow", "--sim", "--seconds", "40", "-o", folder / "follow")
    _moving(run / "overlay.mp4", DOCS / "dive.webp")
    _still(run / "net_map.png", DOCS / "net-map.webp")
    _still(run / "figures" / "figure_14.png", DOCS / "mesh-filters.webp")
    _still(folder / "design" / "errors.png", DOCS / "design-errors.webp")
    for page, name in ((run / "report.html", "report"), (folder / "follow/follow.html", "follow")):
        # The folder has another name on every machine.
        text = page.read_text(encoding="utf-8").replace(str(folder.resolve()), "/dives")
        page.write_text(text, encoding="utf-8")
        shot = folder / f"{name}.png"
        _shoot(page, shot)
        _still(shot, DOCS / f"{name}.webp")


def _command(*arguments: object) -> None:
    assert main([str(one) for one in arguments]) == 0


def _moving(video: Path, path: Path) -> None:
    with av.open(str(video)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    size = (MOVING_WIDTH_PX, round(MOVING_WIDTH_PX * frames[0].shape[0] / frames[0].shape[1]))
    first, *others = (
        Image.fromarray(cv2.resize(frame, size, interpolation=cv2.INTER_AREA))
        for frame in frames[::STEP]
    )
    first.save(
        path,
        save_all=True,
        append_images=others,
        duration=FRAME_MS,
        loop=0,
        quality=QUALITY,
        method=6,
    )


def _still(source: Path, path: Path) -> None:
    with Image.open(source) as image:
        picture = image.convert("RGB")
    picture.thumbnail((WIDTH_PX, 2 * WIDTH_PX))
    picture.save(path, quality=QUALITY + 20, method=6)


def _shoot(page: Path, path: Path) -> None:
    """Photograph the top of a page as a browser shows it."""
    size = f"--window-size={WINDOW_PX[0]},{WINDOW_PX[1]}"
    options = ["--headless", "--no-sandbox", "--hide-scrollbars", "--virtual-time-budget=8000"]
    command = [BROWSER, *options, size, f"--screenshot={path}", page.resolve().as_uri()]
    subprocess.run(command, check=True, capture_output=True, timeout=120)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as home, contextlib.chdir(home):
        make(Path(home))
