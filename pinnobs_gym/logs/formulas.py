"""Formulas of a log's columns, such as ``current/1000``: parsed, and never run as code."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

FUNCTIONS: Mapping[str, tuple[Any, int]] = {
    "sin": (np.sin, 1),
    "cos": (np.cos, 1),
    "tan": (np.tan, 1),
    "asin": (np.arcsin, 1),
    "acos": (np.arccos, 1),
    "atan2": (np.arctan2, 2),
    "sqrt": (np.sqrt, 1),
    "abs": (np.abs, 1),
    "exp": (np.exp, 1),
    "log": (np.log, 1),
    "radians": (np.radians, 1),
    "degrees": (np.degrees, 1),
}
"""Functions of formulas and the number of their arguments; ``log`` is the natural logarithm."""
OPERATORS: Mapping[str, tuple[Any, int]] = {
    "+": (np.add, 2),
    "-": (np.subtract, 2),
    "*": (np.multiply, 2),
    "/": (np.divide, 2),
    "**": (np.power, 2),
    "negative": (np.negative, 1),
}
CONSTANTS: Mapping[str, float] = {"pi": np.pi}

_LONGEST = 500
"""Number of characters of the longest formula."""
_DEEPEST = 40
"""Number of parentheses, signs and powers that may be within each other."""
_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)"
    r"|(?P<name>[^\W\d]\w*)|\{(?P<braced>[^{}]*)\}|(?P<sign>\*\*|[-+*/(),]))"
)


@dataclass(frozen=True)
class Formula:
    """A formula of columns.

    It consists of names of columns, numbers, ``+ - * / **``, parentheses, ``pi`` and `FUNCTIONS`. A
    name that is no identifier stands in braces, as in ``{Time (s)}``, and so may any other name.
    """

    text: str
    """The formula as it was written."""
    columns: tuple[str, ...]
    """Names of the columns in it, each once."""
    program: tuple[tuple[str, Any], ...]
    """Its steps in the order of their execution on a stack of values: ``number``, ``column`` or
    ``apply``, with the number, or the name of a column, a function or an operator."""

    @staticmethod
    def column(name: str) -> Formula:
        """Return the formula that is a column."""
        return Formula(name, (name,), (("column", name),))

    @property
    def plain(self) -> bool:
        """Whether the formula is nothing but a column."""
        return [kind for kind, _ in self.program] == ["column"]

    def values(self, columns: Mapping[str, np.ndarray], size: int) -> np.ndarray:
        """Return the formula's values (size,), NaN where a column in it is NaN.

        Args:
            columns: the values (size,) of the columns by name.
            size: number of rows.
        """
        stack: list[Any] = []
        with np.errstate(all="ignore"):  # the caller tells values that are not finite
            for kind, value in self.program:
                if kind == "apply":
                    function, count = {**FUNCTIONS, **OPERATORS}[value]
                    stack[-count:] = [function(*stack[-count:])]
                else:
                    stack.append(columns[value] if kind == "column" else np.float64(value))
        (result,) = stack
        found = np.array(np.broadcast_to(result, (size,)))
        for name in self.columns:  # NaN**0 is 1, but nothing follows from a missing value
            found[np.isnan(columns[name])] = np.nan
        return found


def parsed(text: str) -> Formula:
    """Return the formula of a text.

    Raises:
        ValueError: in one line without the text, if it is not a formula.
    """
    if len(text) > _LONGEST:
        raise ValueError(f"{len(text)} characters; expected at most {_LONGEST}")
    parser = _Parser(_tokens(text))
    parser.sum()
    if parser.next is not None:
        raise ValueError(f"{parser.shown} is unexpected; expected an operator or the end")
    steps = tuple(parser.steps)
    names = dict.fromkeys(value for kind, value in steps if kind == "column")
    return Formula(text, tuple(names), steps)


def _tokens(text: str) -> list[tuple[str, str]]:
    """Return the kind and the text of each part of a formula."""
    tokens, position, end = [], 0, len(text.rstrip())
    while position < end:
        match = _TOKEN.match(text, position)
        if match is None:
            rest = text[position:].lstrip()
            raise ValueError(
                f"{rest[0]!r} is not part of a formula; expected names, numbers, + - * / **, "
                "parentheses and functions, with names that are no identifiers in braces"
            )
        kind = str(match.lastgroup)
        name = match[kind]
        tokens.append(("column", name.strip()) if kind == "braced" else (kind, name))
        position = match.end()
    return tokens


class _Parser:
    """A parser by recursive descent, which writes the steps of a formula."""

    def __init__(self, tokens: list[tuple[str, str]]) -> None:
        self._tokens = tokens
        self._position = 0
        self._depth = 0
        self.steps: list[tuple[str, Any]] = []

    @property
    def next(self) -> tuple[str, str] | None:
        """The next token; None at the end."""
        at_end = self._position == len(self._tokens)
        return None if at_end else self._tokens[self._position]

    @property
    def shown(self) -> str:
        """The next token in words."""
        return "the end" if self.next is None else repr(self.next[1])

    def sum(self) -> None:
        """A product, or a sum of several, from left to right."""
        self._product()
        while sign := self._taken("+", "-"):
            self._product()
            self.steps.append(("apply", sign))

    def _product(self) -> None:
        self._signed()
        while sign := self._taken("*", "/"):
            self._signed()
            self.steps.append(("apply", sign))

    def _signed(self) -> None:
        """A power, with signs before it: -x**2 is -(x**2)."""
        self._depth += 1
        if self._depth > _DEEPEST:
            raise ValueError(f"more than {_DEEPEST} levels; expected fewer parentheses and signs")
        if sign := self._taken("-", "+"):
            self._signed()
            if sign == "-":
                self.steps.append(("apply", "negative"))
        else:
            self._atom()
            if self._taken("**"):  # from the right: x**y**z is x**(y**z)
                self._signed()
                self.steps.append(("apply", "**"))
        self._depth -= 1

    def _atom(self) -> None:
        if self._taken("("):
            self.sum()
            self._expected(")")
            return
        if self.next is None or self.next[0] == "sign":
            raise ValueError(f"{self.shown} is unexpected; expected a name, a number or '('")
        kind, text = self.next
        self._position += 1
        if kind == "number":
            self.steps.append(("number", float(text)))
        elif kind == "name" and self._taken("("):
            self._call(text)
        elif kind == "name" and text in CONSTANTS:
            self.steps.append(("number", CONSTANTS[text]))
        else:
            self.steps.append(("column", text))

    def _call(self, name: str) -> None:
        """The arguments of a function, after its parenthesis."""
        if name not in FUNCTIONS:
            known = ", ".join(FUNCTIONS)
            raise ValueError(f"unknown function {name!r}; known are {known}")
        count = FUNCTIONS[name][1]
        for i in range(count):
            if i:
                self._expected(",")
            self.sum()
        self._expected(")")
        self.steps.append(("apply", name))

    def _taken(self, *signs: str) -> str:
        """Move past the next token if it is one of these signs, and return it; else nothing."""
        if self.next is None or self.next[0] != "sign" or self.next[1] not in signs:
            return ""
        self._position += 1
        return self._tokens[self._position - 1][1]

    def _expected(self, sign: str) -> None:
        if not self._taken(sign):
            raise ValueError(f"{self.shown} is unexpected; expected {sign!r}")
