"""The steps of filters and smoothers that move covariances, as straight-line C on lanes; see
`step_code`."""

from __future__ import annotations

import re

from pinnobs_gym.simulation.kernels.straight import (
    ONE,
    ZERO,
    Rows,
    Straight,
    flat,
    times,
    transposed,
)

_NAME = re.compile(r"[A-Za-z_]\w*")
_PARAMETER = re.compile(r"(\w+)(?:, |\)$)")


def function(head: str, s: Straight, first: str = "") -> str:
    """Return a C function: its head, lines that come first, and straight code. Parameters that are
    not used are named, since compilers may warn of them."""
    body = s.body()
    named = set(_NAME.findall(first)) | set(_NAME.findall(body))
    unused = [name for name in _PARAMETER.findall(head) if name not in named]
    lines = [*([first] if first else []), *(f"(void){name};" for name in unused)]
    text = "".join(f"    {line}\n" for line in lines)
    return f"static void {head}\n{{\n{text}{body}\n}}"


def _loaded(s: Straight, array: str, rows: Rows) -> Rows:
    """Return the entries of a stored matrix of a known structure."""
    width = len(rows[0])
    return [
        [e if _is_number(e) else s.loaded(array, i * width + j) for j, e in enumerate(row)]
        for i, row in enumerate(rows)
    ]


def _is_number(entry: str) -> bool:
    return not _NAME.fullmatch(entry)


def add_step(F: Rows, A_first: Rows, A_last: Rows) -> str:
    """Return the function ``add_step``, given the structure of F and the Jacobians of f."""
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
    return function(head, s, "const double quarter = h / 4;")


def add_map_step(A: Rows) -> str:
    """Return the function ``add_map_step``, given the structure of a map's Jacobian."""
    n, s = len(A), Straight()
    F, P = _loaded(s, "F", A), s.load_symmetric("P", n)
    D = [[s.let(f"D[{i * n + j}]") for j in range(n)] for i in range(n)]
    s.store_all("P", flat(s.symmetric(s.product(F, P), F, D)))
    return function(
        "AT_WIDTH(add_map_step)(const double *restrict D, const lanes *restrict F, "
        "lanes *restrict P)",
        s,
    )


def update(structure: Rows) -> list[str]:
    """Return the functions ``output_moments`` and ``kalman_update`` for the structure of H."""
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
    moments = function(head, s)
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
    return [moments, function(head, s)]


def _less(s: Straight, a: str, b: str) -> str:
    """Return a − b."""
    return a if b == ZERO else s.let(f"-{b}" if a == ZERO else f"{a} - {b}")


def smooth_step(n: int) -> str:
    """Return the function ``smooth_step`` for n states."""
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
    return function(head, s)


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
