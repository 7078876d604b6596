"""The lines of a CSV file, each split into cells by itself.

No cell of a log extends over several lines. A quote that is not closed is thus found in its own
line, rather than at the end of the file.
"""

from __future__ import annotations

import codecs
import csv
from collections.abc import Iterator
from pathlib import Path

from pinnobs_gym.files import check_ends

_SHOWN = 60
"""Number of characters of a text that a message shows."""
_SEPARATORS = ",;\t"
_UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


def split_lines(path: Path, kind: str) -> Iterator[tuple[int, str, list[str]]]:
    """Yield the lines with any text in their cells: number, separator and cells.

    The separator is the one of comma, semicolon and tab that the first of these lines has most of.

    Args:
        path: the file.
        kind: what it is, as messages begin.

    Raises:
        ValueError: in one line that names the file and the line, if the file cannot be read, is not
            a text in UTF-8, or has a line that cannot be split.
    """
    separator = ""
    try:
        check_ends(path)
        with path.open(newline="", encoding="utf-8-sig") as file:
            for number, line in enumerate(file, 1):
                place = f"{kind} {path}, line {number}"
                if not separator and "\0" in line:
                    raise ValueError(f"{place}: {shown(line)}; expected a text in UTF-8")
                if not separator and line.strip():
                    separator = max(_SEPARATORS, key=line.count)
                cells = _split(line, separator or ",", place)
                if any(cell.strip() for cell in cells):
                    yield number, separator, cells
    except UnicodeDecodeError:
        raise ValueError(_not_decoded(path, kind)) from None
    except OSError as error:
        raise ValueError(f"cannot read {kind} {path}: {error}") from None


def _split(line: str, separator: str, place: str) -> list[str]:
    try:
        return next(csv.reader([line], strict=True, delimiter=separator), [])
    except csv.Error as error:
        expected = "every quote to be closed in its line"
        if '"' not in line:
            expected = f"cells of up to {csv.field_size_limit()} characters"
        raise ValueError(
            f"{place}: {shown(line)} is no line of a CSV file ({error}); expected {expected}"
        ) from None


def _not_decoded(path: Path, kind: str) -> str:
    """Return the message for a file that is not in UTF-8."""
    data = path.read_bytes()
    if data.startswith(_UTF16):
        return f"cannot read {kind} {path}, which is in UTF-16; expected a text in UTF-8"
    try:
        data.decode()
    except UnicodeDecodeError as error:
        before = data[: error.start].replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        line = 1 + before.count(b"\n")
        byte = f"byte 0x{data[error.start]:02x} is not UTF-8"
        return f"cannot read {kind} {path}, line {line}: {byte}; expected a text in UTF-8"
    return f"cannot read {kind} {path}, which has changed; expected a text in UTF-8"


def shown(text: str) -> str:
    """Return the representation of a text, of which only the beginning is shown if it is long."""
    text = text.strip()
    return repr(text if len(text) <= _SHOWN else f"{text[:_SHOWN]}...")
