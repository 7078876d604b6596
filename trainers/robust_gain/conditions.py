"""Random conditions of training episodes."""

from __future__ import annotations

import numpy as np

from pinnobs_gym.estimators.robust_gain import NOISE
from pinnobs_gym.simulation.conditions import Combined
from pinnobs_gym.simulation.conditions.base import Condition
from pinnobs_gym.simulation.conditions.measurement import Dropouts, Noise, Outliers
from pinnobs_gym.simulation.conditions.plant import LoadStep, Mismatch, ProcessNoise
from pinnobs_gym.simulation.conditions.start import FarGuess, OutsideSet
from pinnobs_gym.simulation.system import System

NOMINAL = 0.4
"""Probability of no change."""
SECOND = 0.25
"""Probability of two changes, if there is one."""
_RIGHT = (Noise, Dropouts)
"""Changes with which the model is right."""


def draw_condition(rng: np.random.Generator, system: System) -> Condition:
    """Draw a random condition: none, one change or two, each of random strength.

    The strengths cover those of the named conditions
    (`pinnobs_gym.simulation.conditions.CONDITIONS`) and more.
    """
    if rng.random() < NOMINAL:
        return Condition()
    changes: dict[str, tuple[float, Condition]] = {
        "noise": (0.12, Noise(_log_uniform(rng, *NOISE))),
        "guess": (0.07, FarGuess(rng.uniform(0.5, 2.5))),
        "start": (0.05, OutsideSet(rng.uniform(1.1, 1.6))),
        "plant": (0.1, Mismatch(rng.uniform(0.03, 0.35))),
        "process": (0.2, ProcessNoise(_log_uniform(rng, 3e-4, 2e-2))),
        "outliers": (0.15, Outliers(rng.uniform(0.01, 0.1), _log_uniform(rng, 8.0, 100.0))),
        "missing": (0.1, Dropouts(rng.uniform(0.1, 0.5))),
    }
    if hasattr(system, "load_step_torque"):
        changes["load"] = (0.2, LoadStep(rng.uniform(0.2, 0.8)))
    names = list(changes)
    odds = np.array([changes[name][0] for name in names])
    number = 2 if rng.random() < SECOND else 1
    chosen = rng.choice(len(names), number, replace=False, p=odds / odds.sum())
    parts = [changes[names[i]][1] for i in sorted(chosen)]
    return parts[0] if number == 1 else Combined(tuple(parts))


def model_is_right(condition: Condition) -> bool:
    """Return whether the model, the prior and the noise told to estimators are those of the
    episodes."""
    parts = condition.parts if isinstance(condition, Combined) else (condition,)
    return all(type(part) is Condition or isinstance(part, _RIGHT) for part in parts)


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
