"""Finding systems, estimators and trainers by name: files of a package, entry points, plug-ins."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import warnings
from importlib.metadata import entry_points
from typing import Generic, TypeVar

T = TypeVar("T")


class Registry(Generic[T]):
    """The classes of one kind that can be named.

    Found are: every concrete subclass of ``base`` defined in a module of the ``packages``, those
    that installed packages announce in the entry-point group named like the first of these, and
    those given to `register`.
    A class is named by its class attribute ``name``, or else by its own name.
    """

    def __init__(self, kind: str, base: type[T], *packages: str) -> None:
        self._kind = kind
        self._base = base
        self._packages = packages
        self._classes: dict[str, type[T]] | None = None

    def classes(self) -> dict[str, type[T]]:
        """All classes by name, sorted; imports their modules on the first call."""
        if self._classes is None:
            self._classes = {}
            for package in map(importlib.import_module, self._packages):
                for module in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
                    for cls in vars(importlib.import_module(module.name)).values():
                        if self._is_one(cls) and cls.__module__ == module.name:
                            self.register(cls)
            for point in entry_points(group=self._packages[0]):
                try:
                    self.register(point.load())
                except Exception as error:
                    warnings.warn(
                        f"{self._kind} plug-in {point.name!r} is left out: {error}", stacklevel=2
                    )
        return dict(sorted(self._classes.items()))

    def register(self, cls: type[T]) -> type[T]:
        """Add a class; usable as a decorator.

        Raises:
            TypeError: if it is not a concrete class of this kind.
            ValueError: if another class has its name.
        """
        if not self._is_one(cls):
            raise TypeError(f"{cls!r} is not a concrete subclass of {self._base.__name__}")
        classes = self._classes if self._classes is not None else self.classes()
        assert self._classes is not None
        name = self.name_of(cls)
        known = classes.get(name)
        same = known is not None and (known.__module__, known.__qualname__) == (
            cls.__module__,
            cls.__qualname__,
        )  # a class that was imported anew replaces what it was
        if known is not None and not same:
            raise ValueError(f"{self._kind} {name!r} is already {known.__module__}.{name}")
        self._classes[name] = cls
        return cls

    def resolve(self, spec: str | type[T]) -> type[T]:
        """The class that a name, a ``module:Class`` path or the class itself means.

        Raises:
            ValueError: in one line; for an unknown name it lists the known ones.
        """
        if not isinstance(spec, str):
            return self.register(spec)
        if ":" in spec:
            module, _, name = spec.partition(":")
            try:
                return self.register(getattr(importlib.import_module(module), name))
            except Exception as error:  # whatever the user's module raises
                kind = type(error).__name__
                raise ValueError(f"cannot load {self._kind} {spec!r}: {kind}: {error}") from error
        classes = self.classes()
        if spec not in classes:
            raise ValueError(f"unknown {self._kind} {spec!r}; known are {', '.join(classes)}")
        return classes[spec]

    def name_of(self, cls: type[T]) -> str:
        """The name a class is found by."""
        return getattr(cls, "name", cls.__name__)

    def _is_one(self, cls: object) -> bool:
        return isinstance(cls, type) and issubclass(cls, self._base) and not inspect.isabstract(cls)
