"""How a file becomes a name: systems, estimators and trainers are found by reading their sources.

A name is resolved by importing the one file that gives it. Only a list of all classes takes
importing everything.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import inspect
import pkgutil
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

T = TypeVar("T")


class NameSource(NamedTuple):
    """Where a name comes from, as the source of a file shows it."""

    module: str
    """Dotted name of the module."""
    constants: dict[str, Any]
    """The class attributes that are given as plain constants."""


class Registry(Generic[T]):
    """The classes of one kind that can be named.

    Found are: the classes of the package's modules whose source assigns one of the ``attributes``,
    those that installed packages announce in the entry-point group of the package's name, and those
    given to `register`. A class is named by its class attribute ``name``, or else by its own name.

    Args:
        kind: what one is called in messages, such as ``"system"``.
        base: ``module:Class`` of the base class; imported when it is first needed.
        package: dotted name of the package whose files are looked at.
        attributes: the class attributes by which a source shows that a class is one.
    """

    def __init__(self, kind: str, base: str, package: str, *attributes: str) -> None:
        self._kind = kind
        self._base_path = base
        self._package = package
        self._attributes = attributes
        self._known: dict[str, type[T]] = {}
        """The classes that are imported."""
        self._all_imported = False
        self._sources: dict[str, NameSource] | None = None

    @property
    def sources(self) -> dict[str, NameSource]:
        """The names that the sources of the package show, without importing any of them; a warning
        for each file that is no Python, or gives a name that another has."""
        if self._sources is None:
            self._sources = _shown(self._kind, self._package, self._attributes)
        return self._sources

    def classes(self) -> dict[str, type[T]]:
        """All classes by name, sorted; imports their modules on the first call, with a warning for
        each that cannot be."""
        if not self._all_imported:
            self._all_imported = True
            for name in self.sources:
                try:
                    self._take(name)
                except ValueError as error:
                    warnings.warn(str(error), stacklevel=2)
            self.plug_ins()
        return dict(sorted(self._known.items()))

    def plug_ins(self) -> list[type[T]]:
        """The classes that installed packages announce, which are imported; a warning for each that
        cannot be."""
        found = []
        for point in entry_points(group=self._package):
            try:
                found.append(self.register(point.load()))
            except Exception as error:  # whatever another package raises
                warnings.warn(
                    f"{self._kind} plug-in {point.name!r} is left out: {error}", stacklevel=2
                )
        return found

    def register(self, cls: type[T]) -> type[T]:
        """Add a class; usable as a decorator.

        Raises:
            TypeError: if it is not a concrete class of this kind.
            ValueError: if another class has its name.
        """
        if not self._is_one(cls):
            base = self._base
            if not (isinstance(cls, type) and issubclass(cls, base)):
                raise TypeError(f"{cls!r} is not a subclass of {base.__name__}")
            abstract: frozenset[str] = getattr(cls, "__abstractmethods__", frozenset())
            lacking = ", ".join(sorted(abstract))
            raise TypeError(f"{cls.__name__} lacks what a {base.__name__} has to define: {lacking}")
        name = self.name_of(cls)
        taken = self._owner(name)
        if taken is not None and taken != (cls.__module__, cls.__qualname__):
            raise ValueError(f"{self._kind} {name!r} is already {taken[0]}.{name}")
        self._known[name] = cls  # a class that was imported anew replaces what it was
        return cls

    def resolve(self, spec: str | type[T]) -> type[T]:
        """The class that a name, a ``module:Class`` path or the class itself means.

        Raises:
            ValueError: in one line; for an unknown name it lists the known ones.
        """
        if not isinstance(spec, str):
            return self.register(spec)
        if ":" in spec:
            return self._imported(spec)
        if spec not in self._known and spec in self.sources:
            self._take(spec)
        if spec not in self._known:
            self.plug_ins()
        if spec not in self._known:
            known = ", ".join(sorted({*self._known, *self.sources}))
            if not known:  # as of a folder of that name in the working folder
                place = ", ".join(importlib.import_module(self._package).__path__)
                raise ValueError(
                    f"unknown {self._kind} {spec!r}; there is none in {place}, which is imported "
                    f"as {self._package}"
                )
            raise ValueError(f"unknown {self._kind} {spec!r}; known are {known}")
        return self._known[spec]

    def name_of(self, cls: type[T]) -> str:
        """The name a class is found by."""
        return getattr(cls, "name", cls.__name__)

    @contextmanager
    def isolated(self) -> Iterator[None]:
        """A context after which everything that was registered in it is forgotten."""
        before, whole = dict(self._known), self._all_imported
        try:
            yield
        finally:
            self._known, self._all_imported = before, whole

    @property
    def _base(self) -> type[T]:
        module, _, name = self._base_path.partition(":")
        return getattr(importlib.import_module(module), name)

    def _imported(self, spec: str) -> type[T]:
        """The class at ``module:Class``, which is registered."""
        module, _, name = spec.partition(":")
        try:
            return self.register(getattr(importlib.import_module(module), name))
        except Exception as error:  # whatever the user's module raises
            for cls in self._known.values():  # of a function or a notebook's cell
                if (cls.__module__, cls.__qualname__) == (module, name):
                    return cls
            if isinstance(error, AttributeError) and ("<locals>" in name or module == "__main__"):
                raise ValueError(
                    f"cannot load {self._kind} {spec!r} in a new process, which does not know what "
                    "a function, a notebook or the main guard has defined; expected a class at "
                    "the top level of a module"
                ) from None
            kind = type(error).__name__
            raise ValueError(f"cannot load {self._kind} {spec!r}: {kind}: {error}") from error

    def _owner(self, name: str) -> tuple[str, str] | None:
        """Module and qualified name of the class that has a name, if one has."""
        if name not in self._known and name in self.sources:
            self._take(name)
        cls = self._known.get(name)
        return None if cls is None else (cls.__module__, cls.__qualname__)

    def _take(self, name: str) -> None:
        """Import the class that a source shows under a name.

        Raises:
            ValueError: in one line, if its module cannot be imported.
        """
        origin = self.sources[name].module
        try:
            module = importlib.import_module(origin)
        except Exception as error:  # whatever the file raises
            kind = type(error).__name__
            raise ValueError(
                f"cannot load {self._kind} {name!r} from {origin}: {kind}: {error}"
            ) from error
        for cls in vars(module).values():
            if (
                self._is_one(cls)
                and cls.__module__ == module.__name__
                and self.name_of(cls) == name
            ):
                self._known.setdefault(name, cls)

    def _is_one(self, cls: object) -> bool:
        return isinstance(cls, type) and issubclass(cls, self._base) and not inspect.isabstract(cls)


def _shown(kind: str, package: str, attributes: tuple[str, ...]) -> dict[str, NameSource]:
    """What `Registry.sources` returns."""
    found: dict[str, NameSource] = {}
    for module in _modules(package):
        try:
            tree = ast.parse(_source(module))
        except SyntaxError as error:
            message = f"{module}, line {error.lineno}, is no Python: {error.msg}"
            warnings.warn(f"left out as a {kind}: {message}", stacklevel=3)
            continue
        for node in tree.body:
            if isinstance(node, ast.ClassDef):
                constants = _constants(node)
                if constants.keys() & set(attributes):
                    name = constants.get("name", node.name)
                    if name in found:
                        other = f"{found[name].module} has one of that name"
                        message = f"{node.name!r} in {module}: {other}"
                        warnings.warn(f"left out as a {kind}: {message}", stacklevel=3)
                        continue
                    found[name] = NameSource(module, constants)
    return dict(sorted(found.items()))


def _modules(package: str) -> tuple[str, ...]:
    """Dotted names of the modules of a package, sorted; the package alone is imported."""
    path = importlib.import_module(package).__path__
    return tuple(sorted(m.name for m in pkgutil.iter_modules(path, f"{package}.")))


def _source(module: str) -> str:
    """A module's source, without importing it."""
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        raise ImportError(f"module {module} has no source")
    return Path(spec.origin).read_text(encoding="utf-8")


def _constants(node: ast.ClassDef) -> dict[str, Any]:
    """The class attributes that a body assigns, with their values where these are constants."""
    found = {}
    for statement in node.body:
        if isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name):
            value = statement.value
            constant = value.value if isinstance(value, ast.Constant) else None
            found[statement.targets[0].id] = constant
    return found


TRAINERS: Registry[Any] = Registry(
    "trainer", "pinnobs_gym.training.trainer:Trainer", "trainers", "name"
)
"""All trainers by name. It stands here for estimators, which know no trainer but by name."""
