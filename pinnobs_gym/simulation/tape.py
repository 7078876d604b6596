"""A system's equations in small steps, and their derivatives by the chain rule.

SymPy's own derivative of a whole expression grows with its nesting, which is the longer the more
choices and maxima there are. Here each result of a function or of a few operations has a name, so
that all expressions stay small.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import sympy

from pinnobs_gym.simulation.expressions import FUNCTIONS, TRUTHS, Expressions, tidy

_LARGEST = 12
"""Number of operations of an expression without a name."""


class _Real(sympy.Function):
    """A function of real numbers."""

    if TYPE_CHECKING:
        args: Any  # pyright: ignore  # expressions, not of the base class alone


class RealAbs(_Real):
    """The size of a real number. SymPy's own allows complex ones, even in its derivative."""

    def fdiff(self, argindex: int = 1) -> Any:
        return RealSign(*self.args)


class RealSign(_Real):
    """The sign of a real number. The derivative of SymPy's own has an impulse at the jump."""

    def fdiff(self, argindex: int = 1) -> Any:
        return sympy.Integer(0)


class RealFloor(_Real):
    """The largest whole number that is not above a real one."""

    def fdiff(self, argindex: int = 1) -> Any:
        return sympy.Integer(0)


class Maximum(_Real):
    """The larger of two numbers; where they are equal, its derivative is the mean of theirs."""

    def fdiff(self, argindex: int = 1) -> Any:
        first, second = self.args if argindex == 1 else self.args[::-1]
        return sympy.Heaviside(first - second)


class Minimum(_Real):
    """The smaller of two numbers, with a derivative as that of `Maximum`."""

    def fdiff(self, argindex: int = 1) -> Any:
        first, second = self.args if argindex == 1 else self.args[::-1]
        return sympy.Heaviside(second - first)


class Power(_Real):
    """A power whose exponent is no number. SymPy's own derivative divides by the base, which may be
    zero."""

    def fdiff(self, argindex: int = 1) -> Any:
        base, exponent = self.args
        if argindex == 1:
            return exponent * Power(base, exponent - 1)
        return Power(base, exponent) * sympy.log(base)


class Choice(_Real):
    """One of two expressions, by a condition."""


class Pieces(_Real):
    """A derivative of a table at x: arguments x, the table's number, and the order."""

    def fdiff(self, argindex: int = 1) -> Any:
        x, number, order = self.args
        return Pieces(x, number, order + 1)


def _power(a: Any, b: Any) -> Any:
    return Power(a, b) if getattr(b, "free_symbols", None) else a**b


_FUNCTIONS = FUNCTIONS | {
    "absolute": RealAbs,
    "sign": RealSign,
    "floor": RealFloor,
    "remainder": lambda a, b: a - b * RealFloor(a / b),
    "maximum": Maximum,
    "minimum": Minimum,
    "clip": lambda a, low, high: Minimum(Maximum(a, low), high),
    "power": _power,
}


class Tape:
    """Expressions with names, and their derivatives by some of the symbols in them.

    Args:
        x: the symbols of the state.
    """

    def __init__(self, x: Sequence[sympy.Symbol]) -> None:
        self.x = list(x)
        self.definitions: dict[sympy.Symbol, Any] = {}
        """Expressions by name, in an order in which they can be computed."""
        self.tables: list[tuple[np.ndarray, np.ndarray]] = []
        """Knots and coefficients, (n + 1,) and (degree + 1, n + 1), of the tables."""
        self._names: dict[Any, sympy.Symbol] = {}
        self._partials: dict[tuple[Any, Any], Any] = {}
        self._slopes: dict[tuple[Any, Any], Any] = {}
        for symbol in self.x:
            self._slopes[symbol, symbol] = sympy.Integer(1)

    def kind(self) -> type[Expressions]:
        """Return the type of arrays of symbols whose functions write on this tape."""
        tape = self

        class Traced(Expressions):
            functions: ClassVar[Mapping[str, Callable[..., Any]]] = {
                name: tape._naming(function) for name, function in _FUNCTIONS.items()
            }

            @classmethod
            def choice(cls, condition: Any, yes: Any, no: Any) -> Any:
                return tape.named(Choice(condition, yes, no))

            @classmethod
            def kept(cls, expression: Any) -> Any:
                return tape.small(expression)

            def pieces(self, knots: np.ndarray, coefficients: np.ndarray) -> Any:
                number = tape._table(knots, coefficients)
                values = [tape.named(Pieces(x, number, 0)) for x in self.ravel().tolist()]
                return np.array(values, dtype=object).reshape(self.shape).view(type(self))

        return Traced

    def small(self, expression: Any) -> Any:
        """Return an expression, or its name if it has many operations."""
        if isinstance(expression, sympy.Expr) and expression.count_ops() > _LARGEST:
            return self.named(expression)
        return expression

    def named(self, expression: Any) -> Any:
        """Return the name of an expression; conditions, numbers and symbols need none."""
        if isinstance(expression, TRUTHS) or expression.is_Atom:
            return expression
        expression = _real(tidy(expression))
        if expression not in self._names:
            symbol = sympy.Symbol(f"v{len(self._names)}", real=True)
            self._names[expression], self.definitions[symbol] = symbol, expression
            self._differentiate(symbol, expression)
        return self._names[expression]

    def slope(self, expression: Any, x: sympy.Symbol) -> Any:
        """Return the total derivative of an expression by a component of the state."""
        if isinstance(expression, Choice):
            condition, *values = expression.args
            yes, no = (self.slope(value, x) for value in values)
            return yes if yes == no else Choice(condition, yes, no)
        terms = []
        for symbol in sorted(expression.free_symbols, key=str):
            inner = self._slopes.get((symbol, x))
            if inner is not None:
                if (expression, symbol) not in self._partials:
                    self._partials[expression, symbol] = sympy.diff(expression, symbol)
                terms.append(self._partials[expression, symbol] * inner)
        return sympy.Add(*terms)

    def _differentiate(self, symbol: sympy.Symbol, expression: Any) -> None:
        """Define the derivatives of a name that are not zero."""
        for i, x in enumerate(self.x):
            slope = self.slope(expression, x)
            if slope == 0:
                continue
            if not slope.is_Atom:
                name = sympy.Symbol(f"d{symbol}_{i}", real=True)
                self.definitions[name], slope = slope, name
            self._slopes[symbol, x] = slope

    def _naming(self, function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *args: self.named(function(*map(sympy.sympify, args)))

    def _table(self, knots: np.ndarray, coefficients: np.ndarray) -> int:
        """Return the number of a table."""
        for i, known in enumerate(self.tables):
            if all(map(np.array_equal, known, (knots, coefficients))):
                return i
        self.tables.append((knots, coefficients))
        return len(self.tables) - 1


def _real(expression: Any) -> Any:
    """Return an expression without SymPy's functions of complex numbers, which may come about when
    it simplifies, as in √a²."""
    for theirs, own in ((sympy.Abs, RealAbs), (sympy.sign, RealSign)):
        if expression.has(theirs):
            expression = expression.replace(theirs, own)
    return expression
