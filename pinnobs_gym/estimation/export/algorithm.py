"""What an exported estimator consists of beside the equations of its model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from pinnobs_gym.simulation.kernels.plant_code import PlantCode
from pinnobs_gym.simulation.kernels.source import read


@dataclass(frozen=True)
class Algorithm:
    """The code and the numbers of an estimator. ``@name@`` in code stands for the name of the
    export, and ``@place@`` for the text of a place."""

    lanes: Sequence[str]
    """Texts on lanes, see `pinnobs_gym.estimation.export.scalar`, with ``predict`` and ``correct``
    or whatever ``own`` calls."""
    own: Sequence[str]
    """Texts that follow the numbers, which define ``@name@_init`` and ``advance``."""
    numbers: Mapping[str, np.ndarray]
    """Arrays by name."""
    fields: Sequence[str]
    """Lines of the struct, in which ``@real@`` is the type of numbers."""
    plan: Mapping[str, Any] = field(default_factory=dict)
    """Further fields of ``struct plan``."""
    sizes: Mapping[str, int] = field(default_factory=dict)
    """Whole numbers that code has by name."""
    places: Mapping[str, str] = field(default_factory=dict)
    """Texts of further places."""
    notes: Sequence[str] = ()
    """What the code leaves out, a line each."""
    covariance: bool = False
    """Whether there is one, ``P``, and a P₀ to start from."""


@cache
def own(name: str) -> str:
    """Return the text of a file of the folder ``templates`` beside this module."""
    return (files("pinnobs_gym.estimation.export") / "templates" / name).read_text(encoding="utf-8")


def model_parts(code: PlantCode) -> list[str]:
    """Return the texts of the model's motion and of samples."""
    steps = code.steps or read("loops.h")
    motion = read("interval.h"), read("motion.h")
    return [read("steps.h"), steps, own("leaves.c"), *motion, read("filter.h")]
