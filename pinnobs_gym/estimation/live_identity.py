"""What an estimator and its model are, as plain values by which files tell whether they fit."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pinnobs_gym.estimation.estimator import BaseEstimator, Estimator
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.system import System, vector

_FEW = 32
"""Largest number of entries of an array that is told number by number, not by a hash."""
_AWAY = (0.0, 0.37, -0.61)
"""Distances, in scales, of the states at which equations are compared from the prior's mean."""
_SAME = 1e-9
"""Largest difference of their values, relative to the largest of these."""
_LENGTH = 80
"""Number of characters of a value that a message shows."""
_TRAITS = (
    *("state_names", "output_names", "input_names", "measured_input", "input_hold", "discrete"),
    *("stiff", "model_step", "state_period", "output_period", "state_low", "state_high"),
)
"""Attributes of a system that estimates depend on, beside its equations and parameters."""


def identity(estimator: Estimator) -> dict[str, Any]:
    """Return what estimates depend on, as JSON values: the estimator's class, settings and trained
    weights, the noise that it is told, and the model. Equations count by their values at a few
    states, since a source may be edited without a change of its names."""
    system = estimator.system
    noise = system.noise(estimator.noise_std, estimator.process_noise)
    shared = {f.name for f in fields(BaseEstimator)}
    own = {f.name: getattr(estimator, f.name) for f in fields(estimator) if f.name not in shared}
    found = {
        "estimator": type(estimator).__name__,
        "model": type(system).__name__,
        "parameters": system.parameters,
        "traits": {name: getattr(system, name) for name in _TRAITS},
        "settings": own,
        "noise": {"output R": noise.R(0.0), "process L": noise.L(0.0), "by sample": noise.samples},
        "equations": _equations(system),
    }
    return json.loads(json.dumps(_plain(found)))


def _equations(system: System) -> dict[str, Any]:
    """Return the values of the equations at a few states, times and inputs."""
    setup, scale = system.setups["benchmark"], vector(system.scale, system.nx, "scale")
    x = Prior.of(system, setup, 1).mean + scale * np.array(_AWAY)[:, None]
    t = np.arange(len(x)) * float(setup.dt)
    u = np.asarray(system.input(t))
    if system.measured_input:
        u = u + np.array(_AWAY)[:, None]
    with np.errstate(all="ignore"):
        values = {name: getattr(system, name)(t, x, u) for name in ("f", "h")}
        if system.own_flow:
            values["flow"] = system.flow(t, t + float(setup.dt), x, u)
    return {name: {"values": np.asarray(value).tolist()} for name, value in values.items()}


def _plain(value: Any) -> Any:
    """Return a value as JSON values."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray | np.generic):
        if value.size <= _FEW:
            return value.tolist()
        digest = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
        return f"{value.dtype} {value.shape} {digest[:16]}"
    if isinstance(value, Mapping):
        return {str(name): _plain(part) for name, part in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(part) for part in value]
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in fields(value)}
    return getattr(value, "__qualname__", None) or repr(value)


def check_identity(path: Path, found: Any, expected: Mapping[str, Any]) -> None:
    """Check that the `identity` in a file is that of the estimator given.

    Raises:
        ValueError: in one line, with the first value that differs and the one expected.
    """
    for difference in _differences("", found, expected):
        raise ValueError(f"{path} was saved with {difference}")


def _differences(name: str, found: Any, expected: Any) -> Iterator[str]:
    """Yield what differs: names, values and expected values."""
    if isinstance(found, dict) and isinstance(expected, dict):
        if set(found) == set(expected) == {"values"}:
            if not _same(found["values"], expected["values"]):
                yield f"other values of {name}; the model of the estimator given was changed"
            return
        for part in {**expected, **found}:
            inner = f"{name}.{part}" if name else part
            yield from _differences(inner, found.get(part), expected.get(part))
    elif json.dumps(found) != json.dumps(expected):  # where NaN equals itself
        yield f"{name}={_shown(found)}; the estimator given has {_shown(expected)}"


def _shown(value: Any) -> str:
    """Return a value for a message, of which only the beginning is shown if it is long."""
    text = repr(value)
    return text if len(text) <= _LENGTH else f"{text[:_LENGTH]}..."


def _same(found: Any, expected: Any) -> bool:
    """Return whether values of equations, rows of components, agree but for rounding, which other
    versions of NumPy may do otherwise. Components may be of very different units."""
    try:
        a, b = np.asarray(found, dtype=float), np.asarray(expected, dtype=float)
    except (TypeError, ValueError):
        return False
    if a.shape != b.shape:
        return False
    size = abs(np.where(np.isfinite(b), b, 0.0)).max(axis=0, initial=0.0)
    return bool(np.isclose(a, b, rtol=0.0, atol=_SAME * size, equal_nan=True).all())
