"""The equations of a system as text and as a file of MATLAB."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import sympy

from pinnobs_gym.simulation.symbolic import Equations, trace
from pinnobs_gym.simulation.system import System

_UNKNOWN = re.compile(r"Not supported|Heaviside|heaviside|DiracDelta|Derivative|Subs")
"""What the printed code has of functions that MATLAB has not."""
_KEYWORDS = frozenset(
    (
        *("break", "case", "catch", "classdef", "continue", "else", "elseif", "end", "for"),
        *("function", "global", "if", "otherwise", "parfor", "persistent", "return", "spmd"),
        *("switch", "try", "while", "pi", "t", "x_", "u_", "out_"),
    )
)
"""Names that the code needs for itself."""


def equations_text(system: System) -> str:
    """Return the equations of a system as lines of plain text.

    Raises:
        ValueError: in one line, if they cannot be traced.
    """
    found = trace(system)
    lines = [f"{name} = {_plain(value)}" for name, value in _in_order(found.definitions)]
    for name, value in zip(system.state_names, found.f.flat(), strict=True):
        left = f"{name}(k+1)" if system.discrete else f"d({name})/dt"
        lines.append(f"{left} = {_plain(value)}")
    lines += [
        f"{n} = {_plain(v)}" for n, v in zip(system.output_names, found.h.flat(), strict=True)
    ]
    if system.nu and not system.measured_input:
        names = system.input_names
        lines += [f"{n}(t) = {_plain(v)}" for n, v in zip(names, found.input.flat(), strict=True)]
    return "\n".join(lines)


def _plain(expression: Any) -> str:
    return str(expression).replace("**", "^")


def _in_order(definitions: Mapping[sympy.Symbol, Any]) -> list[tuple[sympy.Symbol, Any]]:
    """Return definitions in an order in which each uses only those before it."""
    left, ordered = dict(definitions), []
    while left:
        ready = [name for name, value in left.items() if not value.free_symbols & left.keys()]
        for name in ready or list(left):  # a circle cannot be put in order
            ordered.append((name, left.pop(name)))
    return ordered


def matlab_model(system: System, constants: Mapping[str, Any]) -> str | None:
    """Return a file ``model.m``: a function that returns the model as a struct, with handles of the
    equations and their Jacobians and these constants. It runs in MATLAB and in Octave.

    None if the equations cannot be traced, or use functions or names that MATLAB has not.
    """
    try:
        found = trace(system)
    except ValueError:
        return None
    names = [*map(str, (*found.x, *found.u, *found.definitions)), *found.parameters]
    if not all(re.fullmatch(r"[A-Za-z]\w*", n, re.ASCII) and n not in _KEYWORDS for n in names):
        return None
    values = {str(found.parameters[name]): system.parameters[name] for name in found.parameters}
    f_is = "the next state" if system.discrete else "the rate of change of the state"
    functions = {
        "f": (f_is, _function("f", found, values, found.f)),
        "h": ("the outputs without noise", _function("h", found, values, found.h)),
        "F": ("the derivative of f by x", _function("F", found, values, found.f_jacobian())),
        "H": ("the derivative of h by x", _function("H", found, values, found.h_jacobian())),
    }
    if system.nu and not system.measured_input and not system.draws_input:
        text = _function("u", found, values, found.input, "t")
        functions["u"] = ("the inputs at time t", text)
    whole = "\n".join(text for _, text in functions.values())
    if _UNKNOWN.search(whole):
        return None
    lines = [
        "function m = model()",
        f"% The model of {type(system).__name__}; see README.md for names and units. Each is a "
        "column.",
        f"% Its fields beside the equations: {', '.join(constants)}.",
    ]
    for name, (what, _) in functions.items():
        arguments = "t" if name == "u" else "t, x, u"
        lines.append(f"  m.{name} = @{name}_of;  % m.{name}({arguments}): {what}")
    lines += [f"  m.{name} = {_literal(value)};" for name, value in constants.items()]
    return "\n".join([*lines, "end", "", whole])


def _function(
    name: str,
    equations: Equations,
    values: Mapping[str, float],
    expressions: Any,
    arguments: str = "t, x_, u_",
) -> str:
    """Return a function of MATLAB that returns a matrix of expressions."""
    used = set(expressions.free_symbols)
    definitions = []
    for symbol, value in reversed(_in_order(equations.definitions)):
        if symbol in used:
            used |= value.free_symbols
            definitions.insert(0, (symbol, value))
    lines = [f"function out_ = {name}_of({arguments})"]
    for vector, symbols in (("x_", equations.x), ("u_", equations.u)):
        lines += [f"  {s} = {vector}({i});" for i, s in enumerate(symbols, 1) if s in used]
    lines += [f"  {n} = {float(v)!r};" for n, v in values.items() if _has(used, n)]
    lines += [f"  {symbol} = {sympy.octave_code(value)};" for symbol, value in definitions]
    rows, columns = expressions.shape
    lines.append(f"  out_ = zeros({rows}, {columns});")
    for i in range(rows):
        for j in range(columns):
            if expressions[i, j] != 0:
                code = sympy.octave_code(expressions[i, j])
                lines.append(f"  out_({i + 1}, {j + 1}) = {code};")
    return "\n".join([*lines, "end", ""])


def _has(symbols: Iterable[sympy.Symbol], name: str) -> bool:
    return any(symbol.name == name for symbol in symbols)


def _literal(value: Any) -> str:
    """Return a number, a matrix (a list of rows) or a list of texts as MATLAB writes it."""
    if isinstance(value, tuple):
        return "{" + ", ".join(f"'{text}'" for text in value) + "}"
    if isinstance(value, Sequence):
        rows = (" ".join(repr(float(entry)) for entry in row) for row in value)
        return f"[{'; '.join(rows)}]"
    return repr(value)
