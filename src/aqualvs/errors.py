"""The exception tree of the package.

::

    AqualvsError                what a user can mend; the command line prints it and exits with 2
      RigError                  a rig file, or a rig that cannot exist
      SourceError               a video, image folder, recording or log that cannot be read
        FrameError              a frame that does not fit the rig; a `ValueError`, too
      OutputError               a folder or file that cannot be written
      OptionError               an option, or a combination of them, that makes no sense
      CalibrationError          pictures, targets or poses from which nothing can be solved

A refused posture is not an exception but a value, `aqualvs.scanning.posture.Refusal`.

`check_positive` and `check_not_negative` refuse numbers in option classes, in the same words, and
`check_options` those of a command;
`check_commas` refuses tables that are separated otherwise.
"""

import math
from collections.abc import Iterable


class AqualvsError(Exception):
    """A fault that the user can mend.

    The message is one line that names the file, the value and the remedy.
    """


class RigError(AqualvsError):
    """A rig file that cannot be read, or a rig that cannot exist."""


class SourceError(AqualvsError):
    """A source of frames, or a vehicle's log, that cannot be opened or decoded."""


class FrameError(SourceError, ValueError):
    """A frame of another size, type or field than the rig's."""


class OutputError(AqualvsError):
    """An output folder or file that cannot be written."""


class OptionError(AqualvsError):
    """An option, or a combination of options, that makes no sense."""


class CalibrationError(AqualvsError):
    """Pictures, targets or poses from which nothing can be solved."""


def check_positive(what: str, owner: object, *names: str) -> None:
    """Raise `OptionError` unless these fields of `owner` are finite and above 0."""
    for name in names:
        value = getattr(owner, name)
        if not 0.0 < value < math.inf:
            raise OptionError(f"{what}, {name} {value:g}: must be positive")


def check_not_negative(what: str, owner: object, *names: str) -> None:
    """Raise `OptionError` unless these fields of `owner` are finite and 0 or more."""
    for name in names:
        value = getattr(owner, name)
        if not 0.0 <= value < math.inf:
            raise OptionError(f"{what}, {name} {value:g}: must be 0 or more")


def check_options(request: object, *names: str, least: float, wanted: str) -> None:
    """Raise `OptionError` for the first of these fields, named as options, below `least`.

    What was not given is None. `wanted`: what to give instead.
    """
    for name in names:
        value = getattr(request, name)
        if value is not None and not least <= value < math.inf:
            raise OptionError(f"--{name.replace('_', '-')} {value:g}: give {wanted}")


def check_commas(header: Iterable[str | None], source: object, error: type[AqualvsError]) -> None:
    """Raise `error` if a table's first line is one name, of columns between semicolons."""
    names = [name for name in header if name is not None]
    if len(names) == 1 and ";" in names[0]:
        raise error(f"{source}: is separated by semicolons; save it with commas")
