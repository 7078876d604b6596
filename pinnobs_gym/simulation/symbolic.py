"""A system's equations as SymPy expressions, made by calling its own `f`, `h` and `input`.

The displayed or differentiated equations are thus the simulated ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import sympy
from sympy.printing.conventions import split_super_sub

from pinnobs_gym.simulation.expressions import Expressions, as_array, column, tidy
from pinnobs_gym.simulation.plant_form import numeric_properties
from pinnobs_gym.simulation.system import System
from pinnobs_gym.simulation.values import is_number


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
            a function that is not in `pinnobs_gym.simulation.expressions.FUNCTIONS`.
    """
    names = [n for n, v in system.parameters.items() if is_number(v)]
    try:
        return _traced(system, {name: _symbol(name) for name in names})
    except Exception as error:  # whatever the user's functions raise when they are given symbols
        what = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise ValueError(f"{type(system).__name__} cannot be traced: {what}") from error


def _traced(system: System, parameters: Mapping[str, sympy.Symbol]) -> Equations:
    cls = type(system)
    derived = {name: _symbol(name) for name in numeric_properties(system)}
    traced = with_symbols(system, parameters, derived)
    definitions = {symbol: tidy(vars(cls)[n].fget(traced)) for n, symbol in derived.items()}
    t = _symbol("t")
    x, u = (tuple(map(_symbol, names)) for names in (system.state_names, system.input_names))
    now, state, inputs = (as_array(part) for part in (t, x, u))
    return Equations(
        t,
        x,
        u,
        parameters,
        definitions,
        column(traced.f(now, state, inputs), system.nx),
        column(traced.h(now, state, inputs), system.ny),
        column(traced.input(now), system.nu),
    )


def with_symbols(
    system: System,
    parameters: Mapping[str, sympy.Symbol],
    properties: Mapping[str, sympy.Symbol],
    kind: type[Expressions] = Expressions,
) -> System:
    """Return the system with symbols as these parameters and these properties of its class. Its
    equations then return expressions of arrays of symbols (`as_array`) of this kind."""
    cls = type(system)
    # NumPy's functions, np.sqrt(self.k), take arrays of symbols but no symbols.
    shown = {name: as_array(s, kind) for name, s in properties.items()}
    constants = {name: property(lambda self, value=a: value) for name, a in shown.items()}
    values = {f.name: getattr(system, f.name) for f in fields(system)}
    make: Any = type(cls.__name__, (cls,), constants)
    return make(**values | {name: as_array(s, kind) for name, s in parameters.items()})


def _symbol(name: str) -> sympy.Symbol:
    return sympy.Symbol(name, real=True)


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
