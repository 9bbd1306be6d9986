"""Turn the truth of a rendered sample, `truth/rig_truth.json`, into a `rig.yaml`.

    python tools/rig_from_sample_truth.py SAMPLE/truth/rig_truth.json -o rig.yaml

The sample's conventions are those of docs/conventions.md: millimetres in `dome`, the rotation
vector (radians) after the nominal mounting, laser planes normal · X = d.
"""

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from aqualvs.errors import AqualvsError, RigError
from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import rig_from_mapping, save_rig

# As the paper names them; the truth only numbers its lasers.
_LASER_NAMES = ("horizontal", "vertical", "diagonal")


def rig_from_truth(truth: Mapping[str, Any], *, source_name: str = "truth") -> Rig:
    """Return the rig that a sample was rendered with."""
    camera, dome = truth["camera"], truth["dome"]
    content = {
        "aqualvs_rig": 1,
        "name": truth["name"],
        "image": {"width_px": camera["width"], "height_px": camera["height"]},
        "camera": {
            "fx_px": camera["fx"],
            "fy_px": camera["fy"],
            "cx_px": camera["cx"],
            "cy_px": camera["cy"],
            "distortion": camera["dist"],
            "position_mm": truth["lens_mm"],
            "rotation_deg": np.rad2deg(truth["camera_rotvec"]).tolist(),
        },
        "dome": {
            "inner_radius_mm": dome["inner_mm"],
            "thickness_mm": dome["thickness_mm"],
            "n_acrylic": dome["n_acrylic"],
        },
        "n_air": truth["n_air"],
        "water": {"n": truth["n_water"]},
        "lasers": [
            {"name": _name(i), "normal": laser["normal"], "offset_mm": laser["d_mm"]}
            for i, laser in enumerate(truth["lasers"])
        ],
        "solved_from": {"truth": source_name},
    }
    return rig_from_mapping(content, source_name=source_name)


def _name(i_laser: int) -> str:
    return _LASER_NAMES[i_laser] if i_laser < len(_LASER_NAMES) else f"laser {i_laser + 1}"


def load_truth(path: Path) -> Rig:
    """Return the rig of a `rig_truth.json`; RigError names what is wrong with the file."""
    try:
        truth = json.loads(path.read_text(encoding="utf-8"))
        return rig_from_truth(truth, source_name=path.name)
    except (OSError, ValueError) as error:
        raise RigError(f"{path}: cannot be read as JSON ({error})") from None
    except (KeyError, TypeError) as error:
        raise RigError(f"{path}: is not a sample's rig_truth.json ({error})") from None


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("truth", type=Path, help="truth/rig_truth.json of a sample")
    parser.add_argument("-o", "--output", type=Path, default=Path("rig.yaml"))
    arguments = parser.parse_args()
    try:
        save_rig(load_truth(arguments.truth), arguments.output)
    except AqualvsError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
