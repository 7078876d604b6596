"""The steps of filters as straight-line C on lanes, from the structure of a plant's Jacobians.

They are written for plants with few states and outputs; beyond these, ``templates/loops.h`` and
``templates/motion.h`` have the same in loops, and shorter code.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from pinnobs_gym.simulation.kernels.covariance_code import (
    add_map_step,
    add_step,
    function,
    smooth_step,
    update,
)
from pinnobs_gym.simulation.kernels.straight import (
    ONE,
    ZERO,
    Rows,
    Straight,
    flat,
    times,
)
from pinnobs_gym.simulation.printer import Printer
from pinnobs_gym.simulation.traced_code import Trace

_STATES, _OUTPUTS = 6, 12
"""Largest numbers of states and outputs for which straight-line code is written: its length grows
with the squares of both, and 25 outputs would take a compiler 20 s."""
_NAME = re.compile(r"[A-Za-z_]\w*")
_LINE = re.compile(r"const double (\w+) = (.*);")
_STAGES = ((0, ""), (1, "half"), (1, "half"), (2, "h"))
"""Of the classical Runge-Kutta method: number of the time and the inputs, and what the slope of the
stage before is multiplied by."""


PrinterOf = Callable[[set[Any], str], Printer]


def is_straight(nx: int, ny: int) -> bool:
    """Return whether straight-line code is written for plants of so many states and outputs."""
    return nx <= _STATES and ny <= _OUTPUTS


def step_functions(f: Trace, h: Trace, printer: PrinterOf) -> list[str]:
    """Return the functions ``runge_kutta``, ``runge_kutta_linearised``, ``add_step``,
    ``add_map_step``, ``output_moments``, ``kalman_update`` and ``smooth_step``, whose comments are
    in ``templates/steps.h``.

    Args:
        f: the trace of f.
        h: the trace of h.
        printer: makes the printer of C of symbols of numbers, and the prefix of tables' names.
    """
    value, _ = _runge_kutta(f, printer, linearised=False)
    slopes, (F, first, last) = _runge_kutta(f, printer, linearised=True)
    A = [["A" if e != 0 else ZERO for e in row] for row in f.jacobian()]
    H = [["H" if e != 0 else ZERO for e in row] for row in h.jacobian()]
    steps = [value, slopes, add_step(F, first, last), add_map_step(A), *update(H)]
    return [*steps, smooth_step(len(f.x))]


def evaluated(
    straight: Straight,
    trace: Trace,
    printer: Printer,
    wanted: list[Any],
    given: dict[str, str],
    suffix: str,
) -> list[str]:
    """Add the lines of some expressions of a trace, and return the code of their values. Lines that
    depend on parameters only are added once, whatever the suffix of other names.

    Args:
        straight: the code.
        trace: the trace that the expressions belong to.
        printer: a new printer.
        wanted: the expressions.
        given: the code of symbols of the time, the states and the inputs.
        suffix: end of the names of this evaluation.
    """
    lines, entries = trace.printed(wanted, printer, [])
    names = dict(given)
    for i, symbol in enumerate(trace.numbers.values()):
        names[str(symbol)] = str(symbol)
        if any(re.search(rf"\b{symbol}\b", text) for text in (*lines, *entries)):
            straight.define(str(symbol), f"p[{i}][l]")
    constant = {str(symbol) for symbol in trace.numbers.values()}

    def renamed(code: str) -> str:
        return _NAME.sub(lambda found: names.get(found.group(), found.group()), code)

    for line in lines:
        found = _LINE.fullmatch(line)
        assert found is not None
        name, code = found.groups()
        used = {n for n in _NAME.findall(code) if n in names}
        if used <= constant:
            constant.add(name)
        names[name] = name if name in constant else name + suffix
        straight.define(names[name], renamed(code))
    return [straight.let(renamed(entry)) for entry in entries]


def _runge_kutta(
    f: Trace, printer: PrinterOf, linearised: bool
) -> tuple[str, tuple[Rows, Rows, Rows]]:
    """Return the function of a Runge-Kutta step, and with ``linearised`` the structure of F and of
    the Jacobians at both ends: entries that are numbers, and names of others."""
    n, s = len(f.x), Straight()
    unit = [[ONE if i == j else ZERO for j in range(n)] for i in range(n)]
    x = [row[0] for row in s.load("x", n, 1)]
    point, Phi, k, K, ends = x, unit, [], [], []
    for q, (at, part) in enumerate(_STAGES):
        given = {str(f.t): f"t{at}"} | {str(symbol): point[i] for i, symbol in enumerate(f.x)}
        s.define(f"t{at}", f"s->t[{at}][l]")
        for i, symbol in enumerate(f.u):
            s.define(f"u{at}_{i}", f"s->u[{at}][{i}][l]")
            given[str(symbol)] = f"u{at}_{i}"
        if q:
            point = [_moved(s, part, slope, start) for slope, start in zip(k[-1], x, strict=True)]
            given |= {str(symbol): point[i] for i, symbol in enumerate(f.x)}
        slopes = flat(f.jacobian()) if linearised else []
        symbols = printer(set(f.numbers.values()), "f_table")
        entries = evaluated(s, f, symbols, [*f.values, *slopes], given, f"_{q}")
        k.append(entries[:n])
        if linearised:
            A = [entries[i : i + n] for i in range(n, len(entries), n)]
            if q:
                Phi = [
                    [_moved(s, part, K[-1][i][j], unit[i][j]) for j in range(n)] for i in range(n)
                ]
            ends.append(A)
            K.append(s.product(A, Phi) if q else A)
    F = (
        [
            [_weighted(s, [K[q][i][j] for q in range(4)], unit[i][j]) for j in range(n)]
            for i in range(n)
        ]
        if linearised
        else unit
    )
    for i in range(n):
        s.store(f"x[{i}][l]", _weighted(s, [k[q][i] for q in range(4)], x[i]))
    arrays = ""
    if linearised:
        for array, rows in (("F", F), ("A_first", ends[0]), ("A_last", ends[3])):
            s.store_all(array, flat(rows))
            arrays += f", lanes *restrict {array}"
    name = "runge_kutta_linearised" if linearised else "runge_kutta"
    head = (
        f"AT_WIDTH({name})(const struct rk_step *s, const lanes *restrict p, "
        f"lanes *restrict x{arrays})"
    )
    steps = "const double h = s->h, half = h / 2, sixth = h / 6;\n    (void)p; (void)half;"
    structure = (F, ends[0], ends[3]) if linearised else (F, F, F)
    return function(head, s, steps), structure


def _moved(s: Straight, part: str, slope: str, start: str) -> str:
    """Return part · slope + start."""
    return start if slope == ZERO else s.total([times(part, slope), start])


def _weighted(s: Straight, k: list[str], start: str) -> str:
    """Return start + h/6 (k₀ + 2(k₁ + k₂) + k₃)."""
    if set(k) == {ZERO}:
        return start
    twice = s.total([k[1], k[2]])
    return s.total([start, f"sixth * ({s.total([times(twice, '2.0'), k[0], k[3]])})"])
