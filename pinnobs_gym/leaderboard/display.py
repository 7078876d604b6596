"""Text as a terminal shows it: its width in columns, control characters, and lines of words."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable

_ESCAPE = re.compile(r"\x1b(?:\[[0-?]*[ -/]*[@-~]|\][^\x07\x1b]*(?:\x07|\x1b\\)?|[@-Z\\-_])?")
"""An ANSI escape sequence (ECMA-48, 5.3 and 5.4), or an operating system command."""
_UNSEEN = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})
"""Unicode categories of characters that move, colour, hide or reorder text, and of halves of
characters, which cannot be encoded."""
_JOINED_JAMO = range(0x1160, 0x1200)
"""Hangul vowels and final consonants, which are drawn within the syllable before them."""


def printable(text: str) -> str:
    """Return text with every escape sequence, control character and invisible formatting character
    replaced by a visible ``�``, so that names cannot write over a table."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        "�" if unicodedata.category(character) in _UNSEEN else character
        for character in _ESCAPE.sub("�", text)
    )


def width_of(text: str) -> int:
    """Return the number of columns that `printable` text takes in a terminal.

    Wide and fullwidth characters take two (Unicode Standard Annex 11), combining marks none, and
    all others one; so do those of ambiguous width, such as ∞ and ▲.
    """
    return len(text) if text.isascii() else sum(map(_width_of_character, text))


def _width_of_character(character: str) -> int:
    if unicodedata.category(character) in ("Mn", "Me") or ord(character) in _JOINED_JAMO:
        return 0
    return 2 if unicodedata.east_asian_width(character) in ("W", "F") else 1


def padded(text: str, width: int, right: bool = False) -> str:
    """Return text with spaces behind it, or before it (``right``), to this width."""
    spaces = " " * (width - width_of(text))
    return spaces + text if right else text + spaces


def filled(words: Iterable[str], width: int) -> str:
    """Return words as lines of at most this width. A longer word is not cut: it has a
    line of its own."""
    lines: list[str] = []
    for word in words:
        if lines and width_of(lines[-1]) + 1 + width_of(word) <= width:
            lines[-1] += " " + word
        else:
            lines.append(word)
    return "\n".join(lines)
