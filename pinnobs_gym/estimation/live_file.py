"""Files of live filters: arrays and plain values in NumPy's format ``npz``, read without running
code from them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pinnobs_gym.estimation.estimator import Estimator
from pinnobs_gym.estimation.live_identity import check_identity, identity
from pinnobs_gym.estimation.live_tree import Tree, in_memory_order
from pinnobs_gym.files import replacing
from pinnobs_gym.files.archive import Damaged, arrays_of, json_in, read_parts

FORMAT = "pinnobs-gym live filter"
VERSION = 2
"""Version of the format; files of another one are refused."""


def write(path: Path, estimator: Estimator, content: Mapping[str, Any]) -> None:
    """Write a content to a file atomically, with what the estimator and its model are.

    Args:
        path: path of the file.
        estimator: the estimator.
        content: values, arrays and states, see `Tree.plain`.

    Raises:
        ValueError: in one line, if the file cannot be written or a part cannot be saved.
    """
    tree = Tree(estimator)
    plain = tree.plain(dict(content))
    ordered = [in_memory_order(array) for array in tree.arrays]
    header = {
        "format": FORMAT,
        "version": VERSION,
        "identity": identity(estimator),
        "content": plain,
        "orders": [order for _, order in ordered],
    }
    text = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    arrays: dict[str, Any] = {f"array{i}": array for i, (array, _) in enumerate(ordered)}
    with replacing(path, durable=True) as temporary, temporary.open("wb") as file:
        np.savez(file, header=text, **arrays)


def read(path: Path, estimator: Estimator) -> dict[str, Any]:
    """Return the content of a file that `write` wrote for the same estimator and model.

    Raises:
        ValueError: in one line, if the file does not exist, is damaged, of another kind or version,
            or of another estimator or model; it then says what differs.
    """
    header, arrays = _loaded(path)
    if header.get("version") != VERSION:
        raise ValueError(
            f"{path} is of version {header.get('version')} of the format of live filters; expected "
            f"{VERSION}"
        )
    check_identity(path, header["identity"], identity(estimator))
    try:
        orders = header["orders"]
        ordered = [arrays[f"array{i}"] for i in range(len(orders))]
        found = [
            array.transpose(np.argsort(order).astype(int))  # an empty order is of floats
            for array, order in zip(ordered, orders, strict=True)
        ]
        content = Tree(estimator, found).value(header["content"])
        if not isinstance(content, dict):
            raise TypeError("no content")
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise damaged(path, error) from None
    return content


def damaged(path: Path, error: Exception) -> ValueError:
    """Return the error of one line that says that a file cannot be used."""
    kind = "" if isinstance(error, Damaged) else f"{type(error).__name__}: "
    reason = " ".join(f"{kind}{error}".split())[:300]
    return ValueError(f"{path} is damaged or no file of a live filter ({reason})")


def _loaded(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the header and the arrays of a file."""
    try:
        arrays = arrays_of(read_parts(path))
        header = json_in(arrays["header"].tobytes())
        if header["format"] != FORMAT or not isinstance(header["identity"], dict):
            raise TypeError("another format")
    except (Damaged, LookupError, TypeError) as error:
        raise damaged(path, error) from None
    return header, arrays
