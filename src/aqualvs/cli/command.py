"""Base of all commands: a command class that checks values, shared options, and fast imports."""

import contextlib
import gc
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer import Option
from typer.core import TyperCommand, TyperGroup

from aqualvs.errors import OptionError
from aqualvs.special_files import refuse_special


@contextlib.contextmanager
def importing() -> Iterator[None]:
    """Exclude the objects of imported modules from garbage collection, during and after the import.

    Modules never become garbage; searching them takes a sixth of the time of importing them.
    """
    collected = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if collected:
            gc.enable()


# Older versions of Typer import this class from Click, newer ones have it in a private module.
USAGE_ERROR: type[Exception] = typer.BadParameter.__bases__[0]

MAX_WORKERS = 1024
"""Most processes on one machine; a larger number is a typing error that would fill its memory."""

Overwrite = Annotated[
    bool, Option("--overwrite", help="Replace files that this command wrote there before.")
]
Target = Annotated[
    str, Option(metavar="auto|net|solid|FILE", help="Kind of target: a word, or a net.yaml.")
]
Detector = Annotated[
    Literal["ridge", "threshold"],
    Option(help="Stripe detector; threshold is the paper's, for comparison."),
]
MeshFilter = Annotated[
    Literal["none", "paper"], Option(help="Filter for nets; paper is the paper's Algorithm 1.")
]
Fit = Annotated[
    Literal["robust", "pseudo_inverse"],
    Option(help="Plane fit; pseudo_inverse is the paper's, for comparison."),
]
WaterIndex = Annotated[float | None, Option(help="Refractive index of the water.")]
Celsius = Annotated[float | None, Option(help="Water temperature, to compute its index.")]

Salinity = Annotated[
    float | None, Option(help="Salinity in per mille, to compute the water's index.")
]
Refraction = Annotated[
    bool,
    Option("--dome/--no-dome", help="Model the refraction at the dome or flat port, or ignore it."),
]
IndexTarget = Annotated[
    Path | None,
    Option(help="Target on the vehicle (target.yaml) from which to track the water's index."),
]
VehicleFileOption = Annotated[
    Path | None,
    Option(
        "--vehicle-file",
        metavar="FILE",
        help="MAVLink: system ids, ground station, modes, peers, key (YAML; docs/ardusub.md).",
    ),
]
MavlinkPeer = Annotated[
    list[str] | None,
    Option(
        metavar="ADDRESS",
        help="MAVLink, listening: accept only this peer, such as 192.168.2.2 or 192.168.2.0/24; "
        "repeatable.",
    ),
]
MavlinkKey = Annotated[
    Path | None,
    Option(
        metavar="FILE",
        help="MAVLink: sign, and accept only this key; a passphrase or 64 hex digits.",
    ),
]


def given(context: typer.Context, names: Sequence[str]) -> frozenset[str]:
    """Return those of these parameters that the user set, on the command line or by environment."""
    return frozenset(name for name in names if _origin(context, name) not in ("", "DEFAULT"))


def typed(context: typer.Context, *names: str) -> tuple[str, ...]:
    """Return those of these parameters that are on the command line.

    Environment variables do not count: they apply to every command.
    """
    return tuple(name for name in names if _origin(context, name) == "COMMANDLINE")


def _origin(context: typer.Context, name: str) -> str:
    source = context.get_parameter_source(name)
    return source.name if source else ""


def refuse_given(context: typer.Context, names: Sequence[str], remedy: str) -> None:
    """Refuse parameters on the command line that would have no effect.

    Raises `OptionError` with the first of them, its value and the remedy.
    """
    parameters = {parameter.name: parameter for parameter in context.command.params}
    for name in typed(context, *names):
        values = [str(one) for one in _flattened(context.params[name]) if not isinstance(one, bool)]
        # Passwords must not appear in logs.
        shown = "" if name == "token" else "".join(f" {one}" for one in values)
        raise OptionError(f"{_name(parameters[name])}{shown}: {remedy}")


class CheckedCommand(TyperCommand):
    """Command that refuses values that are wrong for any option or argument.

    Refused are empty values; numbers that are not finite, or too large for a 32-bit integer; text
    that is not UTF-8; and paths of pipes, devices and sockets.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments; refuse empty ones, which `Path` takes for the current folder.

        Raises `OptionError` with the option.
        """
        try:
            if any(word == "" or word.endswith("=") for word in args):
                found, _, _ = self.make_parser(ctx).parse_args(args=list(args))
                for parameter in self.params:
                    if any(value == "" for value in _flattened(found.get(parameter.name))):
                        raise OptionError(
                            f"{_name(parameter)} '': is empty; give a value, or set the variable "
                            "of the shell that should hold it"
                        )
            return super().parse_args(ctx, args)
        except USAGE_ERROR as fault:
            # The parser leaves out the command if the value of an option is missing.
            if getattr(fault, "ctx", None) is None:
                vars(fault)["ctx"] = ctx
            raise

    def invoke(self, ctx: Any) -> Any:
        """Check the values and run the command.

        Raises `OptionError` with the option and its value.
        """
        for parameter in self.params:
            for value in _flattened(ctx.params.get(parameter.name)):
                _check(value, _name(parameter))
        return super().invoke(ctx)


class CommandGroups(TyperGroup):
    """Program whose help lists its commands by group, each with the first sentence of its help.

    A command's group is its `rich_help_panel`; groups are in the order of their first commands.
    Typer itself shows groups only with Rich, which takes as long to import as the rest of `--help`.
    """

    def invoke(self, ctx: Any) -> Any:
        """Run the command; raise `Abort` for Ctrl-C, which Typer returns as a silent exit code."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            raise typer.Abort from None

    def format_commands(self, _ctx: Any, formatter: Any) -> None:
        """Write a section for each group, and one for commands without a group."""
        max_summary = 200  # Characters; sentences in `--help` are wrapped, not cut.
        groups: dict[str, list[tuple[str, str]]] = {}
        for name, command in self.commands.items():
            if not command.hidden:
                summary = command.get_short_help_str(limit=max_summary)
                group = getattr(command, "rich_help_panel", None)
                groups.setdefault(group if isinstance(group, str) else "Commands", []).append(
                    (name, summary)
                )
        # One column for all groups.
        widest = max(len(name) for name in self.commands)
        for title, rows in groups.items():
            with formatter.section(title):
                formatter.write_dl([(f"{name:{widest}}", summary) for name, summary in rows])


def _flattened(value: Any) -> Iterator[Any]:
    """Yield the single values of a parameter, from nested lists and tuples."""
    if isinstance(value, list | tuple):
        for one in value:
            yield from _flattened(one)
    else:
        yield value


def _name(parameter: Any) -> str:
    """Return a parameter's name as the user types it: --option or ARGUMENT."""
    if parameter.param_type_name == "option":
        return str(max(parameter.opts, key=len))
    return str(parameter.name).upper()


def usage_text(fault: Exception) -> str:
    """Return the parser's error in one line, with the command whose `--help` to read."""
    parameter, errors = getattr(fault, "param", None), getattr(fault.__cause__, "errors", None)
    if parameter is not None and errors is not None:
        error = errors()[0]
        text = f"{_name(parameter)} {error['input']}: {_remedy(error)}"
    else:
        message = getattr(fault, "format_message", fault.__str__)()
        text = " ".join(str(message).split()).rstrip(".")
    context = getattr(fault, "ctx", None)
    command = "aqualvs" if context is None else context.command_path
    if command == "aqualvs run" and "unexpected extra argument" in text:
        # A pattern that the shell has expanded.
        text = f"{text}: it measures one dive; use aqualvs batch for several"
    return f"{text}; see {command} --help"


def _remedy(error: Mapping[str, Any]) -> str:
    """Return which values a parameter takes, from Pydantic's error on a refused one."""
    kind, context = error["type"], error.get("ctx", {})
    if kind == "float_parsing":
        number = str(error["input"]).strip().replace(",", ".")
        is_comma = re.fullmatch(r"[+-]?\d*\.\d+", number)
        return f"write {number}, with a decimal point" if is_comma else "give a number"
    if kind.startswith("int_"):
        return "give a whole number"
    if kind == "greater_than_equal":
        return f"give {context['ge']:g} or more"
    if kind == "less_than_equal":
        return f"give at most {context['le']:g}"
    message = str(error["msg"]).removeprefix("Value error, ").rstrip(".")
    _, is_choice, choices = message.partition(" is not one of ")
    return f"give one of {choices.replace(chr(39), '')}" if is_choice else message


def _check(value: Any, name: str) -> None:
    """Raise `OptionError` for a value that is wrong for any parameter."""
    max_integer = 2**31 - 1
    if isinstance(value, float) and not math.isfinite(value):
        raise OptionError(f"{name} {value:g}: give a finite number")
    if isinstance(value, int) and abs(value) > max_integer:
        raise OptionError(f"{name} {value}: too large; give a number up to {max_integer}")
    if isinstance(value, str | Path):
        try:
            # Python decodes other bytes as surrogates.
            str(value).encode()
        except UnicodeEncodeError:
            raise OptionError(f"{name} {str(value)!r}: not UTF-8; rename it") from None
    if isinstance(value, Path):
        refuse_special(value, OptionError)
