"""Registries of systems, estimators and trainers, found by reading their sources.

Resolving a name imports only the file that defines it. Listing all classes imports all files.
"""

from __future__ import annotations

import ast
import difflib
import importlib
import importlib.util
import inspect
import marshal
import pkgutil
import struct
import sys
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

T = TypeVar("T")
_ALIKE = 0.66
"""Least likeness of a name that is suggested: that of two names of three letters with two of them
exchanged."""


class NameSource(NamedTuple):
    """The origin of a name, according to the source of a file."""

    module: str
    """Dotted name of the module."""
    constants: dict[str, Any]
    """The class attributes assigned to constants; others have the value None."""


class Registry(Generic[T]):
    """The named classes of one kind.

    The registry contains the classes of the package's modules whose source assigns one of the
    ``attributes``, those of installed packages in the entry-point group of the kind, such as
    ``pinnobs_gym.systems``, and those given to `register`. The name of a class is its attribute
    ``name``, or else its own name.

    Args:
        kind: name of the kind in messages, such as ``"system"``.
        base: ``module:Class`` of the base class, imported on first use.
        package: dotted name of the package whose files are read.
        attributes: class attributes that identify a class of this kind in a source.
    """

    def __init__(self, kind: str, base: str, package: str, *attributes: str) -> None:
        self._kind = kind
        self._base_path = base
        self._package = package
        self._attributes = attributes
        self._known: dict[str, type[T]] = {}
        """The imported classes by name."""
        self._all_imported = False
        self._sources: dict[str, NameSource] | None = None

    @property
    def sources(self) -> dict[str, NameSource]:
        """The names defined in the sources of the package, without importing them. Warns of each
        file that is not valid Python, and of each name that is already taken."""
        if self._sources is None:
            self._sources = _scanned_sources(self._kind, self._package, self._attributes)
        return self._sources

    def classes(self) -> dict[str, type[T]]:
        """Return all classes by name, sorted. Imports their modules on the first call, with a
        warning for each module that cannot be imported."""
        if not self._all_imported:
            self._all_imported = True
            for name in self.sources:
                try:
                    self._import_class(name)
                except ValueError as error:
                    warnings.warn(str(error), stacklevel=2)
            self.plug_ins()
        return dict(sorted(self._known.items()))

    def plug_ins(self) -> list[type[T]]:
        """Import and return the classes announced by installed packages, with a warning for each
        that cannot be imported."""
        return self._announced()

    def _announced(self, wanted: str | None = None) -> list[type[T]]:
        """Import the classes for `plug_ins`; of a wanted name only as many as it takes, and those
        announced under that name first."""
        classes = []
        points = entry_points(group=f"pinnobs_gym.{self._kind}s")
        for point in sorted(points, key=lambda point: point.name != wanted):
            if wanted in self._known:
                break
            try:
                classes.append(self.register(point.load()))
            except KeyboardInterrupt:
                raise
            except BaseException as error:  # whatever another package raises
                line = error_line(error)
                message = f"{self._kind} plug-in {point.name!r} is left out: {line}"
                warnings.warn(message, stacklevel=2)
        return classes

    def register(self, cls: type[T]) -> type[T]:
        """Add a class; usable as a decorator.

        Raises:
            TypeError: if it is not a concrete class of this kind.
            ValueError: if another class has its name.
        """
        if not self._is_concrete(cls):
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
        self._known[name] = cls  # a reloaded class replaces its earlier version
        return cls

    def resolve(self, spec: str | type[T], near: type | None = None) -> type[T]:
        """Return the class for a name, a ``module:Class`` path or the class itself.

        Args:
            spec: the name, path or class.
            near: a class of any kind; a name is first looked for `beside` it.

        Raises:
            ValueError: in one line; for an unknown name it lists the known ones.
        """
        if not isinstance(spec, str):
            return self.register(spec)
        if ":" in spec:
            return self._imported(spec)
        if near is not None and (found := self.beside(near).get(spec)) is not None:
            return self.register(found)
        if spec not in self._known and spec in self.sources:
            self._import_class(spec)
        if spec not in self._known:
            self._announced(spec)
        if spec not in self._known:
            known = ", ".join(sorted({*self._known, *self.sources}))
            if not known:  # e.g. if a folder in the working folder shadows the package
                place = ", ".join(importlib.import_module(self._package).__path__)
                raise ValueError(
                    f"unknown {self._kind} {spec!r}; there is none in {place}, which is imported "
                    f"as {self._package}"
                )
            guess = did_you_mean(spec, {*self._known, *self.sources})
            own = f"; one of your own is given as module:{self._kind.title()}"
            raise ValueError(f"unknown {self._kind} {spec!r}; known are {known}{guess or own}")
        return self._known[spec]

    def beside(self, cls: type) -> dict[str, type[T]]:
        """Return the classes of this kind that a class of any kind has beside it, by name: those
        that its module, or the module of one of its bases, defines or imports."""
        found: dict[str, type[T]] = {}
        for name in dict.fromkeys(base.__module__ for base in cls.__mro__):
            if name.partition(".")[0] in sys.stdlib_module_names:
                continue  # names of typing warn when they are looked at
            module = sys.modules.get(name)
            for value in () if module is None else tuple(vars(module).values()):
                if self._is_concrete(value):
                    found.setdefault(self.name_of(value), value)
        return found

    def spec_of(self, cls: type[T]) -> str:
        """Return what a command takes for a class: its name if the package has it, or else its
        path."""
        name = self.name_of(cls)
        return name if name in self.sources else f"{cls.__module__}:{cls.__qualname__}"

    def name_of(self, cls: type[T]) -> str:
        """Return the name under which a class is registered."""
        return getattr(cls, "name", cls.__name__)

    @contextmanager
    def isolated(self) -> Iterator[None]:
        """Yield a context at whose end all registrations made in it are undone."""
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
        """Import and register the class at ``module:Class``.

        Raises:
            ValueError: in one line, if it cannot be imported or registered.
        """
        module, _, name = spec.partition(":")
        try:
            if module not in sys.modules:
                _discard_stale_neighbours(module)
            return self.register(getattr(importlib.import_module(module), name))
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # whatever the user's module raises, such as SystemExit
            for cls in self._known.values():  # a class defined in a function or a notebook's cell
                if (cls.__module__, cls.__qualname__) == (module, name):
                    return cls
            if isinstance(error, AttributeError) and ("<locals>" in name or module == "__main__"):
                raise ValueError(
                    f"cannot load {self._kind} {spec!r} in a new process, which does not know what "
                    "a function, a notebook or the main guard has defined; expected a class at "
                    "the top level of a module"
                ) from None
            advice = self._advice(module, name)
            raise ValueError(
                f"cannot load {self._kind} {spec!r}: {error_line(error)}{advice}"
            ) from error

    def _advice(self, module: str, name: str) -> str:
        """Return what may have been meant by ``module:Class`` that cannot be loaded, as the end of
        a message; empty if nothing is known."""
        if module.endswith(".py") or "/" in module or "\\" in module:
            dotted = ".".join(Path(module).with_suffix("").parts)
            return f"; a module is named without .py and with dots: {dotted}:{name}"
        found = sys.modules.get(module)
        own = [] if found is None else [v for v in vars(found).values() if self._is_concrete(v)]
        if not own or any(cls.__name__ == name for cls in own):
            return ""
        names = [cls.__name__ for cls in own if cls.__module__ == module]
        return did_you_mean(name, names) or (
            f"; it has {', '.join(sorted(names))}" if names else ""
        )

    def _owner(self, name: str) -> tuple[str, str] | None:
        """Return the module and qualified name of the class with this name, or None."""
        if name not in self._known and name in self.sources:
            self._import_class(name)
        cls = self._known.get(name)
        return None if cls is None else (cls.__module__, cls.__qualname__)

    def _import_class(self, name: str) -> None:
        """Import the class that a source defines under a name.

        Raises:
            ValueError: in one line, if its module cannot be imported.
        """
        origin = self.sources[name].module
        try:
            module = importlib.import_module(origin)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # whatever the file raises
            message = f"cannot load {self._kind} {name!r} from {origin}: {error_line(error)}"
            raise ValueError(message) from error
        for cls in vars(module).values():
            if (
                self._is_concrete(cls)
                and cls.__module__ == module.__name__
                and self.name_of(cls) == name
            ):
                self._known.setdefault(name, cls)

    def _is_concrete(self, cls: object) -> bool:
        return isinstance(cls, type) and issubclass(cls, self._base) and not inspect.isabstract(cls)


def discard_stale_bytecode(source: Path) -> bool:
    """Delete a module's compiled file if it is that of an earlier source; return whether it was.

    Python takes a compiled file for that of the source if size and time of change in whole seconds
    agree. It then runs the code of before for a source that was edited, in as many characters,
    within a second of its compilation.
    """
    try:
        compiled = Path(importlib.util.cache_from_source(str(source)))
        edited, made = source.stat(), compiled.stat()
        if made.st_mtime_ns > edited.st_mtime_ns:
            return False  # compiled after the last edit
        content = compiled.read_bytes()
        flags, time, size = struct.unpack("<III", content[4:16])
        taken = (int(edited.st_mtime) & 0xFFFFFFFF, edited.st_size & 0xFFFFFFFF)
        if flags or (time, size) != taken:
            return False  # Python compiles the source anew, or checks it by its hash
        code = compile(source.read_bytes(), str(source), "exec", dont_inherit=True)
        if marshal.loads(content[16:]) == code:
            return False
        compiled.unlink()
    except (OSError, SyntaxError, ValueError, EOFError, TypeError, NotImplementedError):
        return False  # without a compiled file, or one that Python does not take
    return True


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """Return the known name that an unknown one is most like, as the end of a message; empty if it
    is like none."""
    by_letters = {each.casefold(): each for each in known}
    near = difflib.get_close_matches(str(name).casefold(), by_letters, n=1, cutoff=_ALIKE)
    return "".join(f"; did you mean {by_letters[each]!r}?" for each in near)


def error_line(error: BaseException) -> str:
    """Return the kind and the text of an error in one line of at most 1000 printable characters.

    The methods of an error that a plug-in defines may themselves raise anything; this function
    never does.
    """
    try:
        kind = str(type(error).__name__)
    except BaseException:  # of a metaclass
        kind = "an error without a name"
    try:
        text = "".join(c if c.isprintable() else " " for c in format(str(error), ""))
    except BaseException:
        text = "an error without a readable text"
    return " ".join(f"{kind}: {text}".split()).removesuffix(":")[:1000]


def _discard_stale_neighbours(module: str) -> None:
    """Discard stale bytecode of a module that is not imported yet, and of those in its folder."""
    spec = importlib.util.find_spec(module)
    if spec is not None and spec.origin is not None:
        for source in Path(spec.origin).parent.glob("*.py"):
            discard_stale_bytecode(source)


def _scanned_sources(kind: str, package: str, attributes: tuple[str, ...]) -> dict[str, NameSource]:
    """Read the sources for `Registry.sources`, which describes the result and the warnings."""
    sources: dict[str, NameSource] = {}
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
                    if name in sources:
                        other = f"{sources[name].module} has one of that name"
                        message = f"{node.name!r} in {module}: {other}"
                        warnings.warn(f"left out as a {kind}: {message}", stacklevel=3)
                        continue
                    sources[name] = NameSource(module, constants)
    return dict(sorted(sources.items()))


def _modules(package: str) -> tuple[str, ...]:
    """Return the sorted dotted names of the modules of a package; only the package itself is
    imported."""
    path = importlib.import_module(package).__path__
    return tuple(sorted(m.name for m in pkgutil.iter_modules(path, f"{package}.")))


def _source(module: str) -> str:
    """Return a module's source without importing the module."""
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        raise ImportError(f"module {module} has no source")
    return Path(spec.origin).read_text(encoding="utf-8")


def _constants(node: ast.ClassDef) -> dict[str, Any]:
    """Return the class attributes that a body assigns, with their values if these are constants."""
    constants = {}
    for statement in node.body:
        if isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name):
            try:
                constant = ast.literal_eval(statement.value)
            except ValueError:
                constant = None
            constants[statement.targets[0].id] = constant
    return constants


TRAINERS: Registry[Any] = Registry(
    "trainer", "pinnobs_gym.training.trainer:Trainer", "trainers", "name"
)
"""All trainers by name. The registry is defined here for estimators, which know trainers only by
name."""


def trainer_class(estimator: Any) -> Any:
    """Return the trainer of an estimator's class, which it names in ``needs_training`` or
    ``trains_on_record``: by ``module:Class``, by a name `beside` it, or by a name in `TRAINERS`.

    Raises:
        ValueError: in one line, if there is none.
    """
    spec = estimator.needs_training or estimator.trains_on_record
    return TRAINERS.resolve(spec, near=estimator)


def trainer_name(estimator: Any) -> str | None:
    """Return the name of the trainer that an estimator's class needs, None if it needs none.

    Raises:
        ValueError: in one line, if the trainer is given by ``module:Class`` and cannot be imported.
    """
    spec: str | None = estimator.needs_training
    return spec if spec is None or ":" not in spec else TRAINERS.resolve(spec).name
