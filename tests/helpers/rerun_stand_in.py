"""A stand-in for Rerun's SDK, which keeps what is logged."""

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest


class Stream:
    """Keeps what is logged: time, path, entity with its kind and arguments."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.times: dict[str, float] = {}
        self.rows: list[tuple[dict[str, float], str, Any]] = []
        self.closed = 0

    def set_time(
        self, timeline: str, *, sequence: int | None = None, duration: float | None = None
    ) -> None:
        value = sequence if duration is None else duration
        assert value is not None
        self.times[timeline] = value

    def log(self, path: str, entity: Any, *, static: bool = False) -> None:
        self.rows.append(({} if static else dict(self.times), path, entity))

    def save(self, path: Any, default_blueprint: Any) -> None:
        self.place, self.layout = path, default_blueprint

    def disconnect(self) -> None:
        self.closed += 1

    def at(self, path: str, kind: str) -> list[tuple[dict[str, float], Any]]:
        return [(when, one) for when, where, one in self.rows if (where, one.kind) == (path, kind)]


class _Kinds(ModuleType):
    """Makes of any name a class that keeps its arguments."""

    def __getattr__(self, kind: str) -> Any:
        return lambda *args, **kwargs: SimpleNamespace(kind=kind, args=args, **kwargs)


def replace_sdk(monkeypatch: pytest.MonkeyPatch) -> list[Stream]:
    """Put the stand-in in place of the SDK; returns the list that its streams will be in."""
    made: list[Stream] = []

    def new(name: str) -> Stream:
        made.append(Stream(name))
        return made[-1]

    sdk: Any = _Kinds("rerun")
    sdk.RecordingStream, sdk.blueprint = new, _Kinds("rerun.blueprint")
    sdk.ViewCoordinates = SimpleNamespace(
        RDF=SimpleNamespace(kind="RDF"), RIGHT_HAND_Z_UP=SimpleNamespace(kind="up")
    )
    monkeypatch.setitem(sys.modules, "rerun", sdk)
    monkeypatch.setitem(sys.modules, "rerun.blueprint", sdk.blueprint)
    return made
