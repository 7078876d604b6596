"""Changes of valid files, each with what it is called."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from random import Random
from typing import Any

NUMBERS = (
    "1e400",
    "-1e400",
    "nan",
    "NaN",
    "inf",
    "-Infinity",
    "1_000",
    "１２",
    "٣",
    "0x10",
    "1e308",
)
NUMBERS += ("", " ", "true", "null", "--1", "1,5", "9" * 5000, "1e-400", "-0", "{}", "[]", '"a"')
NUMBERS += ("nan(1)", "1e", "١e1", "-1", "1" * 400, "=1+1", "1 2", "1\t", "\u200b1")
"""What may stand in the place of a number."""
VALUES: tuple[Any, ...] = (None, True, -1, 0, 1.5, 10**400, 2**63, "", "x", "\x1b[2J", "\ud800")
VALUES += ([], {}, [[]], {"": {}}, "x" * 10**5, [1] * 1000, "1", " x", "\u202ex", 1e308, -1e308)
"""What may stand in the place of a value in JSON."""
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


def flipped_bit(rng: Random, data: bytes) -> bytes:
    """Flip one bit."""
    place = rng.randrange(len(data))
    return data[:place] + bytes([data[place] ^ 1 << rng.randrange(8)]) + data[place + 1 :]


def cut_off(rng: Random, data: bytes) -> bytes:
    """Cut off the end."""
    return data[: rng.randrange(len(data))]


def without_a_part(rng: Random, data: bytes) -> bytes:
    """Leave out a part."""
    first = rng.randrange(len(data))
    return data[:first] + data[first + rng.randint(1, 40) :]


def random_bytes(rng: Random, data: bytes) -> bytes:
    """Overwrite a part at random."""
    first = rng.randrange(len(data))
    part = rng.randbytes(rng.randint(1, 20))
    return data[:first] + part + data[first + len(part) :]


def nothing(rng: Random, data: bytes) -> bytes:
    """Leave nothing."""
    return b""


def other_number(rng: Random, data: bytes) -> bytes:
    """Put another text in the place of a number."""
    places = [match.span() for match in _NUMBER.finditer(data)] or [(0, 0)]
    first, last = rng.choice(places)
    return data[:first] + rng.choice(NUMBERS).encode() + data[last:]


def lines_changed(rng: Random, data: bytes) -> bytes:
    """Repeat, remove, swap, empty or join lines."""
    lines = data.split(b"\n")
    i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    what = rng.randrange(5)
    if what == 0:
        lines.insert(i, lines[j])
    elif what == 1:
        del lines[i]
    elif what == 2:
        lines[i], lines[j] = lines[j], lines[i]
    elif what == 3:
        lines.insert(i, b"")
    else:
        lines[i : i + 2] = [b"".join(lines[i : i + 2])]
    return b"\n".join(lines)


def inserted(rng: Random, data: bytes) -> bytes:
    """Insert what text files should not have."""
    parts = (b"\0", b'"', b"'", b"\r", b"\x1b[2J", b"\xff", b"\xc3", b",", b"\n", b"\xe2\x80\xae")
    parts += (
        b"x" * 200_000,
        b"[" * 20_000,
        b"{" * 20_000,
        b"\xe2\x80\xa8",
        b"\\",
        b"#",
        b"=",
        b";",
    )
    place = rng.randrange(len(data) + 1)
    return data[:place] + rng.choice(parts) + data[place:]


def encoded(rng: Random, data: bytes) -> bytes:
    """Encode a text otherwise."""
    text = data.decode()
    ways = (("utf-8-sig", text), ("utf-16", text), ("cp1252", f"µ{text}"), ("utf-7", f"µ{text}"))
    encoding, changed = rng.choice((*ways, ("utf-8", text.replace("\n", rng.choice("\r\v\0")))))
    return changed.encode(encoding)


def crlf(rng: Random, data: bytes) -> bytes:
    """End lines as Windows does."""
    return data.replace(b"\n", b"\r\n")


Change = Callable[[Random, bytes], bytes]
BINARY: tuple[Change, ...] = (
    flipped_bit,
    flipped_bit,
    cut_off,
    without_a_part,
    random_bytes,
    nothing,
)
TEXT: tuple[Change, ...] = (
    *BINARY[1:],
    *[other_number] * 3,
    lines_changed,
    inserted,
    encoded,
    crlf,
)


def mutated(rng: Random, data: bytes, changes: tuple[Change, ...]) -> tuple[str, bytes]:
    """Return a changed file, and how it was changed."""
    change, made = rng.choice(changes), data
    for _ in range(20):
        made = change(rng, data)
        if made != data:
            break
    return (change.__doc__ or "").rstrip("."), made


def other_value(rng: Random, value: Any) -> tuple[str, Any]:
    """Return a JSON value with one part replaced or left out, and where."""
    if isinstance(value, dict) and value and rng.random() < 0.8:
        name = rng.choice(list(value))
        if rng.random() < 0.15:
            return name, {key: part for key, part in value.items() if key != name}
        where, part = other_value(rng, value[name])
        return f"{name}.{where}" if where else name, {**value, name: part}
    if isinstance(value, list) and value and rng.random() < 0.5:
        i = rng.randrange(len(value))
        where, part = other_value(rng, value[i])
        return where, [*value[:i], part, *value[i + 1 :]]
    if rng.random() < 0.03:
        return "", json.loads("[" * 400 + "]" * 400)
    return "", rng.choice(VALUES)
