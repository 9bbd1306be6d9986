"""Files that people write, checked key by key, with one-line messages on their faults.

A file's keys, types and limits are a `StrictPart`; `validated` checks the content against it, and
`load_settings` also the version that such a file begins with.
"""

import difflib
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, ValidationError
from pydantic_core import ErrorDetails

from aqualvs.errors import AqualvsError, OptionError
from aqualvs.yamlfile import read_yaml

Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Index = Annotated[float, Field(ge=1.0, le=2.0, allow_inf_nan=False)]
Triple = Annotated[list[Number], Field(min_length=3, max_length=3)]


class StrictPart(BaseModel):
    """A mapping of known keys; anything else is refused."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


AnyPart = TypeVar("AnyPart", bound=StrictPart)


def _kind_of(value: object) -> str:
    if isinstance(value, Mapping | BaseModel):
        return KEYS.tag
    return LIST.tag if isinstance(value, list | tuple) else NUMBER.tag


NUMBER, LIST, KEYS, WORD = Tag("<number>"), Tag("<list>"), Tag("<keys>"), Tag("<word>")
"""Tags for the branches of a union, so that a fault is one of the branch that was meant.

Places in messages leave them out, and no key is called so.
"""
BY_KIND = Discriminator(_kind_of)
"""Tells by the kind of a value which of the branches `NUMBER`, `LIST` and `KEYS` is meant."""
_BRANCHES = {branch.tag for branch in (NUMBER, LIST, KEYS, WORD)}

_TYPES = {
    "float_type": "a plain number",
    "float_parsing": "a plain number",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "string_type": "a word",
    "list_type": "a list",
    "tuple_type": "a list",
    "model_type": "keys and values",
    "model_attributes_type": "keys and values",
    "dict_type": "keys and values",
}
_LIMITS = {
    "finite_number": "write a finite number",
    "greater_than": "it must be greater than {gt:g}",
    "greater_than_equal": "it must be at least {ge:g}",
    "less_than": "it must be less than {lt:g}",
    "less_than_equal": "it must be at most {le:g}",
    "too_short": "write {min_length} values",
    "too_long": "write {max_length} values",
    "string_too_short": "give it a name",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class SchemaWords:
    """Messages on the faults of one kind of file."""

    file: str = "this file"  # Kind of the file, such as "a rig file".
    # A line that is right, by its key; and the example for any other key.
    examples: Mapping[str, str] = field(default_factory=dict)
    first_line: str = ""
    a_list: str = "a list"  # What to write where a list is missing.
    # What to say of values that are wrong, by the first and the last key of their place.
    remedies: Mapping[tuple[str, str], str] = field(default_factory=dict)

    def first_fault(self, error: ValidationError, model: type[BaseModel]) -> str:
        """Return one line on the fault to mend first; a misspelt key explains the missing one."""
        faults = [_without_branches(fault) for fault in error.errors(include_url=False)]
        unknown = [fault for fault in faults if fault["type"] in ("extra_forbidden", "invalid_key")]
        fault = (unknown or faults)[0]
        place, kind = _place(fault["loc"]) or "the file", fault["type"]
        if kind == "extra_forbidden":
            return f"{place} is not a key of {self.file}; {_closest(fault['loc'], model)}"
        if kind == "invalid_key":
            parent = _place(fault["loc"][:-1]) or "the file"
            return (
                f"{parent} has the key {shown(fault['input'])}, which is not a word; write numbers "
                "with a decimal point, such as 1.5, not 1,5"
            )
        if kind == "missing":
            return self.missing(place, fault["loc"])
        return f"{place} is {shown(fault['input'])}; {self._remedy(fault)}"

    def missing(self, place: str, loc: tuple[int | str, ...]) -> str:
        """Return the sentence on a key that must be there."""
        return f"{place} is missing; add it{self._example(loc)}"

    def _remedy(self, fault: ErrorDetails) -> str:
        kind, place = fault["type"], fault["loc"]
        if kind == "literal_error":
            return f"write {fault['ctx']['expected']}"
        ends = str(place[0]) if place else "", str(place[-1]) if place else ""
        if ends in self.remedies:
            return self.remedies[ends]
        if kind == "too_short" and fault["ctx"]["min_length"] == 1:
            return "write one value or more"
        if kind in _LIMITS:
            return _LIMITS[kind].format(**fault.get("ctx", {}))
        if kind in _TYPES:
            wanted = self.a_list if kind == "list_type" else _TYPES[kind]
            return f"write {wanted}{self._example(place)}"
        return fault["msg"]

    def _example(self, place: tuple[int | str, ...]) -> str:
        known = [self.examples[str(step)] for step in place if step in self.examples]
        example = known[-1] if known else self.first_line
        return f", for example '{example}'" if example else ""


def _without_branches(fault: ErrorDetails) -> ErrorDetails:
    return {**fault, "loc": tuple(step for step in fault["loc"] if step not in _BRANCHES)}


def _closest(place: tuple[int | str, ...], model: type[BaseModel]) -> str:
    for step in place[:-1]:
        here = model.model_fields.get(str(step))
        model = next(_parts_in(here.annotation), model) if here else model
    known = list(model.model_fields)
    close = difflib.get_close_matches(str(place[-1]), known, n=1, cutoff=0.5)
    return f"did you mean '{close[0]}'?" if close else f"allowed here: {', '.join(known)}"


def _parts_in(annotation: object) -> Iterator[type[BaseModel]]:
    """Yield the schemas that a field's type holds, such as X of `list[X] | None`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from _parts_in(part)


def _place(loc: tuple[int | str, ...]) -> str:
    text = ""
    for part in loc:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else str(part)
    return text


def shown(value: object) -> str:
    """Return a value in one line, cut where it is long."""
    text = "empty" if value is None else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def validated(
    kind: type[AnyPart],
    content: object,
    source: object,
    error: type[AqualvsError],
    words: SchemaWords | None = None,
) -> AnyPart:
    """Return the content of a file, as read from YAML, as its schema.

    `source` is how messages call the file, and `words` are those of messages on this kind of file.
    Raises `error` on a fault, with one line: source, place, value, remedy.
    """
    try:
        return kind.model_validate(content)
    except ValidationError as fault:
        told = (words or SchemaWords()).first_fault(fault, kind)
        raise error(f"{source}: {told}") from None


def twine_fault(twine_mm: float, bar_mm: float) -> str:
    """Return what is wrong with the twine of a file's net, "" if nothing is."""
    if twine_mm < bar_mm:
        return ""
    return (
        f"net.twine_mm is {twine_mm:g}, not thinner than the bar of {bar_mm:g} mm; write the "
        "diameter of one twine in millimetres"
    )


def load_settings(path: Path, kind: type[AnyPart], key: str, version: int) -> AnyPart:
    """Return the content of a file, checked key by key; `kind` is what it may hold.

    `key` is the first key of such a file, whose value is the version of its format; `version` is
    that which is read. Raises `OptionError` with one line: file, place, value, remedy.
    """
    content = read_yaml(path, f"a file that begins with '{key}: {version}'", OptionError)
    return parse_settings(content, kind, key, version, str(path))


def parse_settings(
    content: object, kind: type[AnyPart], key: str, version: int, name: str
) -> AnyPart:
    """Return settings checked key by key; `name` is how messages call their source.

    Raises `OptionError` with one line: source, place, value, remedy.
    """
    if not isinstance(content, Mapping) or key not in content:
        raise OptionError(f"{name}: {key} is missing; such a file begins with '{key}: {version}'")
    found = content[key]
    if type(found) is not int or found != version:
        raise OptionError(
            f"{name}: {key} is {found!r}, but this aqualvs reads version {version}; write the file "
            "anew, or install an aqualvs that reads it"
        )
    return validated(kind, dict(content), name, OptionError)


# What a key ends with to tell its unit.
_UNIT = re.compile(r"_(per_s2?|n_s2?_m2?|kg|per_m|deg(_s2?)?|mm|m(_s[23]?)?|n|s|percent|px)$")


def without_unit(key: str) -> str:
    """Return a key without its unit."""
    return _UNIT.sub("", key)


def si_values(part: StrictPart) -> dict[str, Any]:
    """Return the values of a part by their keys without units: metres, radians and shares."""
    keys = type(part).model_fields
    return {without_unit(key): _in_si(key, getattr(part, key)) for key in keys}


def _in_si(key: str, value: Any) -> Any:
    if isinstance(value, list | tuple):
        return tuple(_in_si(key, one) for one in value)
    if not isinstance(value, int | float):
        return value
    if "_deg" in key:
        return math.radians(value)
    per_unit = {"mm": 1e3, "percent": 100.0}.get(key.rpartition("_")[2])
    return value / per_unit if per_unit else value
