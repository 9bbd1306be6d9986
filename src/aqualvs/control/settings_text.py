"""Files that people write for the controllers: strict YAML, faults told in one line."""

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from aqualvs.errors import OptionError, OutputError
from aqualvs.yamlfile import read_yaml

Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


class Part(BaseModel):
    """A mapping of known keys; anything else is refused."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


AnyPart = TypeVar("AnyPart", bound=Part)


def load_settings(path: Path, kind: type[AnyPart], key: str, version: int) -> AnyPart:
    """Return the content of a file, checked key by key.

    Parameters
    ----------
    path : Path
    kind : type
        What the file may hold.
    key : str
        First key of such a file, whose value is the version of its format.
    version : int
        Version that is read.

    Raises
    ------
    OptionError
        One line: file, place, value, remedy.
    """
    content = read_yaml(path, f"a file that begins with '{key}: {version}'", OptionError)
    return parse_settings(content, kind, key, version, str(path))


def parse_settings(
    content: object, kind: type[AnyPart], key: str, version: int, name: str
) -> AnyPart:
    """Return settings checked key by key; `name` is how messages call their source.

    Raises
    ------
    OptionError
        One line: source, place, value, remedy.
    """
    if not isinstance(content, Mapping) or key not in content:
        raise OptionError(f"{name}: {key} is missing; such a file begins with '{key}: {version}'")
    found = content[key]
    if type(found) is not int or found != version:
        raise OptionError(
            f"{name}: {key} is {found!r}, but this aqualvs reads version {version}; write the file "
            "anew, or install an aqualvs that reads it"
        )
    try:
        return kind.model_validate(dict(content))
    except ValidationError as error:
        raise OptionError(f"{name}: {_first_fault(error, kind)}") from None


def write_settings(path: Path, text: str) -> None:
    """Write a file.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as fault:
        raise OutputError(
            f"{path}: cannot be written ({fault.strerror}); choose another place"
        ) from None


def _first_fault(error: ValidationError, kind: type[Part]) -> str:
    """One line on the fault to mend first; a misspelt key explains the one that is missing."""
    faults = error.errors(include_url=False)
    unknown = [fault for fault in faults if fault["type"] == "extra_forbidden"]
    fault = (unknown or faults)[0]
    place = ".".join(str(step) for step in fault["loc"])
    if fault["type"] == "extra_forbidden":
        return f"{place} is no key here; {_closest(fault, kind)}"
    if fault["type"] == "missing":
        return f"{place} is missing; add it"
    value = fault["input"]
    shown = f"'{value}'" if isinstance(value, str) else repr(value)
    shown = "keys and values" if isinstance(value, dict) else shown
    return f"{place} is {shown}; {_remedy(fault)}"


def _remedy(fault: ErrorDetails) -> str:
    if fault["type"] == "literal_error":
        return f"write {fault['ctx']['expected']}"
    message = fault["msg"].removeprefix("Value error, ").removeprefix("Input ")
    return message[0].lower() + message[1:] if message.startswith("S") else f"it {message}"


def _closest(fault: ErrorDetails, kind: type[Part]) -> str:
    known = _keys_at(kind, fault["loc"][:-1])
    close = difflib.get_close_matches(str(fault["loc"][-1]), known, n=1)
    if close:
        return f"did you mean '{close[0]}'?"
    return f"known are {', '.join(known)}" if known else "leave it out"


def _keys_at(kind: type[Part], places: tuple[int | str, ...]) -> list[str]:
    """Return the keys that a mapping at a place may have."""
    for place in places:
        field = kind.model_fields.get(str(place))
        inner = None if field is None else _part_of(field.annotation)
        if inner is None:
            return []
        kind = inner
    return list(kind.model_fields)


def _part_of(annotation: Any) -> type[Part] | None:
    options = (annotation, *getattr(annotation, "__args__", ()))
    parts = [one for one in options if isinstance(one, type) and issubclass(one, Part)]
    return parts[0] if parts else None
