"""Logs of plants, and what an engineer may tell wrongly of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from benchmarks.plants.battery import Battery

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import Setup, System

SEEDS = range(10)
"""Seeds of the logs of each kind."""
DURATION: dict[type[System], float] = {Battery: 1500.0}
"""Durations in s of plants whose episodes are longer than needed."""


@dataclass(frozen=True, eq=False)
class Told:
    """Logs, and what an engineer tells of them."""

    system: System
    """The model."""
    setup: Setup
    """Its noise."""
    record: Record
    """A log in each row."""
    x: np.ndarray
    """The true states, shape (batch, num_samples, nx)."""


Change = Callable[[Told, np.random.Generator], Told]
"""What is wrong with logs."""


@lru_cache(maxsize=32)
def right(cls: type[System], seeds: Sequence[int] = SEEDS) -> Told:
    """Return right logs of a plant."""
    source = EpisodeSource(cls, duration=DURATION.get(cls))
    episodes = source.play(source.draw(source.streams(seeds)))
    record = source.record(episodes)
    return Told(
        source.system, source.setup, record, episodes.x[: record.num_samples].swapaxes(0, 1)
    )


def _outputs(told: Told, i: int | slice, values: np.ndarray) -> Told:
    y = told.record.y.copy()
    y[..., i] = values
    return replace(told, record=replace(told.record, y=y))


def times(i: int, factor: float) -> Change:
    """An output in another unit, or of the other sign."""
    return lambda told, rng: _outputs(told, i, factor * told.record.y[..., i])


def swapped(told: Told, rng: np.random.Generator) -> Told:
    """The first two outputs in each other's column."""
    return _outputs(told, slice(0, 2), told.record.y[..., 1::-1])


def other_state(j: int) -> Change:
    """A sensor of another state in the first output's place."""

    def change(told: Told, rng: np.random.Generator) -> Told:
        noise = 0.02 * rng.standard_normal(told.x.shape[:2])
        return _outputs(told, 0, told.x[..., j] + noise)

    return change


def output_noise(factor: float) -> Change:
    """An output noise that is told larger or smaller than it is."""

    def change(told: Told, rng: np.random.Generator) -> Told:
        level = factor * np.asarray(told.setup.noise_std, dtype=float)
        return replace(told, setup=replace(told.setup, noise_std=level.tolist()))

    return change


def process_noise(factor: float) -> Change:
    """A process noise that is told larger or smaller than it is."""

    def change(told: Told, rng: np.random.Generator) -> Told:
        level = factor * np.asarray(told.setup.process_noise, dtype=float)
        return replace(told, setup=replace(told.setup, process_noise=level.tolist()))

    return change


def outliers(told: Told, rng: np.random.Generator) -> Told:
    """Outputs of which 5 % have an error of ten standard deviations."""
    y = told.record.y
    level = np.broadcast_to(np.asarray(told.setup.noise_std, dtype=float), y.shape[-1])
    wrong = (rng.random(y.shape) < 0.05) * rng.standard_normal(y.shape)
    return _outputs(told, slice(None), y + 10 * level * wrong)


def late(samples: int, outputs: slice = slice(None)) -> Change:
    """Outputs that are stamped some samples late."""

    def change(told: Told, rng: np.random.Generator) -> Told:
        y = told.record.y[..., outputs]
        blank = np.full_like(y[:, :samples], np.nan)
        return _outputs(told, outputs, np.concatenate([blank, y[:, :-samples]], axis=1))

    return change


def without_input(i: int, factor: float = 0.0) -> Change:
    """An input whose column is zero, or has the wrong sign or unit."""

    def change(told: Told, rng: np.random.Generator) -> Told:
        u = told.record.u.copy()
        u[..., i] *= factor
        system = replace(told.system, measured_input=True)
        return replace(told, system=system, record=replace(told.record, u=u))

    return change


def parameters(**values: float) -> Change:
    """A model with other parameters."""
    return lambda told, rng: replace(told, system=replace(told.system, **values))


def model(cls: type[System]) -> Change:
    """A model of another structure."""
    return lambda told, rng: replace(told, system=cls())


def without(outputs: slice) -> Change:
    """Sensors that are not there, so that a state cannot be seen."""
    return lambda told, rng: _outputs(told, outputs, np.asarray(np.nan))
