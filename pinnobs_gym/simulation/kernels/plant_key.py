"""A key of the code that defines a plant, found without tracing it.

It covers the sources of the plant's modules and of those that they import of their project, and
what this process has loaded of them: the compiled functions of the class, the functions and classes
that these name, and the values of the constants that they use. A source that was edited after it
was loaded, or a constant that was changed since, thus gives another key. What cannot be covered has
no key: classes and functions made in functions, closures, sources that are not files, and objects
that are neither data nor code.
"""

from __future__ import annotations

import functools
import hashlib
import sys
from collections.abc import Mapping, Set
from dataclasses import fields, is_dataclass
from importlib.metadata import version
from pathlib import Path
from platform import python_implementation, python_version
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np

from pinnobs_gym.simulation.code_hash import Unreadable, digest, is_installed, module_hashes
from pinnobs_gym.simulation.plant_form import PlantForm
from pinnobs_gym.simulation.system import System

_ROOM = "pinnobs_gym.simulation"
"""The package whose files count as a whole; see `_machinery`."""
_GENERATED = frozenset({"__repr__", "__eq__", "__hash__", "_abc_impl"})
"""Attributes that say nothing of the equations."""


def plant_key(form: PlantForm, *values: str) -> str | None:
    """Return a key of the code made from a form, of the values, of this package's code and of the
    versions of what makes it; None if the code that defines the plant cannot be told."""
    try:
        plant, machinery = _plant(form.system, form.rest), _machinery()
    except (Unreadable, ValueError, OSError, RecursionError):
        return None
    parts = (plant, form.numbers, form.properties, values, machinery, _versions())
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:24]


def _plant(system: System, rest: Mapping[str, Any]) -> list[Any]:
    """Return the content of a system: the code of its class, and some of its fields."""
    code = _Code(module_hashes(type(system), without=_ROOM))
    parts = [[name, code.data(value)] for name, value in rest.items()]
    code.add_class(type(system))
    return [sorted(code.modules.items()), code.parts, parts]


@functools.cache
def _machinery() -> str:
    """Return a hash of the files that trace equations and write code."""
    room = Path(__file__).parent.parent
    files = sorted(path for path in room.rglob("*") if path.suffix in (".py", ".c", ".h"))
    return digest(
        [(str(p.relative_to(room)), hashlib.sha256(p.read_bytes()).hexdigest()) for p in files]
    )


@functools.cache
def _versions() -> tuple[str, ...]:
    packages = (version(name) for name in ("sympy", "numpy", "array-api-compat"))
    return (python_implementation(), python_version(), *packages)


class _Code:
    """What is loaded of the modules of a plant."""

    def __init__(self, modules: Mapping[str, str]) -> None:
        self.modules = dict(modules)
        """Hashes of the sources by name."""
        self.parts: list[Any] = []
        self._seen: set[int] = set()
        self._packages: set[str] = set()

    def add_class(self, cls: type) -> None:
        """Add the attributes of a class and of those that it derives from."""
        for each in cls.__mro__:
            if id(each) in self._seen or self._counts_by_name(each.__module__):
                continue
            self._seen.add(id(each))
            if "<locals>" in each.__qualname__:
                raise Unreadable(f"{each.__qualname__} is made in a function")
            self.parts.append(each.__qualname__)
            for name, value in vars(each).items():
                if name not in _GENERATED:
                    self._add_attribute(name, value)

    def _add_attribute(self, name: str, value: Any) -> None:
        self.parts.append(name)
        if isinstance(value, property):
            accessors = [f for f in (value.fget, value.fset) if f is not None]
        elif isinstance(value, staticmethod | classmethod):
            accessors = [value.__func__]
        elif isinstance(value, functools.cached_property):
            accessors = [value.func]
        else:
            accessors = [value]
        for each in accessors:
            if isinstance(each, FunctionType) and name.startswith("__"):
                if each.__code__.co_filename.startswith("<"):
                    continue  # made by dataclass from the fields
                self.add_function(each)
            elif not name.startswith("__"):
                self._add(name, each)

    def add_function(self, function: FunctionType) -> None:
        """Add the code of a function, and what it names."""
        if id(function) in self._seen or self._counts_by_name(function.__module__):
            return
        self._seen.add(id(function))
        if function.__code__.co_filename.startswith("<") or "<locals>" in function.__qualname__:
            raise Unreadable(f"{function.__qualname__} has no source of its own")
        if any(name != "__class__" for name in function.__code__.co_freevars):
            raise Unreadable(f"{function.__qualname__} is a closure")
        self.parts.append(_code(function.__code__))
        given = [*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).items()]
        self.parts.append(self.data(given))
        names = _names(function.__code__)
        for name in sorted(names & function.__globals__.keys()):
            value = function.__globals__[name]
            self._add(name, value, names)

    def _add(self, name: str, value: Any, names: Set[str] = frozenset()) -> None:
        """Add what a name stands for, code or data; of a module, what these names stand for in
        it."""
        self.parts.append(name)
        while hasattr(value, "__wrapped__") and not isinstance(value, FunctionType):
            value = value.__wrapped__  # as of a cache
        if isinstance(value, ModuleType):
            if not self._counts_by_name(value.__name__):
                for part in sorted(names & vars(value).keys()):
                    self._add(part, vars(value)[part], names - {part})
        elif isinstance(value, type):
            self.parts.append(f"{value.__module__}.{value.__qualname__}")
            if value is not System:
                self.add_class(value)
        elif isinstance(value, FunctionType):
            self.parts.append([value.__module__, value.__qualname__])
            self.add_function(value)
        elif isinstance(value, np.ufunc) or _is_builtin(value):
            self.parts.append(value.__name__)
        elif type(value).__module__ == "typing":  # as Any under another name
            self.parts.append(repr(value))
        else:
            self.parts.append(self.data(value))

    def _counts_by_name(self, module: str) -> bool:
        """Return whether code of a module counts by its name: that of installed packages and of the
        machinery. Their versions and files are parts of the key.

        Raises:
            Unreadable: if it is neither that nor of the plant's modules.
        """
        if module in self.modules:
            return False
        top = module.partition(".")[0]
        own = f"{module}.".startswith(f"{_ROOM}.")
        if not own and (top in ("__main__", "pinnobs_gym", "trainers") or not is_installed(top)):
            raise Unreadable(f"{module} is not among the modules that the plant's import")
        if not own and top not in self._packages and top not in sys.stdlib_module_names:
            self._packages.add(top)
            package = sys.modules.get(top)
            file = getattr(package, "__file__", None)
            date = None if file is None else Path(file).stat().st_mtime_ns
            self.parts.append([top, str(getattr(package, "__version__", "")), date])
        return True

    def data(self, value: Any) -> Any:
        """Return data as nested lists of text.

        Raises:
            Unreadable: if a part of it is none.
        """
        if value is None or isinstance(value, bool | int | float | str | bytes | complex):
            return repr(value)
        if isinstance(value, np.ndarray | np.generic):
            array = np.ascontiguousarray(value)
            if array.dtype.hasobject:
                raise Unreadable("an array of objects is no data")
            return [str(array.dtype), array.shape, hashlib.sha256(array.tobytes()).hexdigest()]
        if isinstance(value, list | tuple):
            return [type(value).__name__, *map(self.data, value)]
        if isinstance(value, Mapping):
            return [[self.data(key), self.data(part)] for key, part in value.items()]
        if isinstance(value, set | frozenset):
            return sorted(repr(self.data(part)) for part in value)
        if isinstance(value, System):
            others = {f.name: getattr(value, f.name) for f in fields(value)}
            return [type(value).__qualname__, _plant(value, others)]
        if is_dataclass(value) and type(value).__module__.startswith(f"{_ROOM}."):
            parts = [self.data(getattr(value, f.name)) for f in fields(value)]
            return [type(value).__qualname__, *parts]
        raise Unreadable(f"{type(value).__qualname__} is no data")


def _is_builtin(value: Any) -> bool:
    """Return whether a value is a function written in C, such as `math.sin`, of a module."""
    if not isinstance(value, BuiltinFunctionType):
        return False
    return value.__self__ is None or isinstance(value.__self__, ModuleType)


def _code(code: CodeType) -> list[Any]:
    """Return what a compiled function does, without lines and files."""
    constants = []
    for c in code.co_consts:
        text = sorted(map(repr, c)) if isinstance(c, frozenset) else repr(c)
        constants.append(_code(c) if isinstance(c, CodeType) else [type(c).__name__, text])
    return [code.co_code.hex(), code.co_names, code.co_varnames, constants]


def _names(code: CodeType) -> set[str]:
    """Return the names that a function and those in it refer to."""
    inner = (c for c in code.co_consts if isinstance(c, CodeType))
    return set(code.co_names).union(*map(_names, inner))
