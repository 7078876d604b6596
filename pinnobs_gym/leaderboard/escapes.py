"""Text in which no character is markup: of Markdown, LaTeX, a spreadsheet or a shell."""

from __future__ import annotations

import re
import shlex

from pinnobs_gym.leaderboard.display import one_line, printable

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
    return re.sub("-(?=-)", "-{}", one_line(text).translate(_TABLE))  # two would be one dash


def markdown_text(text: str) -> str:
    """Return text with the characters escaped that Markdown, HTML or a table would take for
    markup: brackets only where they could be a link, underscores only at the ends of words, and
    addresses so that they are no links."""
    text = re.sub(r"[\\`*<>|&~$]", r"\\\g<0>", one_line(text))
    text = re.sub(r"\b_|_\b", r"\\_", text)
    text = re.sub(r":(?=//)|(?<=www)\.|@", r"\\\g<0>", text)
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


def quoted(word: str) -> str:
    r"""Return a word of a command line, quoted for a POSIX shell where it has to be. Characters
    that cannot be seen are written as bash and zsh read them, ``$'\x1b'``."""
    if printable(word) == word:
        return shlex.quote(word)
    parts = []
    for character in word:
        if character in "\\'":
            parts.append("\\" + character)
        elif printable(character) == character:
            parts.append(character)
        else:  # as bytes, whatever the shell's encoding is
            data = character.encode(
                errors="surrogateescape" if "\udc80" <= character <= "\udcff" else "replace"
            )
            parts += [f"\\x{byte:02x}" for byte in data]
    return f"$'{''.join(parts)}'"
