"""Options that several commands share, and which of them the user gave."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

MAX_WORKERS = 1024
"""Processes on one machine; more are a slip of the finger that would fill its memory."""

OutFolder = Annotated[
    Path, typer.Option("--out", "-o", help="Folder to write.", show_default=False)
]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace what this command wrote there before.")
]
Target = Annotated[
    str,
    typer.Option(metavar="auto|net|solid|FILE", help="What the lasers hit: a word, or a net.yaml."),
]
Detector = Annotated[
    Literal["ridge", "threshold"],
    typer.Option(help="Stripe detector; threshold is the paper's, for comparison."),
]
MeshFilter = Annotated[
    Literal["none", "paper"],
    typer.Option(help="Filter for nets; paper is the paper's Algorithm 1."),
]
Fit = Annotated[
    Literal["robust", "pseudo_inverse"],
    typer.Option(help="Plane fit; pseudo_inverse is the paper's, for comparison."),
]
WaterIndex = Annotated[
    float | None, typer.Option(help="Refractive index of the water.", show_default=False)
]
Celsius = Annotated[
    float | None, typer.Option(help="Water temperature, for its index.", show_default=False)
]
Salinity = Annotated[
    float | None, typer.Option(help="Salinity in per mille, for its index.", show_default=False)
]
Refraction = Annotated[
    bool, typer.Option("--dome/--no-dome", help="Refract at the dome, or ignore it.")
]
IndexTarget = Annotated[
    Path | None,
    typer.Option(
        help="Target on the vehicle (target.yaml) that tells the water's index on the way.",
        show_default=False,
    ),
]
VehicleFileOption = Annotated[
    Path | None,
    typer.Option(
        "--vehicle-file",
        metavar="FILE",
        help="MAVLink: system ids, ground station, modes, peers, key (YAML; docs/ardusub.md).",
        show_default=False,
    ),
]
MavlinkPeer = Annotated[
    list[str] | None,
    typer.Option(
        metavar="ADDRESS",
        help="MAVLink, listening: hear nobody else, such as 192.168.2.2 or 192.168.2.0/24; "
        "repeatable.",
    ),
]
MavlinkKey = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="MAVLink: sign, and hear nobody without this key; a passphrase or 64 hex digits.",
        show_default=False,
    ),
]


def given(context: typer.Context, names: Sequence[str]) -> frozenset[str]:
    """Return which of these parameters the user gave."""
    sources = {name: context.get_parameter_source(name) for name in names}
    return frozenset(
        name for name, source in sources.items() if source and source.name != "DEFAULT"
    )
