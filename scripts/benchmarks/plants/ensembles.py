"""Ensembles on chaotic plants: Lorenz-96 for the EnKF, Lorenz-63 for the particle filter."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from benchmarks import Figure, at_most
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimators.enkf import EnKF
from pinnobs_gym.estimators.particle import ParticleFilter
from pinnobs_gym.simulation.start_law import Gaussian
from pinnobs_gym.simulation.system import Array, Setup, System, independent, stack

SPUN_UP = 400
"""Number of cycles that do not count in the errors of Lorenz-96."""
CYCLES = 1000
"""Number of cycles that do."""


class Lorenz96(System):
    """The model of Lorenz (1996), ẋᵢ = (xᵢ₊₁ − xᵢ₋₂)xᵢ₋₁ − xᵢ + 8 on a ring, all of it measured
    with noise 1 every 0.05."""

    model_step = 0.05

    def f(self, t: Array, x: Array, u: Array) -> Array:
        n = x.shape[-1]
        wrapped = np.concatenate([x[..., -2:], x, x[..., :1]], axis=-1)
        return (wrapped[..., 3:] - wrapped[..., :n]) * wrapped[..., 1 : n + 1] - x + 8

    def h(self, t: Array, x: Array, u: Array) -> Array:
        return x + 0.0

    def h_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        return np.broadcast_to(np.eye(x.shape[-1]), (*x.shape, x.shape[-1]))

    def distances(self) -> tuple[np.ndarray, np.ndarray]:
        apart = abs(np.subtract.outer(np.arange(self.nx), np.arange(self.nx)))
        ring = np.minimum(apart, self.nx - apart)
        return ring, ring


def lorenz96(size: int, cycles: int) -> type[Lorenz96]:
    """Return the model with so many states and an episode of so many cycles.

    Its episodes start near the unstable rest point 8, from which they take a few hundred cycles to
    the attractor; the prior is that of the start.
    """
    setup = Setup(
        x0_law=Gaussian((8.0,) * size, independent(*[1.0] * size)),
        duration=cycles * 0.05,
        dt=0.05,
        noise_std=1.0,
    )
    names = tuple(f"x{i + 1}" for i in range(size))
    declared = {
        "state_names": names,
        "output_names": tuple(f"y{i + 1}" for i in range(size)),
        "scale": (4.0,) * size,
        "setups": {"benchmark": setup},
    }
    return dataclass(frozen=True)(type("Lorenz96", (Lorenz96,), declared))


def lorenz96_errors(
    size: int, seeds: range, cycles: int, skipped: int, **settings: float | None
) -> np.ndarray:
    """Return the root mean squares over states, averaged over the cycles after those skipped, of an
    EnKF's errors in episodes of these seeds, (len(seeds),)."""
    source = EpisodeSource(lorenz96(size, cycles + skipped))
    errors = []
    for seed in seeds:
        episodes = source.play(source.draw(source.streams([seed])))
        own = EnKF.for_setup(source.system, source.setup, seed=seed, **settings)
        error = own.run(source.record(episodes)).xhat[0] - episodes.x[:-1, 0]
        errors.append(np.sqrt((error[skipped:] ** 2).mean(axis=-1)).mean())
    return np.array(errors)


@dataclass(frozen=True)
class Lorenz63(System):
    """The model of Lorenz (1963), of which the first state is measured with noise 1 every 0.05,
    with process noise of 0.3 in each state per sample."""

    state_names = ("x1", "x2", "x3")
    output_names = ("y",)
    scale = (10.0, 10.0, 10.0)
    setups = {
        "benchmark": Setup(
            x0_law=Gaussian((0.0, 0.0, 24.0), independent(8.0, 8.0, 8.0)),
            duration=20.0,
            dt=0.05,
            noise_std=1.0,
            process_noise=float(0.3 / np.sqrt(0.05)),
        )
    }

    def f(self, t: Array, x: Array, u: Array) -> Array:
        a, b, c = x[..., 0], x[..., 1], x[..., 2]
        return stack(x, 10 * (b - a), a * (28 - c) - b, a * b - 8 / 3 * c)

    def h(self, t: Array, x: Array, u: Array) -> Array:
        return x[..., :1]

    def f_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        a, b, c = x[..., 0], x[..., 1], x[..., 2]
        rows = [(-10 + 0 * a, 10 + 0 * a, 0 * a), (28 - c, -1 + 0 * a, -a), (b, a, -8 / 3 + 0 * a)]
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)

    def h_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        return np.broadcast_to([[1.0, 0.0, 0.0]], (*x.shape[:-1], 1, 3))


def lorenz63_errors(runs: int, **settings: int) -> np.ndarray:
    """Return the RMSE over states after sample 100 of a particle filter, in runs that start on the
    attractor: shape (runs,)."""
    source = EpisodeSource(Lorenz63)
    draws = source.draw(source.streams(range(runs)))
    # The state on the attractor is that to which a first episode has moved from the draw.
    x0 = source.play(draws).x[-1]
    episodes = source.play(source.draw(source.streams(range(runs, 2 * runs))), x0)
    own = ParticleFilter.for_setup(source.system, source.setup, **settings)
    errors = own.run(source.record(episodes)).xhat - episodes.x[:-1].swapaxes(0, 1)
    return np.sqrt((errors[:, 100:] ** 2).mean(axis=(1, 2)))


def figures(repeats: int) -> Iterator[Figure]:
    """Measure the ensembles."""
    for settings, asked in (
        ({"members": 20, "localisation": 12.0, "inflation": 1.03}, 0.25),
        ({"members": 50, "inflation": 1.04}, 0.22),
    ):
        errors = lorenz96_errors(40, range(10), CYCLES, SPUN_UP, **settings)
        said = ", ".join(f"{name} {value:g}" for name, value in settings.items())
        yield at_most(
            f"EnKF of Lorenz-96, {said}: RMSE, mean of 10", float(errors.mean()), "", asked
        )
        yield at_most(f"EnKF of Lorenz-96, {said}: RMSE, largest", float(errors.max()), "", 0.5)
    errors = lorenz96_errors(400, range(1), 40, 60, members=20, localisation=12.0, inflation=1.03)
    yield at_most("EnKF of 400 states, 20 members: RMSE", float(errors.max()), "", 0.3)
    for particles in (500, 1000, 2000):
        median = float(np.median(lorenz63_errors(20, particles=particles)))
        asked = 0.95 if particles == 1000 else None
        what = f"particle filter of Lorenz-63, {particles} particles: RMSE, median of 20"
        yield (
            Figure(what, median, "", "", None)
            if asked is None
            else at_most(what, median, "", asked)
        )
