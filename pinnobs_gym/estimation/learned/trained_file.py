"""Files of trained weights: written atomically, read without running code, and checked against
their own checksums.

Torch is imported only when a file is read or written, so that importing this module is cheap.
"""

from __future__ import annotations

import io
import json
import pickletools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pinnobs_gym.files import replacing
from pinnobs_gym.files.archive import Damaged, check_depth, damaged, plain_archive, read_parts
from pinnobs_gym.simulation.system import System


def identity(system: System) -> dict[str, Any]:
    """Return the facts by which files identify a system: class name, parameters and sizes."""
    name = type(system).__name__
    return {
        "system": name,
        "parameters": plain(system.parameters),
        "nx": system.nx,
        "ny": system.ny,
    }


def plain(value: Any) -> Any:
    """Convert a value to JSON values; tuples and arrays become lists."""
    return json.loads(json.dumps(value, default=_as_json))


def _as_json(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else repr(value)


def with_tensors(value: Any) -> Any:
    """Replace NumPy arrays by tensors in a nested value, for `write`."""
    import torch

    if isinstance(value, np.ndarray):
        return torch.from_numpy(np.array(value, order="C"))
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        return {name: with_tensors(each) for name, each in value.items()}
    if isinstance(value, tuple | list):
        return type(value)(with_tensors(each) for each in value)
    return value


def with_arrays(value: Any) -> Any:
    """Replace tensors by NumPy arrays in a nested value."""
    import torch

    if isinstance(value, torch.Tensor):
        return value.numpy()
    if isinstance(value, Mapping):
        return {name: with_arrays(each) for name, each in value.items()}
    if isinstance(value, tuple | list):
        return type(value)(with_arrays(each) for each in value)
    return value


def check_same(path: str | Path, found: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """Check that a file's entries have the expected values.

    Raises:
        ValueError: in one line, with the first entry that differs, its value and the expected one.
    """
    for name, value in expected.items():
        other = found.get(name)
        if isinstance(value, Mapping) and isinstance(other, Mapping):
            names = {**value, **other}
            check_same(path, {n: other.get(n) for n in names}, {n: value.get(n) for n in names})
        elif other != value and json.dumps(other) != json.dumps(value):  # in JSON NaN equals itself
            raise ValueError(f"{path} was trained with {name}={other!r}; expected {value!r}")


def write(path: str | Path, content: Mapping[str, Any]) -> None:
    """Write tensors and plain values to a file atomically.

    Raises:
        CannotWrite: in one line, if the file cannot be written.
    """
    import torch

    buffer = io.BytesIO()
    torch.save(dict(content), buffer)
    with replacing(Path(path), durable=True) as temporary:
        temporary.write_bytes(buffer.getbuffer())


def read(path: str | Path) -> dict[str, Any]:
    """Read a file that `write` wrote, without running code from it.

    Raises:
        ValueError: in one line, if the file does not exist, is damaged or of another kind.
    """
    path = Path(path)
    try:
        parts = read_parts(path)
        content = _loaded(parts)
        _check_sizes(content, sum(map(len, parts.values())))
        check_depth(content)
    except Damaged as error:
        raise ValueError(f"{path} is damaged or no file of saved weights ({error})") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path} holds a {type(content).__name__}; expected a dict of weights")
    return content


_MADE = (
    *(f"torch._utils _rebuild_{kind}" for kind in ("tensor_v2", "tensor_v3", "parameter")),
    *("torch Size", "torch.storage UntypedStorage"),
    *("collections OrderedDict", "__builtin__ set", "_codecs encode"),
)
"""What torch's files of weights make of their numbers and texts, beside dicts and lists."""
_SHARED = 16
"""Largest number of tensors that share their numbers, on average."""


def _loaded(parts: Mapping[str, bytes]) -> Any:
    """Return the content of checked parts.

    Torch makes only what its list of safe names has. Of these a file of weights needs few; with
    others it could ask for any amount of memory.
    """
    import torch

    try:
        (plan,) = (part for name, part in parts.items() if name.endswith("/data.pkl"))
        for opcode, name, _ in pickletools.genops(plan):
            if "GLOBAL" in opcode.name and not _is_of_numbers(str(name)):
                raise Damaged(f"it holds a {name!r:.80}; expected weights")
        return torch.load(plain_archive(parts), map_location="cpu", weights_only=True)
    except Damaged:
        raise
    except Exception as error:  # torch raises many kinds for a file it does not understand
        raise damaged(error) from None


def _is_of_numbers(name: str) -> bool:
    """Return whether a name in a file, ``module name``, is in `_MADE`, a storage or a data type."""
    import torch

    module, _, kind = name.partition(" ")
    if name in _MADE or module != "torch":
        return name in _MADE
    return kind.endswith("Storage") or isinstance(getattr(torch, kind, None), torch.dtype)


def _check_sizes(content: Any, size: int) -> None:
    """Check that the content of a file of some number of bytes is not much larger than these:
    tensors may be views that repeat their numbers, and a part may occur often.

    Raises:
        Damaged: otherwise.
    """
    import torch

    waiting, left = [content], _SHARED * size
    while waiting:
        value = waiting.pop()
        left -= 1
        if isinstance(value, torch.Tensor):
            left -= value.numel() * value.element_size()
        elif isinstance(value, Mapping):
            waiting += [*value.keys(), *value.values()]
        elif isinstance(value, tuple | list):
            waiting += value
        if left < len(waiting):
            raise Damaged(f"its content is more than {_SHARED} times its {size} bytes")
