"""A system's equations as SymPy expressions, made by calling its own `f`, `h` and `input`.

The displayed or differentiated equations are thus the simulated ones. Needs SymPy, from the extra
docs (torch also installs it).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import sympy
from sympy.logic.boolalg import BooleanAtom, BooleanFunction
from sympy.printing.conventions import split_super_sub

from pinnobs_gym.simulation.system import System


@dataclass(frozen=True)
class Equations:
    """The equations ẋ = f(t, x, u), y = h(t, x, u) and u(t) of a system, with symbols as
    parameters."""

    t: sympy.Symbol
    x: tuple[sympy.Symbol, ...]
    u: tuple[sympy.Symbol, ...]
    parameters: Mapping[str, sympy.Symbol]
    """Symbols of the numeric physical parameters, by name."""
    definitions: Mapping[sympy.Symbol, sympy.Expr]
    """Numeric properties of the class as expressions of the parameters. They may refer to each
    other in any order."""
    f: sympy.Matrix
    """Shape (nx, 1)."""
    h: sympy.Matrix
    """Shape (ny, 1)."""
    input: sympy.Matrix
    """u(t), shape (nu, 1)."""

    def f_jacobian(self) -> sympy.Matrix:
        """∂f/∂x, shape (nx, nx)."""
        return self.f.jacobian(self.x)

    def h_jacobian(self) -> sympy.Matrix:
        """∂h/∂x, shape (ny, nx)."""
        return self.h.jacobian(self.x)

    def expanded(self, expression: Any) -> Any:
        """Substitute the definitions in an expression or matrix, which leaves only t, x, u and
        parameters."""
        for _ in self.definitions:
            expression = expression.subs(self.definitions)
        return expression


def trace(system: System) -> Equations:
    """Return the equations of a system.

    Raises:
        ValueError: in one line, if its functions cannot be traced: they branch on numbers, or call
            a function that is not in `FUNCTIONS`.
    """
    names = [n for n, v in system.parameters.items() if _is_number(v)]
    try:
        return _traced(system, {name: _symbol(name) for name in names})
    except Exception as error:  # whatever the user's functions raise when they are given symbols
        what = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise ValueError(f"{type(system).__name__} cannot be traced: {what}") from error


def _traced(system: System, parameters: Mapping[str, sympy.Symbol]) -> Equations:
    cls = type(system)
    derived = [
        n
        for n, v in vars(cls).items()
        if isinstance(v, property) and _is_number(getattr(system, n))
    ]
    symbols = {name: _symbol(name) for name in derived}
    constants = {n: property(lambda self, value=s: value) for n, s in symbols.items()}
    values = {f.name: getattr(system, f.name) for f in fields(system)} | dict(parameters)
    make: Any = type(cls.__name__, (cls,), constants)
    traced: System = make(**values)
    definitions = {symbols[n]: _tidy(vars(cls)[n].fget(traced)) for n in derived}
    t = _symbol("t")
    x, u = (tuple(map(_symbol, names)) for names in (system.state_names, system.input_names))
    now, state, inputs = (_array(part) for part in (t, x, u))
    return Equations(
        t,
        x,
        u,
        parameters,
        definitions,
        _column(traced.f(now, state, inputs), system.nx),
        _column(traced.h(now, state, inputs), system.ny),
        _column(traced.input(now), system.nu),
    )


def _symbol(name: str) -> sympy.Symbol:
    return sympy.Symbol(name, real=True)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


def _column(values: Any, size: int) -> sympy.Matrix:
    if np.shape(values) != (size,):
        raise ValueError(f"a function returned shape {np.shape(values)}; expected ({size},)")
    return sympy.Matrix(size, 1, [_tidy(value) for value in np.asarray(values, dtype=object)])


def _tidy(value: Any) -> sympy.Expr:
    """Return the expression with whole floating-point numbers as integers."""
    expression = sympy.sympify(_number(value))
    whole = {
        n: sympy.Integer(int(n)) for n in expression.atoms(sympy.Float) if float(n).is_integer()
    }
    return expression.xreplace(whole)


FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{name: getattr(sympy, name) for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
    **{name: getattr(sympy, name) for name in ("exp", "log", "sqrt", "sign", "floor")},
    **{f"arc{name[1:]}": getattr(sympy, name) for name in ("asin", "acos", "atan", "asinh")},
    **{
        "absolute": sympy.Abs,
        "arctan2": sympy.atan2,
        "hypot": lambda a, b: sympy.sqrt(a**2 + b**2),
    },
    **{"maximum": sympy.Max, "minimum": sympy.Min, "square": lambda a: a**2},
    **{"less": sympy.Lt, "less_equal": sympy.Le, "greater": sympy.Gt, "greater_equal": sympy.Ge},
    **{"logical_and": sympy.And, "logical_or": sympy.Or, "logical_not": sympy.Not},
    **{"bitwise_and": sympy.And, "bitwise_or": sympy.Or, "invert": sympy.Not},
}
"""SymPy's counterparts of NumPy's functions, by NumPy's name; arithmetic needs none."""


class _Expressions(np.ndarray):
    """An array of expressions that supports NumPy's functions, and thus the array API."""

    _op_priority = 100  # so that expression * array calls the array's operator

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        plain = [np.asarray(part, dtype=object) for part in inputs]
        function = FUNCTIONS.get(ufunc.__name__)
        if function is None:
            plain = [_elementwise(_number, part) for part in plain]
            return _array(getattr(ufunc, method)(*plain, **options))
        if method != "__call__" or any(value is not None for value in options.values()):
            raise TypeError(f"{ufunc.__name__} with {method} or options is not known")
        return _array(_elementwise(function, *plain))

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        if func is np.where:
            condition, yes, no = (np.asarray(part, dtype=object) for part in args)
            return _array(_elementwise(_where, condition, yes, no))
        return super().__array_function__(func, types, args, kwargs)


def _array(values: Any) -> _Expressions:
    return np.asarray(values, dtype=object).view(_Expressions)


def _elementwise(function: Callable[..., Any], *arrays: np.ndarray) -> np.ndarray:
    return np.asarray(np.frompyfunc(function, len(arrays), 1)(*arrays), dtype=object)


def _where(condition: Any, yes: Any, no: Any) -> sympy.Expr:
    return sympy.Piecewise((_number(yes), condition), (_number(no), True))


_TRUTHS = (sympy.core.relational.Relational, BooleanFunction, BooleanAtom)


def _number(value: Any) -> Any:
    """Convert a truth value to one or zero, as arithmetic does; return anything else unchanged."""
    if isinstance(value, _TRUTHS):
        return sympy.Piecewise((1, value), (0, True))
    return value


def latex(expression: Any) -> str:
    """Return an expression or matrix in LaTeX, with words in symbol names upright."""
    names = {symbol: name_in_latex(symbol.name) for symbol in expression.free_symbols}
    return sympy.latex(expression, symbol_names=names, mat_delim="(")


def aligned(equations: Sequence[tuple[str, Any]]) -> str:
    """Return equations, each a left side in LaTeX and an expression, as aligned lines of LaTeX."""
    return " \\\\\n".join(f"{left} &= {latex(right)}" for left, right in equations)


def rates(equations: Equations) -> list[str]:
    """Return the left sides of ẋ = f in LaTeX."""
    return [rf"\dot{{{base}}}{marks}" for base, marks in (_parts(s.name) for s in equations.x)]


def name_in_latex(name: str) -> str:
    """Return the name of a state, output or parameter in LaTeX: ``phi1`` becomes a Greek letter
    with an index, ``velocity`` an upright word."""
    return "".join(_parts(name))


def _parts(name: str) -> tuple[str, str]:
    """Split a name into its base and its indices, both in LaTeX."""
    base, above, below = split_super_sub(name)
    parts = {"^": above, "_": below}
    marks = [f"{m}{{{','.join(map(_part, indices))}}}" for m, indices in parts.items() if indices]
    return _part(base), "".join(marks)


def _part(text: Any) -> str:
    printed = sympy.latex(sympy.Symbol(text))
    return (
        rf"\mathrm{{{text}}}" if len(text) > 1 and printed == text and text.isalpha() else printed
    )
