"""Digests by which JSON objects in files tell that they are as they were written."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from pinnobs_gym.files.archive import Damaged

SEAL = "digest"
"""The field of the digest."""


def sealed(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return an object of JSON values with the digest of all its fields as a further field, in
    place of an earlier one."""
    values = _values(content)
    return {**values, SEAL: _digest(values)}


def unsealed(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return an object without its digest, after a check. White space and the order of fields do
    not count.

    Raises:
        Damaged: if the digest is missing or is that of other values.
    """
    values = _values(content)
    if content.get(SEAL) != _digest(values):
        raise Damaged(f"its values are not those that were written: their {SEAL} differs")
    return values


def _values(content: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in content.items() if name != SEAL}


def _digest(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
