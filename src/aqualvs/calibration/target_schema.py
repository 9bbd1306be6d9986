"""What `board.yaml`, `box.yaml` and `target.yaml` may contain, key by key."""

import difflib
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from aqualvs.errors import CalibrationError

Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=2, le=1000)]
Triple = Annotated[list[Number], Field(min_length=3, max_length=3)]
Corners = Annotated[list[Triple], Field(min_length=4, max_length=4)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class BoardFile(_Part):
    """`board.yaml`."""

    kind: Literal["chessboard", "charuco"] | None = None
    squares_x: Count | None = None
    squares_y: Count | None = None
    inner_corners_x: Count | None = None
    inner_corners_y: Count | None = None
    square_mm: Positive
    marker_mm: Positive | None = None
    dictionary: str | None = None
    border_mm: NotNegative = 0.0
    legacy_pattern: bool = False
    note: Any = None


class PlanePart(_Part):
    """One of `planes`: normal . X = d."""

    normal: Triple
    d: Number


class MarkerPart(_Part):
    """One of `markers`."""

    id: Annotated[int, Field(ge=0)]
    plane: str | None = None
    size_mm: Positive
    corners: Corners


class MediumPart(_Part):
    """`medium`: what the pictures were taken in."""

    n_outside_nominal: Annotated[float, Field(ge=1.0, le=2.0, allow_inf_nan=False)]


class MarkersFile(_Part):
    """`box.yaml` and `target.yaml`."""

    frame: str | None = None
    planes: dict[str, PlanePart] = {}
    family: str
    corner_order: str | None = None
    markers: Annotated[list[MarkerPart], Field(min_length=1)]
    medium: MediumPart | None = None
    note: Any = None


_File = TypeVar("_File", BoardFile, MarkersFile)

_PARTS: dict[str, type[BaseModel]] = {
    "planes": PlanePart,
    "markers": MarkerPart,
    "medium": MediumPart,
}
_EXAMPLES = {
    "kind": "kind: charuco",
    "squares_x": "squares_x: 11",
    "squares_y": "squares_y: 8",
    "inner_corners_x": "inner_corners_x: 6",
    "inner_corners_y": "inner_corners_y: 9",
    "square_mm": "square_mm: 24.0",
    "marker_mm": "marker_mm: 18.0",
    "dictionary": "dictionary: DICT_4X4_250",
    "border_mm": "border_mm: 12.0",
    "legacy_pattern": "legacy_pattern: false",
    "planes": "planes: {left: {normal: [1.0, 0.0, 0.0], d: -200.0}}",
    "normal": "normal: [1.0, 0.0, 0.0]",
    "d": "d: -200.0",
    "family": "family: DICT_APRILTAG_36h11",
    "markers": "markers: [{id: 0, size_mm: 48.0, corners: [...]}]",
    "id": "id: 0",
    "plane": "plane: left",
    "size_mm": "size_mm: 48.0",
    "corners": "corners: [[x, y, z], [x, y, z], [x, y, z], [x, y, z]]",
    "medium": "medium: {n_outside_nominal: 1.333}",
    "n_outside_nominal": "n_outside_nominal: 1.333",
}
_TYPES = {
    "float_type": "a plain number",
    "int_type": "a whole number",
    "bool_type": "true or false",
    "string_type": "a word",
    "list_type": "a list",
    "model_type": "keys and values",
    "dict_type": "keys and values",
}
_LIMITS = {
    "finite_number": "write a finite number",
    "greater_than": "it must be greater than {gt:g}",
    "greater_than_equal": "it must be at least {ge:g}",
    "less_than_equal": "it must be at most {le:g}",
    "too_short": "write {min_length} values",
    "too_long": "write {max_length} values",
}


def parse_target(content: dict[Any, Any], model: type[_File], source: str) -> _File:
    """Check the content of a target file, key by key.

    Raises
    ------
    CalibrationError
        One line on the first fault: file, place, value, remedy.
    """
    try:
        return model.model_validate(content)
    except ValidationError as error:
        faults = error.errors(include_url=False)
        unknown = [fault for fault in faults if fault["type"] == "extra_forbidden"]
        # A misspelt key explains the one that is missing.
        sentence = _sentence((unknown or faults)[0], model)
        raise CalibrationError(f"{source}: {sentence}") from None


def _sentence(fault: ErrorDetails, model: type[BaseModel]) -> str:
    place, kind = _place(fault["loc"]), fault["type"]
    if kind == "extra_forbidden":
        return f"{place} is not a key of this file; {_closest(fault['loc'], model)}"
    if kind == "missing":
        return f"{place} is missing; add it, for example '{_example(fault['loc'])}'"
    if kind == "literal_error":
        return f"{place} is {_shown(fault['input'])}; write {fault['ctx']['expected']}"
    limits = fault.get("ctx", {})
    if kind in _LIMITS:
        remedy = _LIMITS[kind].format(**limits)
    elif kind in _TYPES:
        remedy = f"write {_TYPES[kind]}, for example '{_example(fault['loc'])}'"
    else:
        remedy = fault["msg"]
    return f"{place} is {_shown(fault['input'])}; {remedy}"


def _example(loc: tuple[int | str, ...]) -> str:
    words = [part for part in loc if part in _EXAMPLES]
    return _EXAMPLES[str(words[-1])] if words else "note: text"


def _place(loc: tuple[int | str, ...]) -> str:
    text = ""
    for part in loc:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else str(part)
    return text


def _closest(loc: tuple[int | str, ...], model: type[BaseModel]) -> str:
    part = _PARTS.get(str(loc[0]), model) if len(loc) > 1 else model
    known = list(part.model_fields)
    close = difflib.get_close_matches(str(loc[-1]), known, n=1, cutoff=0.5)
    return f"did you mean '{close[0]}'?" if close else f"allowed here: {', '.join(known)}"


def _shown(value: object) -> str:
    text = "empty" if value is None else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
