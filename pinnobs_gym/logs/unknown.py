"""The parameters of a model that a log is to tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pinnobs_gym.simulation.augmented import Unknown, augmented
from pinnobs_gym.simulation.system import System
from pinnobs_gym.simulation.values import is_number


@dataclass(frozen=True)
class Parameters:
    """Parameters of a model, in units of their scale: θ = start + scale·d."""

    names: tuple[str, ...]
    """The fields of the system."""
    start: np.ndarray
    """Where the search begins, shape (n,)."""
    scale: np.ndarray
    """Their size, shape (n,): that of the start or, if that is zero, 1."""
    low: np.ndarray
    """Bounds, shape (n,); −∞ where there is none."""
    high: np.ndarray
    """Bounds, shape (n,); ∞ where there is none."""

    def values(self, d: np.ndarray) -> np.ndarray:
        """Return the parameters (..., n) of d (..., n), within the bounds against rounding."""
        return np.clip(self.start + self.scale * d, self.low, self.high)

    def of(self, system: System, values: np.ndarray) -> System:
        """Return the system with these parameters: (n,), or (batch, n) for one set per row."""
        return replace(system, **{name: values[..., i] for i, name in enumerate(self.names)})


def unknown_parameters(system: System, texts: Sequence[str]) -> Parameters:
    """Return the parameters that a user names: ``k``, ``k=START`` or ``k=START,LOW,HIGH``, with
    -inf and inf for no bound. The start is the model's own value if none is given.

    Raises:
        ValueError: in one line, if a parameter is not known, not a number, named twice, acts on the
            input, or cannot differ between rows (`pinnobs_gym.simulation.augmented`), or if a start
            or a bound is not right.
    """
    found: dict[str, tuple[float, float, float]] = {}
    for text in texts:
        name, equals, rest = text.partition("=")
        known = system.parameters
        if name not in known:
            listed = ", ".join(known) or "none"
            raise ValueError(
                f"unknown parameter {name!r} of {type(system).__name__}; it has {listed}"
            )
        if name in found:
            raise ValueError(f"parameter {name!r} is given twice; expected once")
        if not is_number(known[name]):
            kind = type(system).__name__
            raise ValueError(f"parameter {name}={known[name]!r} of {kind}; expected a number")
        found[name] = _numbers(text, rest) if equals else (float(known[name]), -np.inf, np.inf)
    start, low, high = np.array(list(found.values())).reshape(-1, 3).T
    scale = np.where(start == 0, 1.0, abs(start))
    if not np.isfinite(start).all():
        wrong = list(found)[int(np.argmin(np.isfinite(start)))]
        raise ValueError(f"parameter {wrong}={found[wrong][0]}; expected a finite start")
    constants = {
        n: Unknown(float(a), float(s)) for n, a, s in zip(found, start, scale, strict=True)
    }
    if constants:
        augmented(system, parameters=constants)  # refuses what cannot differ between rows
    return Parameters(tuple(found), start, scale, low, high)


def _numbers(text: str, values: str) -> tuple[float, float, float]:
    """Return the start and the bounds that a text gives."""
    try:
        numbers = [float(value) for value in values.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) == 1:
        numbers += [-np.inf, np.inf]
    if len(numbers) != 3 or not numbers[1] <= numbers[0] <= numbers[2] or numbers[1] == numbers[2]:
        raise ValueError(
            f"parameter {text!r}; expected name, name=START or name=START,LOW,HIGH with numbers "
            "LOW <= START <= HIGH"
        )
    return numbers[0], numbers[1], numbers[2]
