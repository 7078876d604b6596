"""What the source of one module says: the digest of its code, and what it imports.

Parsing takes long, so that what a source says is kept beside its compiled file, in the folder
``__pycache__``, for the next process. As with compiled files, nothing is written where Python was
told to write none. What is kept counts for the very bytes of the source, and for the version of
Python and the code of this module that parsed them.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import json
import sys
from collections.abc import Iterator
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

from pinnobs_gym.files import replacing

Import: TypeAlias = tuple[str, str]
"""A module, and the name that is imported from it, if any."""


def told(file: Path, package: str) -> tuple[str, tuple[Import, ...]]:
    """Return the digest of the code of a module of a package, and its imports.

    Raises:
        OSError: if the file cannot be read.
        SyntaxError: if it is no Python.
    """
    source = file.read_bytes()
    state = hashlib.sha256(_parser() + repr((package, source)).encode()).hexdigest()
    kept = _kept_in(file)
    with suppress(OSError, ValueError, KeyError, TypeError):  # none, or one that was cut short
        found = json.loads(kept.read_text(encoding="utf-8"))
        if found["of"] == state:
            return found["code"], tuple((base, name) for base, name in found["imports"])
    tree = ast.parse(source)
    imports = (*_imports(package, tree), *_imports_by_call(package, tree, source))
    code = digest(_shape(tree))
    if not sys.dont_write_bytecode:
        with suppress(ValueError), replacing(kept) as new:  # the folder may be read-only
            new.write_text(json.dumps({"of": state, "code": code, "imports": imports}))
    return code, imports


def digest(value: Any) -> str:
    """Return a short hash of what `repr` shows of a value."""
    return hashlib.sha256(repr(value).encode()).hexdigest()[:12]


@lru_cache(maxsize=1)
def _parser() -> bytes:
    """Return what the result depends on beside the source: Python and this module."""
    return sys.version.encode() + Path(__file__).read_bytes()


def _kept_in(file: Path) -> Path:
    """Return the file in which is kept what a source says."""
    return Path(importlib.util.cache_from_source(str(file))).with_suffix(".code.json")


def _shape(node: Any) -> list[str]:
    """Return the shape of a syntax tree: no positions, no docstrings, no empty fields, which
    differ between versions of Python."""
    shape: list[str] = []
    _append_shape(node, shape)
    return shape


def _append_shape(node: Any, shape: list[str]) -> None:
    if isinstance(node, ast.AST):
        shape.append(type(node).__name__)
        for name in node._fields:
            value = getattr(node, name, None)
            if not (value is None or (type(value) is list and not value) or name == "kind"):
                shape.append(name)
                _append_shape(value, shape)
        shape.append(")")
    elif isinstance(node, list):
        for part in node:
            if not _is_text(part):
                _append_shape(part, shape)
        shape.append("]")
    else:
        shape.append(repr(node))


def _is_text(node: Any) -> bool:
    """Return whether a statement is a string alone, such as a docstring."""
    if not (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)):
        return False
    return isinstance(node.value.value, str)


def _imports(package: str, tree: ast.Module) -> Iterator[Import]:
    """Yield what a module of a package imports, at its head or inside functions."""
    for node in _executed(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, ""
        elif isinstance(node, ast.ImportFrom):
            base = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            for alias in node.names:
                yield base, alias.name


_CALLS = ("import_module", "__import__")
"""The functions that import a module by its name."""


def _imports_by_call(package: str, tree: ast.Module, source: bytes) -> Iterator[Import]:
    """Yield the modules that calls of `_CALLS` in a module of a package import, where the name is a
    constant."""
    if not any(function.encode() in source for function in _CALLS):
        return  # a walk through all expressions takes as long as all the rest
    for statement in _executed(tree):
        for node in _expressions(statement):
            if not isinstance(node, ast.Call):
                continue
            function = getattr(node.func, "attr", getattr(node.func, "id", None))
            given = [*node.args[:1], *(part.value for part in node.keywords if part.arg == "name")]
            if function not in _CALLS or not given or not isinstance(given[0], ast.Constant):
                continue
            name = given[0].value
            with suppress(ImportError):  # a relative name outside a package, which Python refuses
                if type(name) is str and name:
                    yield importlib.util.resolve_name(name, package), ""


def _expressions(statement: ast.AST) -> Iterator[ast.AST]:
    """Yield the expressions of a statement, without those of the statements in its blocks."""
    waiting = [statement]
    while waiting:
        for node in ast.iter_child_nodes(waiting.pop()):
            if not isinstance(node, ast.stmt | ast.ExceptHandler | ast.match_case):
                waiting.append(node)
                yield node


_BLOCKS = ("body", "orelse", "finalbody", "handlers", "cases")
"""The fields of statements that hold statements."""


def _executed(tree: ast.Module) -> Iterator[ast.AST]:
    """Yield the statements of a module, without blocks for type checkers."""
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        yield node
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            waiting += node.orelse
            continue
        for name in _BLOCKS:
            waiting += getattr(node, name, ())
