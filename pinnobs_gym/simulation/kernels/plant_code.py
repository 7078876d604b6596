"""A system's equations as C functions on lanes: episodes side by side in the innermost loop."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import sympy

from pinnobs_gym.simulation.kernels.step_code import is_straight, step_functions
from pinnobs_gym.simulation.plant_form import PlantForm
from pinnobs_gym.simulation.printer import Printer
from pinnobs_gym.simulation.system import System
from pinnobs_gym.simulation.traced_code import Trace

_NAMES = {
    **{name: name for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log")},
    **{f"arc{name}": f"a{name}" for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
    **{"arctan2": "atan2", "absolute": "fabs", "floor": "floor", "sqrt": "sqrt", "power": "pow"},
    **{"sign": "sign", "maximum": "maximum", "minimum": "minimum", "heaviside": "heaviside"},
}
"""C's names of functions, or those of ``lanes.h``, by NumPy's."""
_LOGICAL = {"logical_and": " && ", "logical_or": " || "}


class CPrinter(Printer):
    """Writes lines of C whose names are numbers of type double.

    Args:
        scalars: as for `Printer`.
        tables: prefix of the names of functions that evaluate tables.
    """

    def __init__(self, scalars: set[sympy.Symbol], tables: str) -> None:
        super().__init__(scalars)
        self._tables = tables

    def truth(self, value: bool) -> str:
        return "1" if value else "0"

    def infinite(self, value: float) -> str:
        return "NAN" if math.isnan(value) else "INFINITY" if value > 0 else "(-INFINITY)"

    def call(self, name: str, args: list[str]) -> str:
        if name == "where":
            return f"({args[0]} ? {args[1]} : {args[2]})"
        if name == "logical_not":
            return f"(!{args[0]})"
        if name in _LOGICAL:
            return f"({_LOGICAL[name].join(args)})"
        if name not in _NAMES:
            raise ValueError(f"{name} has no counterpart in C")
        return f"{_NAMES[name]}({', '.join(args)})"

    def line(self, name: str, code: str) -> str:
        return f"const double {name} = {code};"

    def table(self, number: int, order: int) -> str:
        return f"{self._tables}{number}_{order}"


@dataclass(frozen=True)
class PlantCode:
    """The equations of a plant in C."""

    once: str
    """Sizes and tables, and ``plant_input``."""
    lanes: str
    """The functions ``plant_f`` and so on, for W lanes; see ``templates/lanes.h``."""
    steps: str
    """The functions of ``templates/steps.h``, for W lanes; empty if they are made by loops."""
    numbers: tuple[str, ...]
    """The attributes of the system that the functions take as numbers, in their order."""


def plant_code(form: PlantForm) -> PlantCode:
    """Return the code of a system's f, h, their Jacobians, and the input that it defines.

    The numbers of its form are arguments of the code. Other parameters, such as tables, are part of
    it.

    Raises:
        Exception: whatever the system's functions raise when they are given symbols.
        ValueError: in one line, if a function has no counterpart in C.
    """
    system = form.system
    traces = {name: Trace(form, name) for name in ("f", "h", "input")}
    numbers = tuple(traces["f"].numbers)
    parts = [_sizes(system, len(numbers))]
    for name, trace in traces.items():
        parts += _tables(trace, f"{name}_table")
    functions = [
        _function("plant_f", traces["f"], "f_table", {"dx": traces["f"].values}),
        _function(
            "plant_f_linearised",
            traces["f"],
            "f_table",
            {"dx": traces["f"].values, "A": _flat(traces["f"].jacobian())},
        ),
        _function("plant_h", traces["h"], "h_table", {"y": traces["h"].values}),
        _function(
            "plant_h_linearised",
            traces["h"],
            "h_table",
            {"y": traces["h"].values, "H": _flat(traces["h"].jacobian())},
        ),
    ]
    once = "\n".join([*parts, _input_function(traces["input"])])
    steps = []
    if is_straight(system.nx, system.ny):
        once += "\n#define STRAIGHT"
        steps = step_functions(traces["f"], traces["h"], CPrinter)
    return PlantCode(once, "\n\n".join(functions), "\n\n".join(steps), numbers)


def _sizes(system: System, numbers: int) -> str:
    sizes = {"NX": system.nx, "NY": system.ny, "NU": system.nu, "NP": numbers}
    # C has no arrays without elements: these are the lengths of arrays.
    lengths = {"LU": max(system.nu, 1), "LP": max(numbers, 1)}
    return "".join(f"#define {name} {value}\n" for name, value in (sizes | lengths).items())


def _flat(rows: Sequence[Sequence[Any]]) -> list[Any]:
    return [entry for row in rows for entry in row]


def _function(name: str, trace: Trace, tables: str, results: dict[str, list[Any]]) -> str:
    """Return a function of lanes, ``name(t, x, u, p, *results)``, whose arrays are (n, W)."""
    printer = CPrinter(set(trace.numbers.values()), tables)
    given = [
        (trace.t, "times[l]"),
        *((s, f"x[{i}][l]") for i, s in enumerate(trace.x)),
        *((s, f"u[{i}][l]") for i, s in enumerate(trace.u)),
        *((s, f"p[{i}][l]") for i, s in enumerate(trace.numbers.values())),
    ]
    wanted = [entry for entries in results.values() for entry in entries]
    lines, entries = trace.printed(wanted, printer, given)
    stored, first = [], 0
    for array, values in results.items():
        stored += [f"{array}[{i}][l] = {entries[first + i]};" for i in range(len(values))]
        first += len(values)
    arguments = ", ".join(f"lanes *restrict {array}" for array in results)
    head = (
        f"static inline void AT_WIDTH({name})(const double *restrict times, "
        f"const lanes *restrict x, const lanes *restrict u, const lanes *restrict p, {arguments})"
    )
    unused = "(void)times; (void)x; (void)u; (void)p;"
    body = "\n        ".join([*lines, *stored])
    return f"{head}\n{{\n    {unused}\n    EACH_LANE {{\n        {body}\n    }}\n}}"


def _input_function(trace: Trace) -> str:
    """Return ``plant_input(t, p, stride, u, step)``: the inputs at one time, for one lane of p."""
    printer = CPrinter(set(trace.numbers.values()), "input_table")
    given = [
        (trace.t, "now"),
        *((s, f"p[{i} * stride]") for i, s in enumerate(trace.numbers.values())),
    ]
    lines, entries = trace.printed(trace.values, printer, given)
    stored = [f"u[{i} * step] = {entry};" for i, entry in enumerate(entries)]
    body = "\n    ".join([*lines, *stored])
    return (
        "static void plant_input(seconds now, const double *restrict p, int stride, "
        "double *restrict u, int step)\n"
        f"{{\n    (void)now; (void)p; (void)stride; (void)u; (void)step;\n    {body}\n}}"
    )


def _tables(trace: Trace, prefix: str) -> list[str]:
    """Return a function for each table of a trace, and each of its derivatives."""
    functions = []
    for i, (knots, coefficients) in enumerate(trace.tape.tables):
        rows = [list(row) for row in coefficients]
        for order in range(len(coefficients)):
            functions.append(_table(f"{prefix}{i}_{order}", list(knots), rows))
            rows = [[k * c for c in row] for k, row in enumerate(rows)][1:] or [[0.0] * len(knots)]
    return functions


def _table(name: str, knots: list[float], rows: list[list[float]]) -> str:
    """Return a function that evaluates piecewise polynomials, as
    `pinnobs_gym.simulation.table.pieces` does."""
    values = ", ".join("{" + ", ".join(repr(float(c)) for c in row) + "}" for row in rows)
    points = ", ".join(repr(float(k)) for k in knots)
    return f"""static double {name}(double x)
{{
    static const double knots[{len(knots)}] = {{{points}}};
    static const double c[{len(rows)}][{len(knots)}] = {{{values}}};
    int low = 0, high = {len(knots) - 1};
    /* The number of knots, from the second on, that are not above x */
    while (low < high) {{
        const int middle = (low + high + 1) / 2;
        if (knots[middle] <= x) low = middle; else high = middle - 1;
    }}
    const double s = x - knots[low];
    double y = c[{len(rows) - 1}][low];
    for (int k = {len(rows) - 2}; k >= 0; k--) y = c[k][low] + s * y;
    return y;
}}"""
