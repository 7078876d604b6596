"""The page of the commands, from what each prints with ``--help``."""

from __future__ import annotations

import contextlib
import io
import os
import re
from dataclasses import dataclass, replace

from pinnobs_gym.cli import COMMANDS, main, usage
from pinnobs_gym.leaderboard.grid import markdown_table
from pinnobs_gym.registry import TRAINERS

_WIDTH = "100"
"""Columns of a terminal in which groups of options stand below each other."""


@dataclass(frozen=True)
class Group:
    """The options under one heading of a help text."""

    title: str
    about: str
    """A sentence below the heading; possibly empty."""
    options: tuple[tuple[str, str], ...]
    """How each is given, and what it means."""


@dataclass(frozen=True)
class Help:
    """The help text of a command."""

    usage: str
    about: str
    groups: tuple[Group, ...]


def commands_page() -> str:
    """Return the page: a section per command, with a table of its options."""
    listed = usage().partition("\n\n")[2]
    parts = [
        "# Commands\n",
        "What follows is what the commands print with `--help`. An option with dots takes several "
        "values, and `a|b` is one of both.\n",
        f"```text\n{listed}\n```\n",
    ]
    for name in COMMANDS:
        parts.append(_section(name, parsed(help_text(name))))
    return "\n".join(parts)


def help_text(name: str) -> str:
    """Return the help text of a command. That of `train` is a trainer's; its settings have tables
    on the trainers' pages."""
    first = next(iter(sorted(TRAINERS.sources)))
    for arguments in ([name, "--help"], [name, first, "--help"]):
        text = io.StringIO()
        with (
            _one_column(),
            contextlib.redirect_stdout(text),
            contextlib.redirect_stderr(io.StringIO()),
        ):
            status = main(arguments)
        if status == 0 and "-h, " in text.getvalue():
            return text.getvalue()
    raise ValueError(f"pinnobs {name} --help prints no options")


@contextlib.contextmanager
def _one_column():
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = _WIDTH
    try:
        yield
    finally:
        os.environ.pop("COLUMNS") if before is None else os.environ.update(COLUMNS=before)


def parsed(text: str) -> Help:
    """Return the parts of a help text. Within a group, what an option means begins in the column of
    that of ``--help``."""
    lines = [line.rstrip() for line in text.splitlines()]
    lines = [line for line in lines if not re.fullmatch(r"\s*-+", line)]  # rules
    blocks = [block.splitlines() for block in re.split(r"\n\n+", "\n".join(lines).strip())]
    usage_line = " ".join(" ".join(blocks[0]).split()).removeprefix("usage: ")
    (helped,) = [line for block in blocks for line in block if line.lstrip().startswith("-h, ")]
    column = helped.index("show this help")
    grouped = [block for block in blocks[1:] if block[-1].startswith("  ")]
    about = [" ".join(" ".join(block).split()) for block in blocks[1:] if block not in grouped]
    return Help(usage_line, " ".join(about), tuple(_group(block, column) for block in grouped))


def _group(block: list[str], column: int) -> Group:
    about: list[str] = []
    options: list[list[str]] = []
    for line in block[1:]:
        given, meaning = line[:column], line[column:].strip()
        if line.lstrip().startswith(("-", "[")) or (given.strip() and options):
            if given.rstrip() == line.rstrip() or line[column - 2 : column].strip():
                given, meaning = line, ""
            options.append([given.strip(), meaning])
        elif options:
            options[-1][1] = f"{options[-1][1]} {line.strip()}".strip()
        else:
            about.append(line.strip())
    return Group(
        block[0].strip(), " ".join(about), tuple((given, meaning) for given, meaning in options)
    )


def _section(name: str, told: Help) -> str:
    about, called = told.about, told.usage
    if name == "train":  # that of a trainer, in place of any
        first = next(iter(sorted(TRAINERS.sources)))
        about = "Train an observer or an agent. `pinnobs train --help` lists the trainers."
        called = called.replace(f" {first} ", " TRAINER ")
        told = replace(told, groups=tuple(map(_without_first, told.groups)))
    parts = [f"## {name}\n", f"{about}\n", f"```text\n{_given(called)}\n```\n"]
    for group in told.groups:
        shown = [option for option in group.options if not option[0].startswith("-h")]
        if name == "train" and group.title.startswith("config"):
            parts.append("Then the settings of the [trainer](trainers/index.md), as options.\n")
        elif shown:
            parts += [f"{group.about}\n"] if group.about else []
            cells = [(f"`{_cell(_given(given), '|')}`", _cell(meaning)) for given, meaning in shown]
            header = (group.title.removesuffix("s"), "meaning")
            parts.append(f"{markdown_table(header, cells)}\n")
    return "\n".join(parts)


def _without_first(group: Group) -> Group:
    """Return a trainer's options without the default of its preset, which is another for each."""
    options = [
        (given, meaning.replace(" (default: default)", "")) for given, meaning in group.options
    ]
    return replace(group, options=tuple(options))


def _given(text: str) -> str:
    """Return how an option is given, without the value for none and with dots for several."""
    text = re.sub(r"\{None\}\|\{?|(?<=\])\}", "", text)
    text = re.sub(r"\[?\[(\w+) \[\1 \.\.\.\]\]\]?", r"[\1 ...]", text)
    return text


def _cell(text: str, special: str = r"|*<>_\\") -> str:
    """Return a text for a cell of a table, without the default of what has none."""
    text = re.sub(r" \(default: (None)?\)$", "", text)
    return re.sub(f"([{special}])", r"\\\1", text)
