"""Text in which no character is markup: of Markdown, LaTeX or a spreadsheet."""

from __future__ import annotations

import re

from pinnobs_gym.leaderboard.display import printable

_COMMANDS = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "$": r"\$",
    "&": r"\&",
    "#": r"\#",
    "_": r"\_",
    "%": r"\%",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    # In the encoding OT1, LaTeX's default, these are other characters.
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    # These are drawn as curved quotes.
    "`": r"\textasciigrave{}",
    "'": r"\textquotesingle{}",
    # Behind the end of a line of a table, these are arguments of the command that ended it.
    "[": "{[}",
    "]": "{]}",
    "*": "{*}",
    # Characters that the fonts of text do not have.
    "µ": r"\textmu{}",
    "μ": r"$\mu$",
    "∞": r"$\infty$",
    "▲": r"$\blacktriangle$",
    "▼": r"$\blacktriangledown$",
    "−": "$-$",
    "±": r"$\pm$",
    "×": r"$\times$",
    "≤": r"$\leq$",
    "≥": r"$\geq$",
    "�": "?",
}
_TABLE = str.maketrans(_COMMANDS)
PACKAGES = ("booktabs", "amssymb")
"""Packages that tables and escaped characters need."""


def latex_text(text: str) -> str:
    """Return text with every character escaped that LaTeX takes for markup or prints as another.

    Symbols of the tables become commands of mathematics. All other characters are left as they are,
    in UTF-8; pdflatex knows the Latin ones, lualatex and xelatex all those of their font.
    """
    return re.sub("-(?=-)", "-{}", _one_line(text).translate(_TABLE))  # two would be one dash


def markdown_text(text: str) -> str:
    """Return text with the characters escaped that Markdown, HTML or a table would take for
    markup; brackets only where they could be a link."""
    text = re.sub(r"[\\`*<>|]", r"\\\g<0>", _one_line(text))
    return re.sub(r"\](?=[(\[:])", r"\\]", text)


def csv_text(cell: str) -> str:
    """Return a cell with an apostrophe before it if a spreadsheet would take it for a formula.

    These are cells that start with ``=``, ``+``, ``-``, ``@``, a tab or a carriage return and are
    not a number, so that names from other people's rows are never computed (OWASP, "CSV
    Injection"). Numbers such as -0.1 stay numbers.
    """
    if not cell.startswith(("=", "+", "-", "@", "\t", "\r")):
        return cell
    try:
        float(cell)
    except ValueError:
        return "'" + cell
    return cell


def _one_line(text: str) -> str:
    """Return printable text in one line."""
    return printable(" ".join(text.split()))
