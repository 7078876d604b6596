"""Arrays of SymPy expressions, on which a system's equations can be called."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import numpy as np
import sympy
from sympy.logic.boolalg import BooleanAtom, BooleanFunction

FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{name: getattr(sympy, name) for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
    **{name: getattr(sympy, name) for name in ("exp", "log", "sqrt", "sign", "floor")},
    **{f"arc{name[1:]}": getattr(sympy, name) for name in ("asin", "acos", "atan")},
    **{f"arc{name[1:]}": getattr(sympy, name) for name in ("asinh", "acosh", "atanh")},
    "expm1": lambda a: sympy.exp(a) - 1,
    "log1p": lambda a: sympy.log(1 + a),
    "log10": lambda a: sympy.log(a) / sympy.log(10),
    "log2": lambda a: sympy.log(a) / sympy.log(2),
    **{
        "absolute": sympy.Abs,
        "arctan2": sympy.atan2,
        "hypot": lambda a, b: sympy.sqrt(a**2 + b**2),
    },
    **{"maximum": sympy.Max, "minimum": sympy.Min, "square": lambda a: a**2},
    "clip": lambda a, low, high: sympy.Min(sympy.Max(a, low), high),
    **{"less": sympy.Lt, "less_equal": sympy.Le, "greater": sympy.Gt, "greater_equal": sympy.Ge},
    **{"equal": sympy.Eq, "not_equal": sympy.Ne},
    **{"logical_and": sympy.And, "logical_or": sympy.Or, "logical_not": sympy.Not},
    **{"bitwise_and": sympy.And, "bitwise_or": sympy.Or, "invert": sympy.Not},
}
"""SymPy's counterparts of NumPy's functions, by NumPy's name; arithmetic needs none."""


class Expressions(np.ndarray):
    """An array of expressions that supports NumPy's functions, and thus the array API. Subclasses
    choose the functions."""

    _op_priority = 100  # so that expression * array calls the array's operator

    functions: ClassVar[Mapping[str, Callable[..., Any]]] = FUNCTIONS
    """As `FUNCTIONS`."""

    @classmethod
    def choice(cls, condition: Any, yes: Any, no: Any) -> sympy.Expr:
        """Return the expression of ``where``."""
        return sympy.Piecewise((yes, condition), (no, True))

    @classmethod
    def kept(cls, expression: Any) -> Any:
        """Return what stands in the arrays for the result of an operation."""
        return expression

    def pieces(self, knots: np.ndarray, coefficients: np.ndarray) -> Any:
        """Return the piecewise polynomials of `pinnobs_gym.simulation.table.table`: choices between
        the pieces from the last to the first."""
        starts = knots.tolist()
        pieces = [
            sum(factor * (self - start) ** power for power, factor in enumerate(row) if factor)
            for start, row in zip(starts, coefficients.T.tolist(), strict=True)
        ]
        y = pieces[-1]
        for end, piece in zip(starts[:0:-1], pieces[-2::-1], strict=True):
            y = np.where(self < end, piece, y)
        return y

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        plain = [np.asarray(part, dtype=object) for part in inputs]
        function = self.functions.get(ufunc.__name__)
        if function is None:
            plain = [_elementwise(_number, part) for part in plain]
            return self._made(getattr(ufunc, method)(*plain, **options))
        if method != "__call__" or any(value is not None for value in options.values()):
            raise TypeError(f"{ufunc.__name__} with {method} or options is not known")
        return self._made(_elementwise(function, *plain))

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        if func is np.where:
            condition, *values = (np.asarray(part, dtype=object) for part in args)
            yes, no = (_elementwise(_number, part) for part in values)
            return self._made(_elementwise(self.choice, condition, yes, no))
        if func is np.clip:
            return _clipped(*args, **kwargs)
        return super().__array_function__(func, types, args, kwargs)

    def __bool__(self) -> bool:
        """Return the truth of a number or a condition that is known.

        Raises:
            TypeError: for a symbol, which Python would otherwise take as true.
        """
        if self.size != 1:
            return bool(super().__bool__())
        value = self.item()
        if isinstance(value, sympy.Expr) and not value.is_number:
            raise TypeError(f"a branch depends on whether {value} is zero")
        return bool(value)

    def _made(self, values: Any) -> Expressions:
        return as_array(_elementwise(self.kept, np.asarray(values, dtype=object)), type(self))


def as_array(values: Any, kind: type[Expressions] = Expressions) -> Expressions:
    """Return symbols or expressions as an array that NumPy's functions take."""
    return np.asarray(values, dtype=object).view(kind)


def _elementwise(function: Callable[..., Any], *arrays: np.ndarray) -> np.ndarray:
    return np.asarray(np.frompyfunc(function, len(arrays), 1)(*arrays), dtype=object)


def _clipped(
    x: Any, a_min: Any = None, a_max: Any = None, out: Any = None, casting: str = "same_kind"
) -> Any:
    """Return `numpy.clip` of expressions."""
    if a_min is not None:
        x = np.maximum(x, a_min)
    if a_max is not None:
        x = np.minimum(x, a_max)
    if out is None:
        return x
    out[...] = x
    return out


TRUTHS = (sympy.core.relational.Relational, BooleanFunction, BooleanAtom)
"""Types of conditions."""


def _number(value: Any) -> Any:
    """Convert a truth value to one or zero, as arithmetic does; return anything else unchanged."""
    if isinstance(value, TRUTHS):
        return sympy.Piecewise((1, value), (0, True))
    return value


def column(values: Any, size: int) -> sympy.Matrix:
    """Return a function's value (size,), an array of expressions, as a matrix (size, 1).

    Raises:
        ValueError: if it is of another shape.
    """
    if np.shape(values) != (size,):
        raise ValueError(f"a function returned shape {np.shape(values)}; expected ({size},)")
    return sympy.Matrix(size, 1, [tidy(value) for value in np.asarray(values, dtype=object)])


def tidy(value: Any) -> sympy.Expr:
    """Return a value, a number, an expression or an array without axes of one, as an expression
    with integers for whole numbers."""
    expression = sympy.sympify(_number(np.asarray(value, dtype=object).item()))
    whole = {
        n: sympy.Integer(int(n)) for n in expression.atoms(sympy.Float) if float(n).is_integer()
    }
    return expression.xreplace(whole)
