"""What a user wants to know of a net."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aqualvs.errors import OptionError

if TYPE_CHECKING:
    from aqualvs.scanning.net_condition import NetConditionOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class NetRequest:
    """What to find out about a net.

    Attributes
    ----------
    twine_mm : float or None
        Diameter of the bare twine, where it is known.
    stretch_m : float
        Length of a stretch of net.
    log : Path or None
        The vehicle's log.
    log_offset_s : float or None
        Its clock minus the dive's, where it is known.
    """

    twine_mm: float | None = None
    stretch_m: float = 0.5
    log: Path | None = None
    log_offset_s: float | None = None

    def __post_init__(self) -> None:
        """Refuse values that cannot be."""
        for option, value in (("twine-mm", self.twine_mm), ("stretch-m", self.stretch_m)):
            if value is not None and not 0.0 < value < math.inf:
                raise OptionError(f"--{option} {value:g}: must be positive; correct it")
        if self.log_offset_s is not None and not math.isfinite(self.log_offset_s):
            raise OptionError(f"--log-offset-s {self.log_offset_s:g}: give a number of seconds")

    def options(self) -> "NetConditionOptions":
        """Return the options of the evaluation."""
        from aqualvs.scanning.net_condition import NetConditionOptions

        twine = None if self.twine_mm is None else 1e-3 * self.twine_mm
        return NetConditionOptions(stretch=self.stretch_m, twine=twine)

    def facts(self) -> dict[str, Any]:
        """Return them for the files that are written."""
        return {"twine_mm": self.twine_mm, "stretch_m": self.stretch_m}


def net_request(
    *, wanted: bool, twine_mm: float | None, stretch_m: float | None
) -> NetRequest | None:
    """Return what a user wants to know, None if nothing.

    Raises
    ------
    OptionError
        If something is said about it all the same, or a value cannot be.
    """
    given = {"twine_mm": twine_mm, "stretch_m": stretch_m}
    known: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    if wanted:
        return NetRequest(**known)
    if known:
        option = next(iter(known)).replace("_", "-")
        raise OptionError(f"--{option}: is about the state of the net; add --net")
    return None
