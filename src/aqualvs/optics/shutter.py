"""The shutter of a camera: when each row of a picture is exposed.

Times count from the picture's middle: half-way between the exposures of the first and the last row,
or of the two fields.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from aqualvs.errors import RigError
from aqualvs.geometry.arrays import FloatArray

LONGEST_S = 0.5
"""Longest readout and exposure of a video camera, in seconds; larger numbers are in other units."""

Field: TypeAlias = Literal["top", "bottom"]
FIRST_ROW: Mapping[Field, int] = {"top": 0, "bottom": 1}
"""Row of the picture that a field begins with; every other one follows."""


class ShutterKind(StrEnum):
    """Order in which rows are exposed."""

    GLOBAL = "global"
    """All rows at once."""
    ROLLING = "rolling"
    """One row after the other."""
    INTERLACED = "interlaced"
    """Every other row at once, then the rows between them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Shutter:
    """Exposure of a picture, in seconds.

    Raises `RigError` if the values contradict each other; the message names keys of the rig file.
    """

    kind: ShutterKind = ShutterKind.GLOBAL
    # From the first row to the last (rolling; negative if the last comes first, as in a picture
    # that is turned upside down), or from the first field to the second (interlaced); 0 for a
    # global shutter.
    readout: float = 0.0
    # Time that each row gathers light; 0 where it is not stated.
    exposure: float = 0.0
    # Field that an interlaced camera exposes first: "top" holds rows 0, 2, 4 and
    # so on.
    first_field: Field = "top"

    def __post_init__(self) -> None:
        lowest = -LONGEST_S if self.rolls else 0.0
        for key, value, least in (
            ("readout_ms", self.readout, lowest),
            ("exposure_ms", self.exposure, 0.0),
        ):
            if not least <= value <= LONGEST_S:
                raise RigError(
                    f"{key} is {1e3 * value:g}; write milliseconds, {1e3 * least:g} to "
                    f"{1e3 * LONGEST_S:g}"
                )
        if self.kind is ShutterKind.GLOBAL and self.readout > 0.0:
            raise RigError(
                f"readout_ms is {1e3 * self.readout:g}, but a global shutter exposes all rows at "
                "once; leave it out, or write kind: rolling"
            )
        if self.kind is not ShutterKind.GLOBAL and self.readout == 0.0:
            what = (
                "from the first row to the last, such as 20"
                if self.rolls
                else "from the first field to the second: 20 for PAL, 16.683 for NTSC"
            )
            raise RigError(f"readout_ms is missing or 0; write the milliseconds {what}")
        if not self.is_interlaced and self.first_field != "top":
            raise RigError(
                f"first_field is for interlaced cameras, but kind is {self.kind.value}; leave it "
                "out, or write kind: interlaced"
            )
        # A sensor starts its next field when it has read out the last one.
        if self.is_interlaced and self.exposure > self.readout:
            raise RigError(
                f"exposure_ms is {1e3 * self.exposure:g}, longer than the {1e3 * self.readout:g} "
                "ms from field to field; write how long one field is exposed"
            )

    @property
    def instant(self) -> bool:
        """Whether the whole picture is taken at one instant, as far as it is known."""
        return self.readout == 0.0 and self.exposure == 0.0

    @property
    def rolls(self) -> bool:
        """Whether one row is exposed after the other."""
        return self.kind is ShutterKind.ROLLING

    @property
    def needs_neighbours(self) -> bool:
        """Whether the frames beside one tell what its motion did to it: rows that roll, blur."""
        return self.rolls or self.exposure > 0.0

    @property
    def is_interlaced(self) -> bool:
        """Whether each picture holds two fields, which are frames of their own."""
        return self.kind is ShutterKind.INTERLACED

    @property
    def first_row(self) -> int:
        """First row of the field that is exposed first."""
        return FIRST_ROW[self.first_field]

    def field_of(self, index: int) -> Field | None:
        """Return the field that a frame holds; None where frames are whole pictures.

        Every picture of an interlaced camera makes two frames: 2 n is the first field of picture n,
        2 n + 1 its second.
        """
        if not self.is_interlaced:
            return None
        return "top" if (index + self.first_row) % 2 == 0 else "bottom"

    @property
    def middle_to_end(self) -> float:
        """Time from the middle of a rolling picture to the end of its last exposure, in seconds.

        0 for others: a picture that is taken at once is taken when it comes.
        """
        if not self.rolls:
            return 0.0
        return 0.5 * (abs(self.readout) + self.exposure)

    def row_times(self, rows: ArrayLike, height: int) -> FloatArray:
        """Return the middles of the exposures of rows, in seconds from the picture's middle.

        Parameters
        ----------
        rows : array-like
            Rows of the picture, the centre of the top one being 0.
        height : int
            Of the picture, in pixels.
        """
        rows = np.asarray(rows, np.float64)
        if self.is_interlaced:
            early = np.rint(rows) % 2.0 == self.first_row
            return np.where(early, -0.5, 0.5) * self.readout
        share: FloatArray = (rows + 0.5) / height - 0.5
        return share * self.readout


AT_ONCE = Shutter()
"""Shutter of a rig file that states none."""
