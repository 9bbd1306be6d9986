"""What the page may ask for: messages checked by type and size, and what they do."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Protocol

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from aqualvs.control.setpoint import Setpoint, SetpointHolder
from aqualvs.errors import OptionError

MAX_MESSAGE_BYTES = 2048
"""Longer messages close the connection."""


class _Message(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class Hello(_Message):
    """The first message of a page."""

    kind: Literal["hello"]
    token: Annotated[str, Field(max_length=200)] = ""


class Shown(_Message):
    """The page has shown a picture and can take the next."""

    kind: Literal["shown"]


class RecordCommand(_Message):
    """Begin or end a recording."""

    kind: Literal["record"]
    on: bool


class SetpointCommand(_Message):
    """Set what is to be held; without a range it is taken back."""

    kind: Literal["setpoint"]
    range_m: float | None
    yaw_deg: float = 0.0


Message = Annotated[Hello | Shown | RecordCommand | SetpointCommand, Field(discriminator="kind")]
Command = RecordCommand | SetpointCommand
_ADAPTER: TypeAdapter[Message] = TypeAdapter(Message)


def parse_message(text: str) -> Message:
    """Return a page's message.

    Raises
    ------
    ValueError
        If it is none.
    """
    return _ADAPTER.validate_json(text)


class RecordButton(Protocol):
    """What the page needs of a recorder."""

    def start(self) -> None:
        """Begin a recording; does nothing while one is under way."""

    def stop(self) -> None:
        """End it; does nothing where there is none."""

    def facts(self) -> Mapping[str, Any]:
        """Return `on` (bool) and `words` (a file's name, or why it does not work)."""


class NoRecorder:
    """Stands where nothing can be recorded."""

    def start(self) -> None:
        """Refuse."""
        raise OptionError("record: this run records nothing; start it with --record FOLDER")

    def stop(self) -> None:
        """Do nothing."""

    def facts(self) -> Mapping[str, Any]:
        """Return that nothing is recorded."""
        return {"on": False, "words": ""}


class Controls:
    """What the page can move.

    Parameters
    ----------
    setpoint : SetpointHolder
    recorder : RecordButton
    """

    def __init__(self, setpoint: SetpointHolder, recorder: RecordButton) -> None:
        self.setpoint, self.recorder = setpoint, recorder

    def carry_out(self, command: Command) -> None:
        """Do what a page with the right to command asks for.

        Raises
        ------
        AqualvsError
            If it cannot be done; nothing has changed then.
        """
        if isinstance(command, SetpointCommand):
            wanted = None
            if command.range_m is not None:
                wanted = Setpoint(command.range_m, math.radians(command.yaw_deg))
            self.setpoint.put(wanted)
        elif command.on:
            self.recorder.start()
        else:
            self.recorder.stop()
