"""What all estimators in compiled code share: whether there is a library, its arguments, and the
estimator of some rows, which NumPy computes."""

from __future__ import annotations

import inspect
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.simulation.kernels.calls import Plan
from pinnobs_gym.simulation.kernels.plant_library import PlantLibrary, plant_library
from pinnobs_gym.simulation.noise import AssumedNoise, Noise, SampledLevel
from pinnobs_gym.simulation.truth import rows_of

T = TypeVar("T", bound=BaseEstimator)


def library_of(estimator: BaseEstimator, other: str = "") -> PlantLibrary | str:
    """Return the library of an estimator whose class names a ``template``, or the reason in one
    line why there is none; ``other`` is a template that its settings ask for instead."""
    cls = type(estimator)
    template = getattr(cls, "template", "")
    if not template:
        return f"{cls.__name__} has no compiled code"
    if changed := changed_method(cls):
        return f"{cls.__name__} defines {changed}"
    noise = estimator.noise
    if type(noise) is not AssumedNoise or type(noise.told) is not Noise:
        return "its noise has methods of its own"
    return plant_library(estimator.system, other or template)


def changed_method(cls: type[BaseEstimator]) -> str:
    """Return the name of a method of the class that names the template which a subclass of it
    overrides, an empty text if there is none."""
    classes = cls.__mro__
    place = next(i for i, each in enumerate(classes) if "template" in vars(each))
    for name, value in ((n, v) for each in classes[:place] for n, v in vars(each).items()):
        before = getattr(classes[place], name, None)
        if name.startswith("__") or name == "run" or not inspect.isfunction(value):
            continue
        if before is not None and not getattr(before, "__isabstractmethod__", False):
            return name
    return ""


def plan_of(estimator: BaseEstimator, made: PlantLibrary, R: np.ndarray, **settings: Any) -> Plan:
    """Return the plan of an estimator.

    Args:
        estimator: the estimator.
        made: its library.
        R: output noise, shape (samples or 1, ny, ny, batch or 1).
        settings: further fields of ``struct plan``.
    """
    plan = Plan.of(estimator.system, made.numbers, estimator.noise.L(0.0)[..., 0], R)
    plan.set(**settings)
    return plan


def noise_at(noise: Noise, t: np.ndarray) -> np.ndarray:
    """Return the output noise R (samples or 1, ny, ny, batch or 1) at the times t (s) of samples,
    given noise that is constant but for that by sample."""
    if noise.samples is None:
        return noise.R(0.0)[None]
    if _is_same(noise.samples, t):
        return noise.R(float(t[0]))[None]
    return np.stack(np.broadcast_arrays(*(noise.R(float(each)) for each in t)))


def _is_same(samples: SampledLevel, t: np.ndarray) -> bool:
    """Return whether the noise by sample is the same at all times t (s), each that of a sample."""
    std, first = samples.std, samples.std[:, :1]
    same = (std == first) | (np.isnan(std) & np.isnan(first))
    return bool(same.all() and np.isin(t, samples.t).all())


def rows_of_numbers(estimator: BaseEstimator, made: PlantLibrary) -> int:
    """Return the number of rows that the numbers of a model and its noise have, 1 if they are the
    same for any number."""
    shapes = [np.shape(getattr(estimator.system, name)) for name in made.numbers]
    samples = estimator.noise.samples
    told = () if samples is None else samples.std.shape[:1]
    return np.broadcast_shapes((1,), told, *shapes)[0]


def of_rows(estimator: T, rows: np.ndarray) -> T:
    """Return the estimator of some rows of the batch."""
    system, level = rows_of(estimator.system, rows), estimator.noise_std
    if system is estimator.system and not isinstance(level, SampledLevel):
        return estimator
    if isinstance(level, SampledLevel):
        level = level.rows(rows)
    return replace(estimator, system=system, noise_std=level)
