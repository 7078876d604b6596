"""How objects are shown at a prompt and in a notebook: in one line, and as HTML."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Sequence
from dataclasses import MISSING, Field, fields
from html import escape
from typing import Any

from pinnobs_gym.simulation.values import shortly


def call_of(made: Any, *first: str, chosen: Iterable[Field[Any]] | None = None) -> str:
    """Return the call that makes a dataclass's instance, with what is not the default.

    Args:
        made: the instance.
        first: words before the fields.
        chosen: the fields that are shown; all with ``repr`` if None.
    """
    words = list(first)
    for each in fields(made) if chosen is None else chosen:
        value = getattr(made, each.name)
        usual = each.default is not MISSING and repr(value) == repr(each.default)
        if each.repr and not usual:
            words.append(f"{each.name}={shortly(value)}")
    return f"{type(made).__name__}({', '.join(words)})"


def summary_of(cls: type) -> str:
    """Return the first paragraph of a class's docstring in one line."""
    return " ".join((inspect.getdoc(cls) or "").partition("\n\n")[0].split())


def html(title: str, text: str, header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a title, a text and a table as HTML, in which nothing of theirs is markup."""
    lines = [f"<b>{escape(title)}</b><br>{escape(text)}"]
    body = [f"<td>{'</td><td>'.join(escape(str(cell)) for cell in row)}</td>" for row in rows]
    if body:
        head = f"<th>{'</th><th>'.join(map(escape, header))}</th>"
        lines.append("<table>" + "".join(f"<tr>{line}</tr>" for line in (head, *body)) + "</table>")
    return "\n".join(lines)
