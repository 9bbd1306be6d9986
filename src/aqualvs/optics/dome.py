"""The dome: two concentric spheres with acrylic or glass between them."""

import math
from dataclasses import dataclass

from aqualvs.errors import RigError


@dataclass(frozen=True, slots=True)
class Dome:
    """A hemispherical port; its centre is the origin of `dome`.

    Attributes
    ----------
    inner_radius : float
        In metres.
    thickness : float
        In metres; zero gives an infinitely thin dome.
    n_acrylic : float
        Refractive index of the dome's material, vacuum = 1.

    Raises
    ------
    RigError
        If a value is not finite, the inner radius is not positive, the thickness is negative, or
        the index lies outside 1 to 3.
    """

    inner_radius: float
    thickness: float
    n_acrylic: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.inner_radius) and self.inner_radius > 0.0):
            raise RigError(
                f"dome has inner radius {self.inner_radius * 1e3:g} mm; it must be positive"
            )
        if not (math.isfinite(self.thickness) and self.thickness >= 0.0):
            raise RigError(
                f"dome has thickness {self.thickness * 1e3:g} mm; it must not be negative"
            )
        check_index("dome", "n_acrylic", self.n_acrylic)

    @property
    def outer_radius(self) -> float:
        """Radius of the outer sphere in metres."""
        return self.inner_radius + self.thickness


def check_index(owner: str, name: str, value: float) -> None:
    """Raise RigError unless `value` can be a refractive index relative to vacuum."""
    if not 1.0 <= value <= 3.0:
        raise RigError(
            f"{owner} has {name} = {value:g}; a refractive index relative to vacuum lies "
            "between 1 and 3"
        )
