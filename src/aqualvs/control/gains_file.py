"""The gains file, a short YAML with unit suffixes (docs/control.md), and its strict reader."""

import math
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import Field

from aqualvs.control.gains import (
    ControlGains,
    Drag,
    Layout,
    RangeGains,
    ThrustMap,
    VehicleFacts,
    YawGains,
)
from aqualvs.errors import OptionError
from aqualvs.schema import (
    AnyPart,
    NotNegative,
    Number,
    Positive,
    StrictPart,
    load_settings,
    parse_settings,
    si_values,
    without_unit,
)
from aqualvs.yamlfile import parse_yaml, write_text


def _in_file_units(kind: type[AnyPart], gains: object) -> AnyPart:
    """Return the part whose values `si_values` gives back, but for rounding."""

    def value_of(key: str) -> Any:
        value, part = getattr(gains, without_unit(key)), kind.model_fields[key].annotation
        if isinstance(part, type) and issubclass(part, StrictPart):
            return _in_file_units(part, value)
        # More digits than users set, fewer than rounding errors leave.
        return float(f"{math.degrees(value):.10g}") if "_deg" in key else value

    return kind(**{key: value_of(key) for key in kind.model_fields})


VERSION = 1
"""Version of the format that this package reads and writes."""
VEHICLES = ("bluerov2_heavy", "bluerov2", "videoray")
"""Vehicles whose gains come with the package."""
_KEY = "aqualvs_gains"
_HEADER = "# Gains of aqualvs for one vehicle (docs/control.md).\n"

Share = Annotated[float, Field(ge=0.0, lt=1.0, allow_inf_nan=False)]
PositiveShare = Annotated[float, Field(gt=0.0, le=1.0, allow_inf_nan=False)]


class DragPart(StrictPart):
    """Resistance along one axis."""

    linear_n_s_m: NotNegative
    quadratic_n_s2_m2: NotNegative


class ThrustPart(StrictPart):
    """Section `thrust`: thrust of an effort of 1, and the curve up to it."""

    forward_n: Positive
    backward_n: Positive
    right_n: NotNegative
    dead_band: Share = 0.0
    linear: PositiveShare = 1.0
    layout: Literal["vectored", "straight"] = "vectored"


class VehiclePart(StrictPart):
    """Section `vehicle`: its assumed properties."""

    mass_kg: Positive
    forward_drag: DragPart
    right_drag: DragPart
    thrust: ThrustPart
    turning_rate_deg_s: Positive
    climb_rate_m_s: Positive
    dome_forward_m: Number = 0.0


class RangePart(StrictPart):
    """`range`: the cascade that holds it."""

    position_per_s: Positive
    speed_per_s: Positive
    integral_per_s2: NotNegative
    lag_s: NotNegative
    swell: NotNegative = 0.0
    swell_period_s: Positive = 5.0
    swell_damping: Positive = 0.15
    greatest_speed_m_s: Positive = 0.25
    ramp_speed_m_s: Positive = 0.15
    approach_speed_m_s: Positive = 0.15
    ramp_acceleration_m_s2: Positive = 0.12
    jerk_m_s3: Positive = 30.0
    crossing_impulse_s: NotNegative = 0.0175
    crossing_share: NotNegative = 0.4


class YawPart(StrictPart):
    """`yaw`: the loop that holds it."""

    proportional_per_s: Positive
    integral_per_s2: NotNegative
    derivative: NotNegative = 0.0
    lag_s: NotNegative
    greatest_rate_deg_s: Positive = 30.0
    ramp_rate_deg_s: Positive = 15.0
    ramp_acceleration_deg_s2: Positive = 15.0
    acceleration_deg_s2: Positive = 200.0
    quiet_rate_deg_s: NotNegative = 0.8


class GainsFile(StrictPart):
    """A whole gains file."""

    aqualvs_gains: int
    name: Annotated[str, Field(min_length=1)]
    vehicle: VehiclePart
    range: RangePart
    yaw: YawPart
    rate_time_s: Positive = 0.1
    memory_s: Positive = 10.0


def load_gains(source: Path | str) -> ControlGains:
    """Return gains from a file, or those that come with the package by a vehicle's name.

    Raises `OptionError` with one line: file, place, value, remedy.
    """
    vehicle = str(source).replace("-", "_")
    if vehicle in VEHICLES:
        packaged = files("aqualvs") / "data" / "gains" / f"{vehicle}.yaml"
        content = parse_yaml(packaged.read_text(encoding="utf-8"), str(source), OptionError)
        return _gains(parse_settings(content, GainsFile, _KEY, VERSION, str(source)))
    path = Path(source)
    if path.suffix == "" and not path.exists():
        raise OptionError(
            f"{path}: neither a gains file nor one of {', '.join(VEHICLES)}; 'aqualvs tune' makes "
            "such a file"
        )
    content = load_settings(path, GainsFile, _KEY, VERSION)
    try:
        return _gains(content)
    except OptionError as fault:
        raise OptionError(f"{path}: {fault}") from fault


def save_gains(gains: ControlGains, path: Path) -> None:
    """Write a gains file.

    Raises `OutputError` if it cannot be written.
    """
    write_text(path, gains_text(gains))


def gains_text(gains: ControlGains) -> str:
    """Return gains as the text of a file."""
    content = GainsFile(
        aqualvs_gains=VERSION,
        name=gains.vehicle.name,
        vehicle=_in_file_units(VehiclePart, gains.vehicle),
        range=_in_file_units(RangePart, gains.range),
        yaw=_in_file_units(YawPart, gains.yaw),
        rate_time_s=gains.rate_time,
        memory_s=gains.memory,
    )
    text: str = yaml.safe_dump(content.model_dump(), sort_keys=False, allow_unicode=True)
    return _HEADER + text


def _gains(content: GainsFile) -> ControlGains:
    part = content.vehicle
    parts = {
        "forward_drag": Drag(**si_values(part.forward_drag)),
        "right_drag": Drag(**si_values(part.right_drag)),
        "thrust": ThrustMap(**si_values(part.thrust) | {"layout": Layout(part.thrust.layout)}),
    }
    return ControlGains(
        vehicle=VehicleFacts(name=content.name, **si_values(part) | parts),
        range=RangeGains(**si_values(content.range)),
        yaw=YawGains(**si_values(content.yaw)),
        rate_time=content.rate_time_s,
        memory=content.memory_s,
    )
