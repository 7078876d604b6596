"""Zip archives of tensors and arrays (``.pt``, ``.npz``), read without trust.

Libraries that read such archives compare some of the checksums or none, and reserve memory for what
the archive claims. Here everything is checked before anything is used: the checksum and the size of
each part, and what the parts need together.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterable, Mapping
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

PACKED = 2**26
"""Largest number of bytes of the parts of a compressed archive."""
LONGEST = 2**26
"""Largest number of bytes of a file in JSON."""
DEEPEST = 100
"""Largest depth of nested lists and objects."""
_FIRST = b"PK\x03\x04"
"""The beginning of every archive that is not empty."""
_KINDS = "biufcU"
"""Kinds of NumPy's types that are read: numbers, truth values and texts."""


class Damaged(Exception):
    """What was read is not what was written; the message is the reason, in one line."""


def read_parts(path: Path, *, compressed: bool = False) -> dict[str, bytes]:
    """Return the parts of an archive by name, after a check of their sizes and checksums.

    Args:
        path: the file.
        compressed: whether parts may be compressed. Otherwise they are stored as they are, so that
            they need no more memory than the file.

    Raises:
        ValueError: in one line, if the file cannot be read.
        Damaged: if it is no archive, is damaged, or its parts are larger than `PACKED` and than the
            file.
    """
    try:
        with path.open("rb") as file:
            data = file.read(len(_FIRST))
            if data != _FIRST:
                raise Damaged("no zip archive")
            data += file.read()
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror or error}") from None
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            most = max(len(data), PACKED) if compressed else len(data)
            return _parts(archive, compressed, most)
    except Damaged:
        raise
    except Exception as error:  # zipfile raises many kinds for what it does not understand
        raise damaged(error) from None


def _parts(archive: zipfile.ZipFile, compressed: bool, most: int) -> dict[str, bytes]:
    """Return the checked parts of an open archive, of at most some number of bytes together."""
    methods = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)[: 1 + compressed]
    parts = archive.infolist()
    total = sum(part.file_size for part in parts)
    if total > most:
        raise Damaged(f"its parts have {total} bytes; expected at most {most}")
    found: dict[str, bytes] = {}
    for part in parts:
        if part.compress_type not in methods:
            raise Damaged(
                f"part {part.filename!r:.80} is compressed by method {part.compress_type}"
            )
        with archive.open(part) as file:
            # To the end, where zipfile compares the checksum, and in steps that are no larger
            content = file.read(part.file_size + 1)
        if len(content) != part.file_size or part.filename in found:
            raise Damaged(f"part {part.filename!r:.80} is not as it was written")
        found[part.filename] = content
    return found


def plain_archive(parts: Mapping[str, bytes]) -> io.BytesIO:
    """Return an archive of these parts and nothing else, for a library that reads archives: what
    was not checked does not reach it."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    buffer.seek(0)
    return buffer


def arrays_of(parts: Mapping[str, bytes]) -> dict[str, np.ndarray]:
    """Return the arrays that the parts of an ``npz`` file are, by their names without ``.npy``.

    Raises:
        Damaged: if a part is no array of numbers, truth values or text, or its size is not that of
            its content.
    """
    try:
        return {name.removesuffix(".npy"): _array(content) for name, content in parts.items()}
    except Damaged:
        raise
    except Exception as error:  # a header is an expression of Python, which can be wrong in any way
        raise damaged(error) from None


def _array(content: bytes) -> np.ndarray:
    """Return the array in a part; nothing is reserved before its size is known to be right."""
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    headers = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    if version not in headers:
        raise Damaged(f"an array in version {version} of its format")
    shape, by_columns, dtype = headers[version](file)
    if dtype.kind not in _KINDS or dtype.itemsize == 0:
        raise Damaged(f"an array of {dtype}; expected numbers, truth values or text")
    if any(size < 0 for size in shape):
        raise Damaged(f"an array of shape {shape}")
    needed, left = prod(shape) * dtype.itemsize, len(content) - file.tell()
    if needed != left:
        raise Damaged(f"an array of shape {shape} and {dtype} with {left} bytes")
    flat = np.frombuffer(content, dtype, offset=file.tell()).copy()
    return flat.reshape(shape, order="F" if by_columns else "C")


def json_of(path: Path) -> Any:
    """Return the JSON value in a file.

    Raises:
        OSError: if the file cannot be read.
        Damaged: if it holds none, is longer than `LONGEST`, or is nested too deeply.
    """
    with path.open("rb") as file:
        data = file.read(LONGEST + 1)
    if len(data) > LONGEST:
        raise Damaged(f"it has more than {LONGEST} bytes")
    return json_in(data)


def json_in(data: bytes | str) -> Any:
    """Return the JSON value in a text.

    Raises:
        Damaged: if it is none, or is nested deeper than `DEEPEST`.
    """
    try:
        value = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise damaged(error) from None
    check_depth(value)
    return value


def check_depth(value: Any) -> None:
    """Check how deep lists, tuples and objects are nested, so that functions that follow them may
    call themselves.

    Raises:
        Damaged: if they are nested deeper than `DEEPEST`.
    """
    level = [value]
    for _ in range(DEEPEST + 1):
        inner = [part for part in level if isinstance(part, Mapping | list | tuple) and part]
        level = [each for part in inner for each in _within(part)]
        if not level:
            return
    raise Damaged(f"nested deeper than {DEEPEST} levels")


def _within(value: Any) -> Iterable[Any]:
    return value.values() if isinstance(value, Mapping) else value


def damaged(error: Exception) -> Damaged:
    """Return an error of one line, of at most 200 characters, from one of a library."""
    return Damaged(" ".join(f"{type(error).__name__}: {error}".split())[:200])
