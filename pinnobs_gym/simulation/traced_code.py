"""NumPy code for f, h and their Jacobians, made from a system's equations as SymPy expressions.

Subexpressions that occur several times are computed once (`sympy.cse`). The code consists of
element-wise operations on the components of the state, so that a row gives the same result alone
and in any batch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import sympy

from pinnobs_gym.simulation.expressions import as_array, column
from pinnobs_gym.simulation.plant_form import PlantForm, cached_by_form, plant_form
from pinnobs_gym.simulation.printer import Printer
from pinnobs_gym.simulation.symbolic import with_symbols
from pinnobs_gym.simulation.system import System, matrix, stack
from pinnobs_gym.simulation.table import pieces
from pinnobs_gym.simulation.tape import Tape


@dataclass(frozen=True)
class TracedCode:
    """The value and the Jacobian of f or h, each as a function of the system, t, x and u."""

    value: Callable[..., Any]
    """Returns the same (..., m) as the system's own function."""
    jacobian: Callable[..., Any]
    """Returns its derivative by the state, (..., m, nx), laid out like
    `pinnobs_gym.simulation.system.matrix`."""


def traced_code(system: System, name: str) -> TracedCode:
    """Return the code of ``f`` or ``h``. It is made once for systems of one class that differ in
    numbers only: parameters are arguments of the code, as numbers or as arrays (...) of one per
    row.

    Raises:
        ValueError: in one line, if the function cannot be traced or differentiated.
    """
    found = _code(plant_form(system), name)
    if isinstance(found, str):
        raise ValueError(found)
    return found


@cached_by_form
def _code(form: PlantForm, name: str) -> TracedCode | str:
    """Return the code, or the reason why there is none."""
    try:
        traced = Trace(form, name)
        value, rows = traced.values, traced.jacobian()
        return TracedCode(traced.compiled([value], "vector"), traced.compiled(rows, "matrix"))
    except Exception as error:  # whatever the user's functions raise when they are given symbols
        return f"{type(error).__name__}: {' '.join(str(error).split())}"


class Trace:
    """The equations of f or h in small steps.

    The names of symbols differ even where those of states, inputs and parameters are the same.
    """

    def __init__(self, form: PlantForm, name: str) -> None:
        system = form.system
        self.t = _symbol("t")
        self.x = [_symbol(f"x{i}") for i in range(system.nx)]
        self.u = [_symbol(f"u{i}") for i in range(system.nu)]
        parameters, properties = (
            {n: _symbol(f"of_{n}") for n in names} for names in (form.numbers, form.properties)
        )
        self.numbers = parameters | properties
        """Symbols of numbers of the system, by the attribute's name."""
        self.tape = Tape(self.x)
        kind = self.tape.kind()
        plant = with_symbols(system, parameters, properties, kind)
        # One row rather than none, so that sums over the states are arrays, too.
        if name == "input":
            given = (as_array([self.t], kind),)
        else:
            given = tuple(as_array(part, kind) for part in (self.t, [self.x], [self.u]))
        size = {"f": system.nx, "h": system.ny, "input": system.nu}[name]
        (value,) = getattr(plant, name)(*given)
        self.values: list[Any] = column(value, size).flat()
        """The components."""

    def jacobian(self) -> list[list[Any]]:
        """Return the derivatives of the components by the state, as rows."""
        return [[self.tape.slope(value, x) for x in self.x] for value in self.values]

    def compiled(self, rows: list[list[Any]], kind: str) -> Callable[..., Any]:
        """Return the function of `source`."""
        names: dict[str, Any] = {"np": np, "matrix": matrix, "stack": stack}
        for i, (knots, coefficients) in enumerate(self.tape.tables):
            degrees = np.arange(1, len(coefficients))[:, None]
            for order, factors in enumerate((coefficients, coefficients[1:] * degrees)):
                names[f"table{i}_{order}"] = partial(_table, knots, factors)
        exec(compile(self.source(rows, kind), "<traced>", "exec"), names)
        return names["function"]

    def source(self, rows: list[list[Any]], kind: str) -> str:
        """Return the code of a function of the system, t, x and u, whose value is a matrix of these
        rows or, if ``kind`` is ``vector``, of the components of the only one."""
        printer = Printer(set(self.numbers.values()))
        given = [
            *((s, f"x[..., {i}]") for i, s in enumerate(self.x)),
            *((s, f"u[..., {i}]") for i, s in enumerate(self.u)),
            *((s, f"system.{name}") for name, s in self.numbers.items()),
        ]
        lines, entries = self.printed([entry for row in rows for entry in row], printer, given)
        width = len(rows[0])
        made = [", ".join(entries[i : i + width]) for i in range(0, len(entries), width)]
        result = (
            f"stack(x, {made[0]})" if kind == "vector" else f"matrix(x, [[{'], ['.join(made)}]])"
        )
        return "\n    ".join(["def function(system, t, x, u):", *lines, f"return {result}"])

    def printed(
        self, wanted: list[Any], printer: Printer, given: list[tuple[sympy.Symbol, str]]
    ) -> tuple[list[str], list[str]]:
        """Return lines of code, and the code of some expressions of the names that they define.

        Args:
            wanted: the expressions.
            printer: a new printer.
            given: symbols, and the code of their values.
        """
        steps, flat = self._shared(wanted)
        for symbol, expression in steps.items():
            printer.define(symbol, expression)
        entries = [printer.code(entry) for entry in flat]
        used = {s for e in (*steps.values(), *flat) for s in e.free_symbols}
        return [
            printer.line(str(s), value) for s, value in given if s in used
        ] + printer.lines, entries

    def _shared(self, wanted: list[Any]) -> tuple[dict[sympy.Symbol, Any], list[Any]]:
        """Return the steps that some expressions need, in the order in which they can be computed,
        and the expressions, all with common subexpressions taken out."""
        needed, steps = _symbols_of(wanted), []
        for symbol, expression in reversed(self.tape.definitions.items()):
            if symbol in needed:
                steps.append((symbol, expression))
                needed |= expression.free_symbols
        steps.reverse()
        taken: Any = sympy.cse(
            [e for _, e in steps] + wanted, sympy.numbered_symbols("c", real=True)
        )
        common, reduced = taken
        waiting: dict[sympy.Symbol, Any] = dict(common)
        ordered: dict[sympy.Symbol, Any] = {}

        def define(expression: Any) -> None:
            """Define the common subexpressions in an expression before it."""
            for symbol in sorted(expression.free_symbols & waiting.keys(), key=str):
                part = waiting.pop(symbol, None)
                if part is not None:
                    define(part)
                    ordered[symbol] = part

        for (symbol, _), expression in zip(steps, reduced, strict=False):
            define(expression)
            ordered[symbol] = expression
        for expression in reduced[len(steps) :]:
            define(expression)
        return ordered, reduced[len(steps) :]


def _symbols_of(expressions: list[Any]) -> set[Any]:
    return {symbol for expression in expressions for symbol in expression.free_symbols}


def _symbol(name: str) -> sympy.Symbol:
    return sympy.Symbol(name, real=True)


def _table(knots: np.ndarray, coefficients: np.ndarray, x: Any) -> Any:
    """Return the piecewise polynomials of a table at x."""
    x = np.asarray(x)
    return pieces(x, knots, coefficients, np.searchsorted(knots[1:], x, side="right"))
