"""Which columns of a log are time, outputs, inputs and levels of noise."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches

from pinnobs_gym.logs.csv_lines import shown
from pinnobs_gym.logs.formulas import Formula, parsed
from pinnobs_gym.logs.table import Table, listed, quoted
from pinnobs_gym.simulation.system import System

_TIME = ("time", "stamp", "clock", "sec", "millis", "zeit")
"""Parts of names that columns of times have."""


def chosen(system: System, table: Table, columns: Sequence[str]) -> dict[str, Formula]:
    """Return the formula of each quantity that a log gives: ``t``; ``y1``, ... for all outputs;
    ``u1``, ... for all inputs, or none where the system defines them and the log has none;
    ``y1_std``, ... for those levels of noise that are there.

    Args:
        system: the model.
        table: the log.
        columns: formulas as ``target=formula``, with a target named ``t``, ``y1`` or by the
            output's own name, ``u1`` or by the input's own name, and ``y1_std`` or the output's
            name with ``_std``. A target without one is the column of the same name.

    Raises:
        ValueError: in one line, if a formula is wrong or names no column, if a quantity has two
            columns, or if one is missing.
    """
    known = targets(system)
    given = _assigned(type(system).__name__, known, columns)
    for name, formula in given.items():
        _check_columns(name, formula, table)
    found = {name: _of(name, given, known, table) for name in dict.fromkeys(known.values())}
    there = {name: formula for name, formula in found.items() if formula is not None}
    inputs = [f"u{i + 1}" for i in range(system.nu)]
    if type(system).input is not System.input and not there.keys() & set(inputs):
        inputs = []
    needed = ["t", *(f"y{i + 1}" for i in range(system.ny)), *inputs]
    missing = [name for name in needed if name not in there]
    if missing:
        raise ValueError(_missing(system, table, needed, missing, there))
    return there


def unused(table: Table, formulas: Iterable[Formula]) -> list[str]:
    """Return the names of the columns that no formula uses."""
    used = {name for formula in formulas for name in formula.columns}
    return [name for name in table.header if name and name not in used]


def targets(system: System) -> dict[str, str]:
    """Return the quantities of a log, ``t``, ``y1``, ``u1``, ``y1_std``, by the names that stand
    for them.

    ``y1`` is always the first output, and ``u1`` the first input. A name that two of them have
    stands for none.
    """
    own = {"t": "t"}
    names: list[tuple[str, str]] = []
    for letter, many in (("y", system.output_names), ("u", system.input_names)):
        for i, name in enumerate(many, 1):
            own[f"{letter}{i}"] = f"{letter}{i}"
            names.append((name, f"{letter}{i}"))
    for i, name in enumerate(system.output_names, 1):
        own[f"y{i}_std"] = f"y{i}_std"
        names.append((f"{name}_std", f"y{i}_std"))
    all_names = [name for name, _ in names]
    further = {n: q for n, q in names if n not in own and all_names.count(n) == 1}
    return {**own, **further}


def _assigned(system: str, known: Mapping[str, str], columns: Sequence[str]) -> dict[str, Formula]:
    """Return the formulas that are given, by their quantities."""
    given: dict[str, Formula] = {}
    for assignment in columns:
        name, equals, text = assignment.partition("=")
        name = name.strip()
        if not equals or name not in known:
            close = get_close_matches(name, known, 1) if name not in known else []
            perhaps = f"; did you mean {close[0]}?" if close else ""
            raise ValueError(
                f"columns {shown(assignment)}: expected target=formula, for {system} with a target "
                f"of {listed(list(known))}{perhaps}"
            )
        if known[name] in given:
            raise ValueError(f"columns {shown(assignment)}: {known[name]} is given twice")
        try:
            given[known[name]] = parsed(text)
        except ValueError as error:
            raise ValueError(f"columns {shown(assignment)}: {error}") from None
    return given


def _check_columns(name: str, formula: Formula, table: Table) -> None:
    """Raise ValueError if a formula names a column that is not there."""
    for column in formula.columns:
        if column not in table.header:
            close = _close(column, table.header)
            perhaps = f"; did you mean {_written(close)}?" if close else ""
            raise ValueError(
                f"columns {shown(f'{name}={formula.text}')}: log {table.path} has no column "
                f"{shown(column)}; the header has {listed(table.header)}{perhaps}"
            )


def _of(
    quantity: str, given: Mapping[str, Formula], known: Mapping[str, str], table: Table
) -> Formula | None:
    """Return the formula of a quantity: that which is given, or a column that has a name of it."""
    if quantity in given:
        return given[quantity]
    names = [name for name in dict.fromkeys(table.header) if known.get(name) == quantity]
    if len(names) > 1:
        choice = quoted(f"{quantity}={_written(names[0])}")
        raise ValueError(
            f"log {table.path} has columns {' and '.join(names)}, both of which are {quantity}; "
            f"expected one of them, or --columns {choice} to choose"
        )
    return Formula.column(names[0]) if names else None


def _missing(
    system: System,
    table: Table,
    needed: Sequence[str],
    missing: Sequence[str],
    there: Mapping[str, Formula],
) -> str:
    """Return the message for quantities that a log does not have."""
    known = targets(system)
    own = {quantity: name for name, quantity in known.items() if name != quantity}

    def label(quantity: str) -> str:
        return f"{quantity} ({own[quantity]})" if quantity in own else quantity

    left = unused(table, there.values())
    pairs = []
    for quantity in missing:
        close = _likely(quantity, own.get(quantity, quantity), left)
        left = [name for name in left if name != close]
        pairs.append(quoted(f"{quantity}={_written(close) if close else '...'}"))
    return (
        f"log {table.path} has no column {', '.join(map(label, missing))}; "
        f"{type(system).__name__} needs {', '.join(map(label, needed))}, and the header has "
        f"{listed(table.header)}; name other columns, as in --columns {' '.join(pairs)}"
    )


def _likely(quantity: str, name: str, left: Sequence[str]) -> str | None:
    """Return the column among those left that a quantity is most likely, None if there is none."""
    times = [c for c in left if any(part in c.casefold() for part in _TIME)]
    if quantity == "t":
        return times[0] if times else None
    return _close(name, left) or _close(quantity, left)


def _close(name: str, names: Iterable[str]) -> str | None:
    """Return the name that is most like another one, in small or capital letters."""
    by_small = {each.casefold(): each for each in names}
    close = get_close_matches(name.casefold(), by_small, 1)
    return by_small[close[0]] if close else None


def _written(name: str) -> str:
    """Return a column's name as a formula."""
    return name if name.isidentifier() else "{" + name + "}"
