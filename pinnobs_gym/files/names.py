"""Names as parts of paths."""

from __future__ import annotations

import hashlib
import re

_LONGEST_NAME = 80
"""Largest length of a `file_name`, short enough for several in one path."""
_DEVICES = (f"{device}{number}" for device in ("com", "lpt") for number in range(10))
_RESERVED = frozenset({"con", "prn", "aux", "nul", *_DEVICES})
"""Names that Windows keeps for devices."""


def file_name(name: str) -> str:
    """Return a name as one part of a path. Different names stay different, up to upper and lower
    case: a name with unsafe characters, such as ``../a``, is spelt without them and with its
    hash."""
    safe = re.sub(r"[^\w.+-]", "_", name, flags=re.ASCII).strip(".")[:_LONGEST_NAME]
    if safe == name and safe.partition(".")[0].lower() not in _RESERVED:
        return safe
    return f"{safe}-{hashlib.sha256(name.encode()).hexdigest()[:8]}".lstrip("-")
