"""Files of trained weights: written whole or not at all, read without running code, and checked.

Torch is imported when a file is read or written: what merely names a trained object needs none.
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
    """What a file of weights must agree with: the system's class name, parameters and sizes."""
    name = type(system).__name__
    return {
        "system": name,
        "parameters": plain(system.parameters),
        "nx": system.nx,
        "ny": system.ny,
    }


def plain(value: Any) -> Any:
    """A value as JSON holds it: lists for tuples and arrays."""
    return json.loads(json.dumps(value, default=_as_json))


def _as_json(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else repr(value)


def with_tensors(value: Any) -> Any:
    """The same nested value with tensors for NumPy arrays, as `write` takes it."""
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
    """The same nested value with NumPy arrays for tensors."""
    import torch

    if isinstance(value, torch.Tensor):
        return value.numpy()
    if isinstance(value, Mapping):
        return {name: with_arrays(each) for name, each in value.items()}
    if isinstance(value, tuple | list):
        return type(value)(with_arrays(each) for each in value)
    return value


def check_same(path: str | Path, found: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """Compare what a file holds with what was expected of it, entry by entry.

    Raises:
        ValueError: in one line, naming the first entry that differs, what was found and expected.
    """
    for name, value in expected.items():
        other = found.get(name)
        if isinstance(value, Mapping) and isinstance(other, Mapping):
            names = {**value, **other}
            check_same(path, {n: other.get(n) for n in names}, {n: value.get(n) for n in names})
        elif other != value and json.dumps(other) != json.dumps(value):  # there NaN equals itself
            raise ValueError(f"{path} was trained with {name}={other!r}; expected {value!r}")


def write(path: str | Path, content: Mapping[str, Any]) -> None:
    """Write tensors and plain values to a file: all of it or, if interrupted, nothing.

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
    """Read what `write` wrote, without ever running code from the file.

    Raises:
        ValueError: in one line, if there is no such file or it is something else or damaged.
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
