"""SymPy expressions of real numbers as lines of code, in NumPy or in C."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import sympy

from pinnobs_gym.simulation.tape import Choice, Pieces

_FUNCTIONS = {
    **{name: name for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log")},
    **{f"a{name}": f"arc{name}" for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
    "atan2": "arctan2",
    **{"RealAbs": "absolute", "RealSign": "sign", "RealFloor": "floor", "Choice": "where"},
    **{"Maximum": "maximum", "Minimum": "minimum", "Power": "power"},
    **{"And": "logical_and", "Or": "logical_or", "Not": "logical_not"},
}
"""NumPy's names of functions, by SymPy's or `pinnobs_gym.simulation.tape`'s."""
_RELATIONS = {sympy.Lt: "<", sympy.Le: "<=", sympy.Gt: ">", sympy.Ge: ">=", sympy.Eq: "=="}
_LARGEST_POWER = 16
"""Whole powers up to this one are products."""


class Printer:
    """Writes lines of code, ``name = ...``, and the code of expressions of these names.

    A branch that is not taken contributes nothing to a product, even where another factor is not
    finite: the derivative of √max(x, 0), step(x)/(2√max(x, 0)), is zero for negative x.

    Args:
        scalars: symbols that stand for numbers rather than arrays. Products begin with them, which
            takes less time.
    """

    def __init__(self, scalars: set[sympy.Symbol]) -> None:
        self.lines: list[str] = []
        self._scalars = set(scalars)
        self._gates: set[sympy.Symbol] = set()
        self._names: dict[str, str] = {}

    def define(self, symbol: sympy.Symbol, expression: Any) -> None:
        """Write the line that gives a symbol its value."""
        self.lines.append(self.line(str(symbol), self.code(expression)))
        if self._is_scalar(expression):
            self._scalars.add(symbol)
        if self._is_gate(expression):
            self._gates.add(symbol)

    def code(self, e: Any) -> str:
        """Return the code of an expression, in parentheses where it needs them.

        Raises:
            ValueError: if there is no such function in NumPy.
        """
        if e.is_Symbol:
            return str(e)
        if e in (sympy.true, sympy.false):
            return self.truth(e == sympy.true)
        if e.is_Number or e.is_NumberSymbol:
            value = float(e)
            text = repr(value) if math.isfinite(value) else self.infinite(value)
            return f"({text})" if value < 0 else text
        for kind, method in _METHODS.items():
            if isinstance(e, kind):
                return method(self, e)
        for kind, sign in _RELATIONS.items():
            if isinstance(e, kind):
                return f"({self.code(e.lhs)} {sign} {self.code(e.rhs)})"
        if isinstance(e, sympy.Ne):
            return f"({self.code(e.lhs)} != {self.code(e.rhs)})"
        name = _FUNCTIONS.get(type(e).__name__)
        if name is None:
            raise ValueError(f"{type(e).__name__} has no counterpart in NumPy")
        return self.call(name, [self.code(part) for part in e.args])

    def truth(self, value: bool) -> str:
        """Return the code of a truth value."""
        return str(value)

    def infinite(self, value: float) -> str:
        """Return the code of a number that is not finite."""
        return f"float('{value!r}')"

    def call(self, name: str, args: list[str]) -> str:
        """Return the call of a function by NumPy's name."""
        while name.startswith("logical") and len(args) > 2:  # NumPy's have two arguments
            args = [f"np.{name}({args[0]}, {args[1]})", *args[2:]]
        return f"np.{name}({', '.join(args)})"

    def line(self, name: str, code: str) -> str:
        """Return the line that gives a name its value."""
        return f"{name} = {code}"

    def _sum(self, e: Any) -> str:
        text = ""
        for term in self._scalars_first(e.args):
            negative = term.could_extract_minus_sign()
            part = self.code(-term if negative else term)
            text += f" {'-' if negative else '+'} {part}" if text else f"{'-' * negative}{part}"
        return f"({text})"

    def _product(self, e: Any) -> str:
        sign = ""
        if e.args[0] == -1:
            sign, e = "-", -e
            if not e.is_Mul:
                return f"(-{self.code(e)})"
        gates = [part for part in e.args if self._is_gate(part)]
        if gates and len(gates) < len(e.args):
            gate = self._named(self._factors(gates))
            rest = self._factors([part for part in e.args if part not in gates])
            return (
                f"({sign}{self.call('where', [f'({gate} == 0.0)', '0.0', f'({gate} * {rest})'])})"
            )
        return f"({sign}{self._factors(e.args)})"

    def _factors(self, parts: Sequence[Any]) -> str:
        """Return the code of a product of factors, those below the bar last."""
        below = [p for p in parts if p.is_Pow and p.exp.is_Number and p.exp.is_negative]
        above = [p for p in self._scalars_first(parts) if p not in below]
        text = " * ".join(map(self.code, above)) or "1.0"
        if below:
            under = " * ".join(self.code(1 / p) for p in self._scalars_first(below))
            text += f" / ({under})"
        return f"({text})"

    def _power(self, e: Any) -> str:
        base, exponent = e.args
        if exponent.is_Number and exponent.is_negative:
            return f"(1.0 / {self.code(1 / e)})"
        name, value = self._named(self.code(base)), float(exponent)
        whole, half = int(value), value % 1 == 0.5
        if value > _LARGEST_POWER or not (half or value == whole):
            return self.call("power", [name, repr(value)])
        factors = [self._whole_power(name, whole)] if whole else []
        return f"({' * '.join([*factors, self.call('sqrt', [name])] if half else factors)})"

    def _whole_power(self, name: str, n: int) -> str:
        """Return the code of a power by products of lower ones."""
        if n == 1:
            return name
        if n % 2:
            return f"{self._whole_power(name, n - 1)} * {name}"
        half = self._named(self._whole_power(name, n // 2))
        return f"{half} * {half}"

    def _piecewise(self, e: Any) -> str:
        text = self.infinite(math.nan)
        for value, condition in reversed(e.args):
            part = self.code(value)
            if condition != sympy.true:
                part = self.call("where", [self.code(condition), part, text])
            text = part
        return text

    def _pieces(self, e: Any) -> str:
        x, number, order = e.args
        return f"{self.table(int(number), int(order))}({self.code(x)})"

    def table(self, number: int, order: int) -> str:
        """Return the name of the function that evaluates a derivative of a table."""
        return f"table{number}_{order}"

    def _step(self, e: Any) -> str:
        return self.call("heaviside", [self.code(e.args[0]), "0.5"])

    def _named(self, code: str) -> str:
        """Return a name of the value of some code, for which a line is written if need be."""
        if code.isidentifier():
            return code
        if code not in self._names:
            self._names[code] = f"w{len(self._names)}"
            self.lines.append(self.line(self._names[code], code))
        return self._names[code]

    def _scalars_first(self, parts: Sequence[Any]) -> list[Any]:
        return sorted(parts, key=lambda part: not self._is_scalar(part))

    def _is_scalar(self, e: Any) -> bool:
        return e.free_symbols <= self._scalars

    def _is_gate(self, e: Any) -> bool:
        """Return whether an expression is zero where a branch is not taken."""
        if e.is_Mul:
            return any(map(self._is_gate, e.args))
        if isinstance(e, sympy.Piecewise):
            branches: Any = e.args
            return any(value == 0 for value, _ in branches)
        if isinstance(e, Choice):
            return 0 in e.args[1:]
        return e in self._gates or isinstance(e, sympy.Heaviside)


_METHODS: dict[Any, Callable[[Printer, Any], str]] = {
    sympy.Add: Printer._sum,
    sympy.Mul: Printer._product,
    sympy.Pow: Printer._power,
    sympy.Piecewise: Printer._piecewise,
    sympy.Heaviside: Printer._step,
    Pieces: Printer._pieces,
}
