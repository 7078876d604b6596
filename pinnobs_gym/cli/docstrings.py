"""Reading the docstrings that stand under fields and variables, which Python itself forgets."""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Sequence
from itertools import pairwise
from types import ModuleType


def field_docs(cls: type) -> dict[str, str]:
    """The docstring under each attribute of a class, those that it inherits included."""
    found: dict[str, str] = {}
    for each in reversed(cls.__mro__):
        try:
            source = inspect.getsource(each)
        except (OSError, TypeError):  # built in, or made without a file
            continue
        body = ast.parse(textwrap.dedent(source)).body[0]
        assert isinstance(body, ast.ClassDef)
        found |= _below(body.body)
    return found


def variable_docs(module: ModuleType) -> dict[str, str]:
    """The docstring under each variable of a module."""
    return _below(ast.parse(inspect.getsource(module)).body)


def _below(statements: Sequence[ast.stmt]) -> dict[str, str]:
    found = {}
    for statement, following in pairwise(statements):
        if isinstance(statement, ast.AnnAssign):
            targets = [statement.target]
        else:
            targets = statement.targets if isinstance(statement, ast.Assign) else []
        if isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant):
            text = inspect.cleandoc(str(following.value.value))
            found |= {target.id: text for target in targets if isinstance(target, ast.Name)}
    return found
