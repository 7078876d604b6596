"""Text as a terminal shows it: its width in columns, control characters, and lines of words.

Names and messages are other people's text: of plug-ins, rows files, logs and their columns. What is
shown of them goes through `printable`, by the console or here.
"""

from __future__ import annotations

import logging
import re
import unicodedata
import warnings
from collections.abc import Iterable
from typing import Any

_ESCAPE = re.compile(r"\x1b(?:\[[0-?]*[ -/]*[@-~]|\][^\x07\x1b]*(?:\x07|\x1b\\)?|[@-Z\\-_])?")
"""An ANSI escape sequence (ECMA-48, 5.3 and 5.4), or an operating system command."""
_UNSEEN = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})
"""Unicode categories of characters that move, colour, hide or reorder text, and of halves of
characters, which cannot be encoded."""
_LONGEST = 1000
"""Largest number of characters of a message."""
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


def printable_lines(text: str) -> str:
    """Return `printable` text of several lines."""
    return text if text.isprintable() else "\n".join(map(printable, text.split("\n")))


def one_line(text: str) -> str:
    """Return `printable` text in one line, without white space at its ends."""
    return printable(" ".join(text.split()))


def words_of(error: BaseException) -> str:
    """Return the message of an error in one line, or its type if it has none or cannot say it. Of a
    very long one, as of a value that somebody made long, the middle is left out."""
    try:
        words = one_line(str(error)) or type(error).__name__
        half = _LONGEST // 2
        return words if len(words) <= _LONGEST else f"{words[:half]} ... {words[-half:]}"
    except BaseException:  # a plug-in's own method may raise anything
        return f"{one_line(type(error).__name__)} without a message that can be read"


def show_messages_printable() -> None:
    """Let warnings and the log's lines, which Python writes to stderr, be `printable` in this
    process. A handler that an application gives the log is its own affair."""
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(_Printable())
    if warnings.formatwarning is not _format_warning:
        _FORMATS.append(warnings.formatwarning)
        warnings.formatwarning = _format_warning


class _Printable(logging.Formatter):
    """The format of the log, printable."""

    def format(self, record: logging.LogRecord) -> str:
        return printable_lines(super().format(record))


_FORMATS = [warnings.formatwarning]
"""The formats of warnings that were replaced, of which the last is used."""


def _format_warning(*arguments: Any, **more: Any) -> str:
    return printable_lines(_FORMATS[-1](*arguments, **more))


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
