"""Straight-line C: one assignment per line, for small matrices whose structure is known.

Entries of a matrix are code: a name, or a number. Products leave out the zeros and the factors one,
so that only what a plant's structure needs is computed, and values stay in registers.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

ZERO, ONE = "0.0", "1.0"
Rows = list[list[str]]
"""A matrix of entries."""

_NAME = re.compile(r"[A-Za-z_]\w*")
_NUMBER = re.compile(r"\(?-?[\d.]+(e[+-]?\d+)?\)?")
_CALLS = re.compile(
    r"\b(a?(?:sin|cos|tan)h?|atan2|exp|log|pow|\w+_table\w+)\("  # no compiler makes lanes of these
)


class Straight:
    """Lines of straight code, each of which gives a name its value.

    Args:
        prefix: beginning of the names that are made here.
    """

    def __init__(self, prefix: str = "s") -> None:
        self._prefix = prefix
        self._code: dict[str, str] = {}
        self._stored: list[tuple[str, str]] = []

    def define(self, name: str, code: str) -> None:
        """Add a line that gives a name its value, unless the name has one."""
        self._code.setdefault(name, code)

    def let(self, code: str) -> str:
        """Return a name of the value of some code, or the code itself if it is a name or a
        number."""
        if _NAME.fullmatch(code) or _NUMBER.fullmatch(code):
            return code
        name = f"{self._prefix}{len(self._code)}"
        self._code[name] = code
        return name

    def store(self, place: str, code: str) -> None:
        """Write a value to memory after all lines."""
        self._stored.append((place, code))

    def store_all(self, array: str, entries: Iterable[str]) -> None:
        """Write the entries of an array of lanes."""
        for i, entry in enumerate(entries):
            self.store(f"{array}[{i}][l]", entry)

    def load(self, array: str, rows: int, columns: int) -> Rows:
        """Return the entries of a matrix in an array of lanes."""
        return [[self.loaded(array, i * columns + j) for j in range(columns)] for i in range(rows)]

    def load_symmetric(self, array: str, n: int) -> Rows:
        """Return the entries of a symmetric matrix, of which the lower half is read."""
        at = [[max(i, j) * n + min(i, j) for j in range(n)] for i in range(n)]
        return [[self.loaded(array, k) for k in row] for row in at]

    def loaded(self, array: str, i: int) -> str:
        """Return a name of an entry of an array of lanes."""
        self.define(f"{array}_{i}", f"{array}[{i}][l]")
        return f"{array}_{i}"

    def total(self, terms: Iterable[str]) -> str:
        """Return the sum of some terms in their order."""
        return self.let(" + ".join(t for t in terms if t != ZERO) or ZERO)

    def product(self, a: Rows, b: Rows) -> Rows:
        """Return ab."""
        columns = list(zip(*b, strict=True))
        return [[self.total(map(times, row, column)) for column in columns] for row in a]

    def symmetric(self, a: Rows, b: Rows, more: Rows | None = None) -> Rows:
        """Return abᵀ, which is symmetric, with a symmetric matrix added if one is given."""
        n = len(a)
        c = [[ZERO] * n for _ in range(n)]
        for i in range(n):
            for j in range(i + 1):
                added = [more[i][j]] if more else []
                c[i][j] = c[j][i] = self.total([*map(times, a[i], b[j]), *added])
        return c

    def body(self) -> str:
        """Return the lines as loops over the lanes. Lines with calls have loops of their own, so
        that the others become vector instructions. Lines that no stored value needs are left
        out."""
        self._code = self._needed()
        phases = self._phases()
        last = max(phases.values(), default=0)
        last += last % 2
        groups: list[list[str]] = [[] for _ in range(last + 1)]
        crossing = self._crossing(phases, last)
        for name, code in self._code.items():
            text = _renamed(code, crossing, phases[name], phases)
            head = f"{name}[l]" if name in crossing else f"const double {name}"
            groups[phases[name]].append(f"{head} = {text};")
        for place, code in self._stored:
            groups[last].append(f"{place} = {_renamed(code, crossing, last, phases)};")
        arrays = "".join(f"    double {name}[W];\n" for name in sorted(crossing))
        loops = [
            "\n        ".join(["EACH_LANE {", *group]) + "\n    }" for group in groups if group
        ]
        return arrays + "    " + "\n    ".join(loops)

    def _needed(self) -> dict[str, str]:
        """Return the lines that stored values depend on, in their order."""
        needed = {name for _, code in self._stored for name in _NAME.findall(code)}
        lines = {}
        for name, code in reversed(self._code.items()):
            if name in needed:
                needed.update(_NAME.findall(code))
                lines[name] = code
        return dict(reversed(lines.items()))

    def _phases(self) -> dict[str, int]:
        """Return the number of the loop of each line: odd for lines with calls."""
        phases: dict[str, int] = {}
        for name, code in self._code.items():
            used = [phases[n] for n in _NAME.findall(code) if n in phases]
            phase = max(used, default=0)
            phases[name] = phase + (phase % 2 != bool(_CALLS.search(code)))
        return phases

    def _crossing(self, phases: dict[str, int], last: int) -> set[str]:
        """Return the names that are used in a later loop than their own."""
        uses = [(phases[name], code) for name, code in self._code.items()]
        uses += [(last, code) for _, code in self._stored]
        return {n for at, code in uses for n in _NAME.findall(code) if phases.get(n, at) < at}


def _renamed(code: str, crossing: set[str], phase: int, phases: dict[str, int]) -> str:
    def name(match: re.Match[str]) -> str:
        found = match.group()
        return f"{found}[l]" if found in crossing else found

    return _NAME.sub(name, code) if crossing else code


def times(a: str, b: str) -> str:
    """Return the code of a product."""
    if ZERO in (a, b):
        return ZERO
    return b if a == ONE else a if b == ONE else f"{a} * {b}"


def transposed(a: Sequence[Sequence[str]]) -> Rows:
    """Return the transpose."""
    return [list(column) for column in zip(*a, strict=True)]


def flat(a: Sequence[Sequence[str]]) -> list[str]:
    """Return the entries in one list."""
    return [entry for row in a for entry in row]
