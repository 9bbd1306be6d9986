"""Every module can be imported, keeps its promises in `__all__`, and is documented."""

import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from types import ModuleType

import pytest

import aqualvs

MODULES = sorted(
    info.name
    for info in pkgutil.walk_packages(aqualvs.__path__, "aqualvs.")
    if not info.name.endswith("__main__")
)


def undocumented(module: ModuleType) -> Iterator[str]:
    """Name the public functions, classes and methods of a module without a docstring."""
    if not (module.__doc__ or "").strip():
        yield module.__name__
    for name, value in vars(module).items():
        # Compiled kernels are callable objects that carry the docstring of their function.
        documentable = (
            inspect.isclass(value) or hasattr(value, "__wrapped__") or hasattr(value, "py_func")
        )
        documentable = documentable or inspect.isfunction(value)
        if name.startswith("_") or not documentable or value.__module__ != module.__name__:
            continue
        if not (value.__doc__ or "").strip():
            yield f"{module.__name__}.{name}"
        if inspect.isclass(value):
            yield from _undocumented_methods(value)


def _undocumented_methods(owner: type) -> Iterator[str]:
    for name, value in vars(owner).items():
        function = value.fget if isinstance(value, property) else getattr(value, "__func__", value)
        if name.startswith("_") or not inspect.isfunction(function):
            continue
        # What overrides a documented method of the project inherits its words.
        if not inspect.getdoc(getattr(owner, name)) and not (function.__doc__ or "").strip():
            yield f"{owner.__module__}.{owner.__qualname__}.{name}"


def test_modules_are_found() -> None:
    assert {"aqualvs.geometry.planes", "aqualvs.optics.rig", "aqualvs.cli.main"} <= set(MODULES)


@pytest.mark.parametrize("name", MODULES)
def test_module_imports_exports_and_documents(name: str) -> None:
    module = importlib.import_module(name)
    missing = [entry for entry in getattr(module, "__all__", ()) if not hasattr(module, entry)]
    assert missing == []
    assert list(undocumented(module)) == []


def test_the_guard_sees_what_lacks_words() -> None:
    class Spoilt:
        """Documented."""

        def method(self) -> None:
            pass

        @property
        def value(self) -> int:
            return 1

        def _private(self) -> None:
            pass

    def function() -> None:
        pass

    module = ModuleType("spoilt", "A module.")
    for thing in (Spoilt, function):
        thing.__module__ = "spoilt"
        setattr(module, thing.__name__, thing)
    found = {name.rsplit(".", 1)[-1] for name in undocumented(module)}
    assert found == {"method", "value", "function"}
