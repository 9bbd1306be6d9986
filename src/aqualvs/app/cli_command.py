"""A command whose values are checked before it runs, whatever they are for."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from typer.core import TyperCommand

from aqualvs.errors import OptionError
from aqualvs.special_files import refuse_special

_MAX_INTEGER = 2**31 - 1


class CheckedCommand(TyperCommand):
    """A command that refuses values that no option and no argument can take.

    Refused are numbers that are not finite, or too large for a 32-bit integer; text that is not
    UTF-8; and paths of pipes, devices and sockets.
    """

    def invoke(self, ctx: Any) -> Any:
        """Check the values and run the command.

        Raises
        ------
        OptionError
            With the option and its value.
        """
        for parameter in self.params:
            for value in _plain(ctx.params.get(parameter.name)):
                _check(value, _name(parameter))
        return super().invoke(ctx)


def _plain(value: Any) -> Iterator[Any]:
    """Yield the values of a parameter that may take several."""
    if isinstance(value, list | tuple):
        for one in value:
            yield from _plain(one)
    else:
        yield value


def _name(parameter: Any) -> str:
    """Return a parameter as the user writes it."""
    if parameter.param_type_name == "option":
        return str(max(parameter.opts, key=len))
    return str(parameter.name).upper()


def _check(value: Any, name: str) -> None:
    if isinstance(value, float) and not math.isfinite(value):
        raise OptionError(f"{name} {value:g}: give a finite number")
    if isinstance(value, int) and abs(value) > _MAX_INTEGER:
        raise OptionError(f"{name} {value}: too large; give a number up to {_MAX_INTEGER}")
    if isinstance(value, str | Path) and not _is_text(str(value)):
        raise OptionError(f"{name} {str(value)!r}: not UTF-8; rename it")
    if isinstance(value, Path):
        refuse_special(value, OptionError)


def _is_text(value: str) -> bool:
    """Return whether a text can be written as UTF-8; bytes that cannot come in as surrogates."""
    try:
        value.encode()
    except UnicodeEncodeError:
        return False
    return True
