"""The steps of filters as straight-line C on lanes, from the structure of a plant's Jacobians.

They are written for plants with at most `LARGEST` states; beyond it, ``templates/motion.h`` has the
same in loops, and shorter code.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from pinnobs_gym.simulation.kernels.straight import (
    ONE,
    ZERO,
    Rows,
    Straight,
    flat,
    times,
    transposed,
)
from pinnobs_gym.simulation.printer import Printer
from pinnobs_gym.simulation.traced_code import Trace

LARGEST = 6
"""Largest number of states for which straight-line code is written."""
_LINE = re.compile(r"const double (\w+) = (.*);")
_NAME = re.compile(r"[A-Za-z_]\w*")
_STAGES = ((0, ""), (1, "half"), (1, "half"), (2, "h"))
"""Of the classical Runge-Kutta method: number of the time and the inputs, and what the slope of the
stage before is multiplied by."""


PrinterOf = Callable[[set[Any], str], Printer]


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
    steps = [value, slopes, _add_step(F, first, last), _add_map_step(A), *_update(H)]
    return [*steps, _smooth_step(len(f.x))]


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
    return _function(head, s, steps), structure


def _moved(s: Straight, part: str, slope: str, start: str) -> str:
    """Return part · slope + start."""
    return start if slope == ZERO else s.total([times(part, slope), start])


def _weighted(s: Straight, k: list[str], start: str) -> str:
    """Return start + h/6 (k₀ + 2(k₁ + k₂) + k₃)."""
    if set(k) == {ZERO}:
        return start
    twice = s.total([k[1], k[2]])
    return s.total([start, f"sixth * ({s.total([times(twice, '2.0'), k[0], k[3]])})"])


def _function(head: str, s: Straight, first: str = "") -> str:
    first = f"    {first}\n" if first else ""
    return f"static void {head}\n{{\n{first}{s.body()}\n}}"


def _loaded(s: Straight, array: str, rows: Rows) -> Rows:
    """Return the entries of a stored matrix of a known structure."""
    width = len(rows[0])
    return [
        [e if _is_number(e) else s.loaded(array, i * width + j) for j, e in enumerate(row)]
        for i, row in enumerate(rows)
    ]


def _is_number(entry: str) -> bool:
    return not _NAME.fullmatch(entry)


def _add_step(F: Rows, A_first: Rows, A_last: Rows) -> str:
    n, s = len(F), Straight()
    F, first, last = (
        _loaded(s, "F", F),
        _loaded(s, "A_first", A_first),
        _loaded(s, "A_last", A_last),
    )
    P = s.load_symmetric("P", n)
    w = [s.let(f"h / 6 * D[{i * n + i}]") for i in range(n)]
    for i in range(n):
        P[i][i] = s.total([P[i][i], w[i]])
    FA = s.product(F, first)
    twice = [[ZERO] * n for _ in range(n)]  # two times Psi at the middle
    for i in range(n):
        for j in range(n):
            terms = [last[i][j], *([f"-{FA[i][j]}"] if FA[i][j] != ZERO else [])]
            slope = s.let(s.total(terms))
            own = [] if slope == ZERO else [times(slope, "quarter")]
            twice[i][j] = s.total([*own, F[i][j], ONE if i == j else ZERO])
    scaled = [[s.let(times(e, w[j])) for j, e in enumerate(row)] for row in twice]
    middle = s.symmetric(scaled, twice)
    for i in range(n):
        middle[i][i] = s.total([middle[i][i], w[i]])
    s.store_all("P", flat(s.symmetric(s.product(F, P), F, middle)))
    head = (
        "AT_WIDTH(add_step)(double h, const double *restrict D, const lanes *restrict F, "
        "const lanes *restrict A_first, const lanes *restrict A_last, lanes *restrict P)"
    )
    return _function(head, s, "const double quarter = h / 4;")


def _add_map_step(A: Rows) -> str:
    n, s = len(A), Straight()
    F, P = _loaded(s, "F", A), s.load_symmetric("P", n)
    D = [[s.let(f"D[{i * n + j}]") for j in range(n)] for i in range(n)]
    s.store_all("P", flat(s.symmetric(s.product(F, P), F, D)))
    return _function(
        "AT_WIDTH(add_map_step)(const double *restrict D, const lanes *restrict F, "
        "lanes *restrict P)",
        s,
    )


def _update(structure: Rows) -> list[str]:
    ny, nx = len(structure), len(structure[0])
    s = Straight()
    H, P, R = _loaded(s, "H", structure), s.load_symmetric("P", nx), s.load("R", ny, ny)
    HP = s.product(H, P)
    s.store_all("HP", flat(HP))
    s.store_all("S", flat(s.symmetric(HP, H, R)))
    head = (
        "AT_WIDTH(output_moments)(const lanes *restrict H, const lanes *restrict P, "
        "const lanes *restrict R, lanes *restrict HP, lanes *restrict S)"
    )
    moments = _function(head, s)
    s = Straight()
    H, P, R = _loaded(s, "H", structure), s.load_symmetric("P", nx), s.load("R", ny, ny)
    K = _gain(s, transposed(s.load("HP", ny, nx)), s.load_symmetric("S", ny))
    KH = s.product(K, H)
    M = [[_less(s, ONE if i == j else ZERO, KH[i][j]) for j in range(nx)] for i in range(nx)]
    noise = s.symmetric(s.product(K, R), K)
    P = s.symmetric(s.product(M, P), M, noise)
    x, e = s.load("x", nx, 1), s.load("e", ny, 1)
    x = [s.total([start[0], step[0]]) for start, step in zip(x, s.product(K, e), strict=True)]
    s.store_all("x", x)
    s.store_all("P", flat(P))
    everything = s.total([*x, *(P[i][j] for i in range(nx) for j in range(i + 1))])
    s.store("rest[l]", f"{everything} - {everything}")
    head = (
        "AT_WIDTH(kalman_update)(const lanes *restrict H, const lanes *restrict HP, "
        "const lanes *restrict S, const lanes *restrict R, const lanes *restrict e, "
        "lanes *restrict x, lanes *restrict P, double *restrict rest)"
    )
    return [moments, _function(head, s)]


def _less(s: Straight, a: str, b: str) -> str:
    """Return a − b."""
    return a if b == ZERO else s.let(f"-{b}" if a == ZERO else f"{a} - {b}")


def _smooth_step(n: int) -> str:
    s = Straight()
    F, P, Q = s.load("F", n, n), s.load_symmetric("P", n), s.load_symmetric("Q", n)
    ahead, after = s.load_symmetric("P_ahead", n), s.load_symmetric("P_next", n)
    x, x_ahead, x_next = (s.load(name, n, 1) for name in ("x", "x_ahead", "x_next"))
    L, inverse, pivots = _factor(s, ahead)
    C = _divided(s, s.product(P, transposed(F)), L, inverse)
    moved = [[s.let(f"{b[0]} - {a[0]}")] for a, b in zip(x_ahead, x_next, strict=True)]
    x = [s.total([a[0], b[0]]) for a, b in zip(x, s.product(C, moved), strict=True)]
    CF = s.product(C, F)
    M = [[_less(s, ONE if i == j else ZERO, CF[i][j]) for j in range(n)] for i in range(n)]
    noisy = [[s.total([after[i][j], Q[i][j]]) for j in range(i + 1)] for i in range(n)]
    noisy = [[noisy[max(i, j)][min(i, j)] for j in range(n)] for i in range(n)]
    rest = s.symmetric(s.product(C, noisy), C)
    s.store_all("x", x)
    s.store_all("P", flat(s.symmetric(s.product(M, P), M, rest)))
    parts = [f"({pivots[i]} / {ahead[i][i]})" for i in range(n)]
    s.store("determinant[l]", " * ".join(parts))
    head = (
        "AT_WIDTH(smooth_step)(const lanes *restrict F, const lanes *restrict Q, "
        "const lanes *restrict x_ahead, const lanes *restrict P_ahead, "
        "const lanes *restrict x_next, const lanes *restrict P_next, "
        "lanes *restrict x, lanes *restrict P, double *restrict determinant)"
    )
    return _function(head, s)


def _factor(s: Straight, S: Rows) -> tuple[Rows, list[str], list[str]]:
    """Return the Cholesky factor L of S, the inverses of its diagonal, and the squares of that."""
    m = len(S)
    L, inverse, pivots = [[ZERO] * m for _ in range(m)], [], []
    for j in range(m):
        for i in range(j, m):
            taken = s.total(times(L[i][q], L[j][q]) for q in range(j))
            rest = _less(s, S[i][j], taken)
            if i == j:
                pivots.append(rest)
                inverse.append(s.let(f"1.0 / sqrt({rest})"))
            L[i][j] = s.let(f"{rest} * {inverse[j]}")
    return L, inverse, pivots


def _divided(s: Straight, A: Rows, L: Rows, inverse: list[str]) -> Rows:
    """Return A(LLᵀ)⁻¹, given the inverses of the diagonal of L."""
    m = len(L)
    X = [list(row) for row in A]
    for row in X:
        for j in range(m):  # forward substitution
            taken = s.total(times(row[q], L[j][q]) for q in range(j))
            row[j] = s.let(f"{_less(s, row[j], taken)} * {inverse[j]}")
        for j in reversed(range(m)):  # back substitution
            taken = s.total(times(row[q], L[q][j]) for q in range(j + 1, m))
            row[j] = s.let(f"{_less(s, row[j], taken)} * {inverse[j]}")
    return X


def _gain(s: Straight, A: Rows, S: Rows) -> Rows:
    """Return AS⁻¹ by the Cholesky factor L of S."""
    m = len(S)
    if m == 1:
        inverse = s.let(f"1.0 / {S[0][0]}")
        return [[s.let(f"{row[0]} * {inverse}")] for row in A]
    L, inverse, _ = _factor(s, S)
    return _divided(s, A, L, inverse)
