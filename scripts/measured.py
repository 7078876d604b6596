"""Tables of the figures printed by `benchmark.py`."""

from __future__ import annotations

import importlib
import json
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from machine import processor

from pinnobs_gym.leaderboard.grid import markdown_table

HEADER = ("figure", "measured", "asked")
SHOWN = 3
"""Number of missed bounds that a summary names."""


def read(folder: Path) -> dict[str, list[dict[str, Any]]]:
    """Read the figures of a folder by group, a file ``GROUP.jsonl`` each."""
    return {
        path.stem: [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        for path in sorted(folder.glob("*.jsonl"))
    }


def cells(figures: Sequence[dict[str, Any]]) -> list[tuple[str, str, str]]:
    """Return the rows of a table: each figure's name, its value and its bound."""
    shown = []
    for figure in figures:
        missed = " **missed**" if figure["holds"] is False else ""
        value = f"{figure['value']:g} {figure['unit']}".strip()
        shown.append((figure["figure"], value, figure["asked"] + missed))
    return shown


def page(groups: dict[str, list[dict[str, Any]]]) -> str:
    """Return all figures as a page of Markdown."""
    parts = ["# Measured figures", _intro(groups)]
    for group, figures in groups.items():
        what = (_module(group).__doc__ or "").strip()
        when = f"Measured on {_dates(figures)}."
        parts += [f"## {group}", what, when, markdown_table(HEADER, cells(figures))]
    return "\n\n".join(parts) + "\n"


def readme_section(groups: dict[str, list[dict[str, Any]]]) -> str:
    """Return the README's section: a summary of the bounds that hold and those that are missed, and
    the tables of the groups that have a ``readme_table``."""
    lines, tables = [], []
    for group, figures in groups.items():
        asked = [figure for figure in figures if figure["holds"] is not None]
        missed = [figure for figure in asked if not figure["holds"]]
        rows = [f"{name}: {value}, asked {bound}" for name, value, bound in cells(missed)]
        more = [f"and {len(rows) - SHOWN} more"] if len(rows) > SHOWN else []
        names = "; ".join(rows[:SHOWN] + more).replace(" **missed**", "")
        held = f"{len(asked) - len(missed)} of {len(asked)}"
        lines.append((f"`{group}`", held, names))
        table = getattr(_module(group), "readme_table", None)
        if table is not None:
            tables.append(table(figures))
    summary = markdown_table(("group", "hold", "missed"), lines)
    link = "All of them are in [benchmarks.md](benchmarks.md)."
    return "\n\n".join([f"{_intro(groups)} {link}", summary, *tables])


def _intro(groups: dict[str, list[dict[str, Any]]]) -> str:
    when = _dates([figure for figures in groups.values() for figure in figures])
    return (
        f"Measured on {when} by `python scripts/benchmark.py`, one thread, CPU time "
        f"(Python {platform.python_version()}, {processor()})."
    )


def _dates(figures: Sequence[dict[str, Any]]) -> str:
    """Return when some figures were measured: a date, or the first and the last."""
    dates = sorted({figure["date"] for figure in figures})
    return dates[0] if len(dates) == 1 else f"{dates[0]} to {dates[-1]}"


def _module(group: str) -> Any:
    return importlib.import_module(f"benchmarks.{group}")
