"""From the words of the command line to the options of a MAVLink connection."""

from collections.abc import Sequence
from pathlib import Path

from aqualvs.live.mavlink_link import LinkOptions
from aqualvs.live.mavlink_signing import load_key


def link_options(peers: Sequence[str] | None, key: Path | None) -> LinkOptions:
    """Return the options of a connection.

    Parameters
    ----------
    peers : sequence of str or None
        `--mavlink-peer`.
    key : Path or None
        `--mavlink-key`.

    Raises
    ------
    OptionError
        If a peer is no address, or the file holds no key.
    """
    return LinkOptions(peers=tuple(peers or ()), key=None if key is None else load_key(key))
