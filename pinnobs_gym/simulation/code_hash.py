"""Hashes of code, on which a score depends beside the settings.

The syntax trees of a module and of all modules of its project that it imports are hashed, also
those imported inside functions or by ``importlib.import_module`` and ``__import__`` with a constant
name, the packages that these are in, and the templates of compiled code. Docstrings and comments of
Python do not count. Packages of others count by their version alone, which rows carry; files that
code reads at run time are not seen.
"""

from __future__ import annotations

import hashlib
import importlib.util
import sys
import sysconfig
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import lru_cache
from importlib.machinery import ModuleSpec
from importlib.resources import files
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import numpy as np

from pinnobs_gym.registry import discard_stale_bytecode
from pinnobs_gym.simulation.code_source import Import, digest, told
from pinnobs_gym.simulation.system import System

_OWN = frozenset({"pinnobs_gym", "trainers"})
"""Packages that are followed wherever they are installed. Their own files ``__init__`` only export
names, and count where they are imported themselves."""
_TEMPLATED = "pinnobs_gym.simulation.kernels.source"
"""The module whose templates of compiled code count with it."""
_FACE = "pinnobs_gym"
"""The package whose names are imported lazily from the modules below it."""


class Unreadable(Exception):
    """Code without readable source, such as a lambda or a cell of a notebook."""


def code_hash(*subjects: type | str) -> str:
    """Return the hash of the code of classes, with all that they derive from, and of modules by
    name, with all that these import of their projects.

    The code counts as it was loaded: an edited file counts once its module is loaded again.

    Raises:
        Unreadable: in one line, if the source of a class or module cannot be read.
        ValueError: in one line, if Python has loaded the compiled file of an earlier source.
    """
    return digest(sorted(module_hashes(*subjects).items()))


def module_hashes(*subjects: type | str, without: str = "") -> dict[str, str]:
    """Return the hash of each module that `code_hash` follows, by name, without those of a package
    and what only these import. The errors are those of `code_hash`."""
    names = {name for subject in subjects for name in _modules(subject)}
    home = {name.partition(".")[0] for name in names} | _OWN
    digests: dict[str, str] = {}
    waiting = sorted(names)
    while waiting:
        name = waiting.pop()
        if name not in digests and not (without and f"{name}.".startswith(f"{without}.")):
            digests[name], imports = _loaded(name)
            if name == _TEMPLATED:
                digests[f"{name}/templates"] = _templates()
            waiting += _packages_of(name)
            followed = [pair for pair in imports if _is_followed(pair[0], home)]
            waiting += [_home_of(base, part) for base, part in followed]
    return digests


@lru_cache(maxsize=1)
def _templates() -> str:
    """Return the digest of the templates of compiled code, in C."""
    folder = files("pinnobs_gym.simulation.kernels") / "templates"
    return digest(sorted((file.name, file.read_text("utf-8")) for file in folder.iterdir()))


def content(value: Any) -> Any:
    """Convert settings and trained values to nested lists and numbers, of which arrays are
    represented by a hash. Functions and classes are represented by the hash of their code.

    Raises:
        Unreadable: in one line, if a part is neither data nor code with a source.
    """
    if value is None or isinstance(value, bool | int | float | str | bytes | complex):
        return repr(value)
    if isinstance(value, np.ndarray | np.generic):
        array = np.ascontiguousarray(value)
        return [str(array.dtype), array.shape, hashlib.sha256(array.tobytes()).hexdigest()]
    if isinstance(value, Mapping):
        return sorted([str(name), content(part)] for name, part in value.items())
    if isinstance(value, set | frozenset):
        return sorted(repr(content(part)) for part in value)
    if isinstance(value, list | tuple):
        return [content(part) for part in value]
    if isinstance(value, Path):
        return str(value)
    if is_dataclass(value) and not isinstance(value, type):
        code = code_hash(type(value)) if isinstance(value, System) else ""
        parts = [[f.name, content(getattr(value, f.name))] for f in fields(value)]
        return [type(value).__qualname__, code, parts]
    if isinstance(value, type):
        return [value.__qualname__, code_hash(value)]
    if isinstance(value, FunctionType) and "<" not in value.__qualname__:
        return [value.__qualname__, code_hash(value.__module__)]
    name = getattr(value, "__qualname__", type(value).__qualname__)
    raise Unreadable(f"{name} is neither data nor code with a source of its own")


def _modules(subject: type | str) -> Iterator[str]:
    """Yield the modules that define a class and its bases, without those of foreign packages."""
    if isinstance(subject, str):
        yield subject
        return
    home = {subject.__module__.partition(".")[0]} | _OWN
    for cls in subject.__mro__:
        if cls is subject or _is_followed(cls.__module__, home):
            yield cls.__module__


def _is_followed(name: str, home: set[str] | frozenset[str]) -> bool:
    """Return whether a module belongs to a project: those of the subjects, and any whose files are
    not installed as a package of others."""
    top = name.partition(".")[0]
    if top in home:
        return True
    if top in sys.stdlib_module_names:
        return False
    return not is_installed(top)


def _packages_of(name: str) -> Iterator[str]:
    """Yield the packages that a module is in, whose ``__init__`` Python runs before it. Packages
    without one have no code."""
    parts = name.split(".")
    if parts[0] in _OWN:
        return
    for count in range(1, len(parts)):
        package = ".".join(parts[:count])
        if _file_of(package) is not None:
            yield package


@lru_cache(maxsize=512)
def is_installed(top: str) -> bool:
    """Return whether a top-level package comes from the folders of installed packages, or from
    nowhere."""
    try:
        spec = importlib.util.find_spec(top)
    except (ImportError, ValueError):
        return True
    if spec is None:
        return True
    origin = spec.origin or next(iter(spec.submodule_search_locations or ()), None)
    if origin is None or origin in ("built-in", "frozen"):
        return True
    paths = {sysconfig.get_path(kind) for kind in ("purelib", "platlib", "stdlib", "platstdlib")}
    parents = Path(origin).resolve().parents
    if any(parent.name in ("site-packages", "dist-packages") for parent in parents):
        return True
    return any(Path(path).resolve() in parents for path in paths if path)


_LOADED: dict[str, tuple[ModuleType, ModuleSpec | None, str, tuple[Import, ...]]] = {}
"""By name: the module and its spec, of which a reload makes new ones, the digest of its code, and
its imports."""


def _loaded(name: str) -> tuple[str, tuple[Import, ...]]:
    """Return the digest of a module's code, and its imports."""
    module = sys.modules.get(name)
    if module is not None and name in _LOADED:
        same, spec, code, imports = _LOADED[name]
        if same is module and spec is module.__spec__:
            return code, imports
    spec, file = _spec(name), _file_of(name)
    if file is None or not file.endswith(".py"):
        raise Unreadable(f"module {name} has no source file")
    if discard_stale_bytecode(Path(file)) and module is not None:
        raise ValueError(
            f"{file} was edited within a second of being compiled, and Python has loaded what it "
            "held before; run again"
        )
    package = (spec.parent if spec else name.rpartition(".")[0]) or ""
    try:
        code, imports = told(Path(file), package)
    except (OSError, SyntaxError) as error:
        raise Unreadable(f"module {name}: {error}") from None
    if module is not None:
        _LOADED[name] = module, module.__spec__, code, imports
    return code, imports


def _home_of(base: str, name: str) -> str:
    """Return the module that ``from base import name`` takes the name from."""
    if base == _FACE:
        face = sys.modules[_FACE]  # loaded, as this module is a part of it
        if name in face.__all__:
            return getattr(getattr(face, name), "__module__", base)
    spec = _spec(base)
    if spec is None or spec.submodule_search_locations is None:
        return base  # no package; asking for a module in it would import it
    return f"{base}.{name}" if name and _spec(f"{base}.{name}") else base


def _file_of(name: str) -> str | None:
    """Return the file of a module, loaded or not; None if there is none, as for a namespace."""
    file = getattr(sys.modules.get(name), "__file__", None)
    if file is not None:
        return file
    spec = _spec(name)
    return None if spec is None else spec.origin


def _spec(name: str) -> ModuleSpec | None:
    """Return the spec of a module, loaded or not; None if there is no such module."""
    if name in sys.modules:
        return sys.modules[name].__spec__
    try:
        return importlib.util.find_spec(name)
    except (ImportError, ValueError):
        return None
