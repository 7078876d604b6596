"""Files of trained weights: written atomically, read without running code, and checked.

Torch is imported only when a file is read or written, so that importing this module is cheap.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

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
        ValueError: in one line, if the file cannot be written.
    """
    import torch

    path = Path(path)
    temporary = path.with_name(f"{path.name}.{uuid4().hex}.part")
    buffer = io.BytesIO()
    torch.save(dict(content), buffer)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(buffer.getbuffer())
        os.replace(temporary, path)
    except OSError as error:
        raise ValueError(f"cannot write {path}: {error.strerror or error}") from None
    finally:
        with suppress(OSError):
            temporary.unlink()


def read(path: str | Path) -> dict[str, Any]:
    """Read a file that `write` wrote, without running code from it.

    Raises:
        ValueError: in one line, if the file does not exist, is damaged or of another kind.
    """
    import torch

    try:
        content = torch.load(Path(path), map_location="cpu", weights_only=True)
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror or error}") from None
    except Exception as error:  # torch raises many kinds for a file it does not understand
        kind = type(error).__name__
        raise ValueError(f"{path} is damaged or no file of saved weights ({kind})") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path} holds a {type(content).__name__}; expected a dict of weights")
    return content
