"""What watches over the lasers while a run goes on."""

from pathlib import Path

from aqualvs.errors import RigError
from aqualvs.optics.rig import Rig
from aqualvs.scanning.agreement import LaserAgreement


def agreement_of(rig: Rig, path: Path) -> LaserAgreement | None:
    """Return what watches over the lasers of a rig, None where there is nothing to watch.

    One laser agrees with itself; and where refraction at the dome is left out, the lasers disagree
    for that reason alone.

    Parameters
    ----------
    rig : Rig
        As the run uses it.
    path : Path
        Its file, for messages.

    Raises
    ------
    RigError
        If what the rig says about its uncertainty cannot be understood.
    """
    if len(rig.lasers) < 2:
        return None
    try:
        return LaserAgreement(rig)
    except RigError as error:
        raise RigError(f"{path}: {error}") from None
