"""Keys and values of a file of another program, read strictly; every fault names its place."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from aqualvs.errors import RigError

# YAML of C++ programs has numbers such as 1e-05, which YAML 1.1 reads as text; XML has text only.
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_LONGEST_NUMBER = 40
_LARGEST = 1e9


@dataclass(frozen=True, slots=True)
class Entries:
    """A mapping of a file.

    Attributes
    ----------
    content : mapping
    place : str
        Where it is in the file, such as "cam0."; empty at the top.
    """

    content: Mapping[Any, Any]
    place: str = ""

    def first(self, keys: Sequence[str]) -> str:
        """Return the first of some keys that there is.

        Raises
        ------
        RigError
            If there is none.
        """
        for key in keys:
            if self.content.get(key) is not None:
                return key
        raise RigError(f"{self.place}{keys[0]} is missing; add it")

    def has(self, *keys: str) -> bool:
        """Return whether any of some keys has a value."""
        return any(self.content.get(key) is not None for key in keys)

    def part(self, key: str) -> "Entries":
        """Return the mapping at a key.

        Raises
        ------
        RigError
            If there is none.
        """
        value = self.content.get(key)
        if not isinstance(value, Mapping):
            raise RigError(f"{self.place}{key} is {shown(value)}; write keys and values")
        return Entries(value, f"{self.place}{key}.")

    def word(self, *keys: str) -> str:
        """Return the text at the first of some keys that there is."""
        key = self.first(keys)
        value = self.content[key]
        if not isinstance(value, str):
            raise RigError(f"{self.place}{key} is {shown(value)}; write a word")
        return value.strip()

    def name(self, key: str, default: str) -> str:
        """Return the name at a key, which may be a serial number; the default if there is none."""
        value = self.content.get(key)
        named = isinstance(value, str | int) and not isinstance(value, bool)
        return (str(value).strip() if named else "") or default

    def number(self, *keys: str) -> float:
        """Return the number at the first of some keys that there is."""
        key = self.first(keys)
        return number(self.content[key], self.place + key)

    def whole(self, *keys: str) -> int:
        """Return the whole number at the first of some keys that there is."""
        key = self.first(keys)
        return whole(self.number(key), self.place + key)

    def numbers(self, *keys: str) -> list[float]:
        """Return the numbers of a list, matrix or vector at the first of some keys that there is.

        Raises
        ------
        RigError
            If it holds anything else, or not as many numbers as it says.
        """
        key = self.first(keys)
        value, place = self.content[key], self.place + key
        n_stated = None
        if isinstance(value, Mapping):
            matrix = Entries(value, f"{place}.")
            if matrix.has("rows", "cols"):
                n_stated = matrix.whole("rows") * matrix.whole("cols")
            value, place = value.get("data"), f"{place}.data"
        if isinstance(value, str):
            value = value.split()
        if not isinstance(value, list | tuple):
            raise RigError(f"{place} is {shown(value)}; write a list of numbers")
        flat: list[Any] = []
        for one in value:
            flat += one if isinstance(one, list | tuple) else [one]
        if n_stated not in (None, len(flat)):
            raise RigError(f"{place} has {len(flat)} values, but rows times cols is {n_stated}")
        return [number(one, f"{place}[{i}]") for i, one in enumerate(flat)]

    def listed(self, n: int, *keys: str) -> list[float]:
        """Return the numbers at the first of some keys that there is, which must be n.

        Raises
        ------
        RigError
            If it holds anything else.
        """
        values = self.numbers(*keys)
        if len(values) != n:
            key = self.place + self.first(keys)
            raise RigError(f"{key} has {len(values)} values; write {n}")
        return values

    def size(self, *keys: str) -> tuple[int, int]:
        """Return the width and height in a list at the first of some keys that there is."""
        key = self.place + self.first(keys)
        width, height = self.listed(2, *keys)
        return whole(width, key), whole(height, key)

    def core(self, *keys: str) -> tuple[float, float, float, float]:
        """Return fx, fy, cx, cy of the camera matrix at the first of some keys that there is.

        Raises
        ------
        RigError
            If it is no camera matrix, or has skew.
        """
        key = self.place + self.first(keys)
        fx, skew, cx, zero, fy, cy, *last = self.listed(9, *keys)
        if skew != 0.0:
            raise RigError(f"{key} has a skew of {skew:g}, which the lens of aqualvs lacks")
        if (zero, *last) != (0.0, 0.0, 0.0, 1.0):
            raise RigError(f"{key} is no camera matrix; write [fx, 0, cx, 0, fy, cy, 0, 0, 1]")
        return fx, fy, cx, cy


def number(value: object, place: str) -> float:
    """Return a value as a finite number.

    Raises
    ------
    RigError
        If it is none.
    """
    if isinstance(value, str) and len(value) < _LONGEST_NUMBER and _NUMBER.fullmatch(value.strip()):
        value = float(value)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise RigError(f"{place} is {shown(value)}; write a finite number")
    return float(value)


def whole(value: float, place: str) -> int:
    """Return a number as a whole one.

    Raises
    ------
    RigError
        If it is none, or larger than any size of a picture.
    """
    if value != math.floor(value) or not 0 <= value <= _LARGEST:
        raise RigError(f"{place} is {value:g}; write a whole number of 0 or more")
    return int(value)


def shown(value: object) -> str:
    """Return a value in a few characters."""
    if isinstance(value, Mapping):
        return "a mapping"
    text = "empty" if value is None else repr(value)[:200]
    return text if len(text) <= 60 else text[:57] + "..."
