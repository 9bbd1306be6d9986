"""From the words of the command line to a vehicle on MAVLink."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from aqualvs.live.mavlink_signing import load_key
from aqualvs.live.vehicle_file import VehicleSetup, load_vehicle


def vehicle_setup(file: Path | None, peers: Sequence[str] | None, key: Path | None) -> VehicleSetup:
    """Return who the vehicle is and how it is steered.

    Parameters
    ----------
    file : Path or None
        `--vehicle-file`; defaults if left out.
    peers : sequence of str or None
        `--mavlink-peer`; instead of those of the file.
    key : Path or None
        `--mavlink-key`; instead of the file's.

    Raises
    ------
    OptionError
        If a file cannot be used, or a peer is no address.
    """
    setup = VehicleSetup() if file is None else load_vehicle(file)
    link = setup.link
    if peers:
        link = replace(link, peers=tuple(peers))
    if key is not None:
        link = replace(link, key=load_key(key))
    return replace(setup, link=link)
