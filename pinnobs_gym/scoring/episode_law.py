"""The law that makes the episodes of a game: of initial states, plants and received outputs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.simulation.conditions.base import noise_scale
from pinnobs_gym.simulation.residual import residual
from pinnobs_gym.simulation.system import System
from pinnobs_gym.simulation.truth import truth

_LEAST = 1e-12
"""Smallest variance that counts as more than rounding: of a component of the initial state relative
to the largest in scaled units, and of a combination of outputs relative to their own."""


@dataclass(frozen=True)
class EpisodeLaw:
    """The probability law of an episode without process noise, whatever estimators are told.
    Created by `EpisodeLaw.of`."""

    source: EpisodeSource
    plants: tuple[System, ...]
    """The equally probable plants."""

    @classmethod
    def of(cls, source: EpisodeSource, process_noise: bool = False) -> Self:
        """Return the law of a source of episodes.

        Args:
            source: of the episodes.
            process_noise: whether the plant may have process noise; its trajectories are not those
                of `trajectories` then.

        Raises:
            ValueError: in one line, if its likelihood is not known: with process noise, with an
                output or a combination of outputs without noise, from a fixed initial state or a
                list of them, with angles among the states, or under a condition whose plants cannot
                be listed.
        """
        name, system = type(source.system).__name__, source.system
        if source.noise.stochastic and not process_noise:
            raise ValueError(f"{name} has process noise, with which a state has no single past")
        if source.fixed_x0:
            raise ValueError(f"{name} starts from a known state; nothing is to be estimated")
        if system.state_period is not None:
            raise ValueError(f"{name} has angles among its states, whose mean is not defined")
        law = cls(source, source.condition.plants(system))
        source.start.log_density(source.start.mean)  # raises if there is none
        R = law._R
        std = np.sqrt(np.diagonal(R, axis1=1, axis2=2))
        if not (std > 0).all():
            raise ValueError(f"{name} has an output without noise, which has no likelihood")
        correlations = R / (std[:, :, None] * std[:, None])
        if np.linalg.eigvalsh(correlations).min() < _LEAST:
            raise ValueError(
                f"{name} has a combination of outputs without noise, which has no likelihood; "
                "expected a covariance of the output noise that is positive definite"
            )
        if law._errors and (R * np.eye(system.ny) != R).any():
            raise ValueError(f"{name} has correlated output noise and outliers; expected one")
        return law

    @cached_property
    def free(self) -> np.ndarray:
        """Which components of the initial state vary, bool (nx,)."""
        variances = np.diag(self.source.start.cov) / np.square(self.source.system.scale)
        return variances > _LEAST * variances.max()

    @cached_property
    def _R(self) -> np.ndarray:
        """Covariances of the noise of the outputs in the order in which they are received, shape
        (num_samples, ny, ny)."""
        noise, times = self.source.noise, self.source.times[:-1]
        sent = np.array([noise.R(float(t))[..., 0] for t in times])
        received = self.source.condition.arrival(sent)
        # Where none is received, no covariance counts.
        return np.where(np.isnan(received), sent, received)

    @cached_property
    def _errors(self) -> tuple[tuple[float, np.ndarray], ...]:
        system, setup = self.source.system, self.source.setup
        return self.source.condition.output_errors(noise_scale(system, setup))

    def draw(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Draw initial states (count, nx)."""
        source, kept = self.source, np.empty((0, self.source.system.nx))
        while len(kept) < count:
            drawn = source.start.draw(rng, 2 * count)
            drawn = drawn[np.asarray(source.system.admissible(drawn))]
            kept = np.concatenate([kept, source.condition.starts(drawn, source.contains)])
        return kept[:count]

    def log_prior(self, x0: np.ndarray) -> np.ndarray:
        """Return the logarithm of the density at initial states (count, nx), up to a constant,
        (count,); -inf where a state is not one of the law's."""
        source = self.source

        def log_density(x: np.ndarray) -> np.ndarray:
            allowed = np.asarray(source.system.admissible(x))
            return np.where(allowed, source.start.log_density(x), -np.inf)

        return source.condition.start_log_density(x0, log_density, source.contains)

    def trajectories(
        self, plant: System, x0: np.ndarray, num_samples: int, u: np.ndarray
    ) -> np.ndarray:
        """Return the states (num_samples, count, nx) of a plant from initial states (count, nx),
        NaN from those from which it leaves the finite numbers.

        Args:
            plant: one of the plants.
            x0: initial states.
            num_samples: number of samples from the first on.
            u: inputs of the episode, shape (at least num_samples, nu).
        """
        if num_samples == 1:
            return x0[None]
        inputs = None
        if self.source.system.draws_input:
            inputs = np.repeat(u[:num_samples, None], len(x0), axis=1)
        times = self.source.times[:num_samples]
        try:
            return truth(plant, x0, times, self.step, inputs=inputs)
        except FloatingPointError:
            if len(x0) == 1:
                return np.full((num_samples, *x0.shape), np.nan)
            # The others of the batch are simulated apart from it.
            halves = np.array_split(x0, 2)
            parts = [self.trajectories(plant, half, num_samples, u) for half in halves]
            return np.concatenate(parts, axis=1)

    @property
    def step(self) -> float:
        """The simulation's longest step in s, as for whole episodes."""
        times = self.source.times
        return self.source.setup.truth_step or float(times[-1] - times[0]) / 100

    def log_likelihood(
        self, plant: System, x: np.ndarray, y: np.ndarray, u: np.ndarray, first: int = 0
    ) -> np.ndarray:
        """Return the log-likelihood of each sample's outputs given trajectories, up to a constant
        of the sample, shape (num_samples, count).

        Args:
            plant: one of the plants.
            x: states, shape (num_samples, count, nx).
            y: received outputs of the episode, NaN where missing, shape (at least num_samples, ny).
            u: inputs, shape (at least num_samples, nu).
            first: index of the first sample; above 0 only where outputs arrive at once.

        Raises:
            ValueError: in one line, if the plant has no output at some finite state.
        """
        num_samples = len(x)
        part = slice(first, first + num_samples)
        times, u = self.source.times[part, None], u[:num_samples, None]
        with np.errstate(all="ignore"):  # of states that are not finite
            sent = plant.h(times, x, np.broadcast_to(u, (*x.shape[:2], u.shape[-1])))
        lost = ~np.all(np.isfinite(x), axis=-1)
        if np.isnan(sent[~lost]).any():
            name = type(plant).__name__
            raise ValueError(f"{name}.h has no output at some states; expected one at all of them")
        received = self.source.condition.arrival(sent)
        nothing = np.isnan(self.source.condition.arrival(np.zeros((num_samples, sent.shape[-1]))))
        present = ~np.isnan(y[:num_samples]) & ~nothing
        off = residual(y[:num_samples, None], received, plant.output_period)
        off = np.where(present[:, None] & ~lost[..., None], off, np.nan)
        density = self._with_errors(off) if self._errors else self._gaussian(off, part)
        return np.where(lost, -np.inf, density)

    def _gaussian(self, off: np.ndarray, part: slice) -> np.ndarray:
        """Return the log-likelihood (num_samples, count) of deviations (num_samples, count, ny) of
        the outputs of some samples, NaN where there is none."""
        R, known = self._R[part], np.where(np.isnan(off), 0.0, off)
        if (np.eye(R.shape[-1]) * R == R).all():
            # Independent outputs: the squares add.
            variances = np.diagonal(R, axis1=1, axis2=2)[:, None]
            return -0.5 * (known**2 / variances).sum(axis=-1)
        result = np.zeros(off.shape[:2])
        for k in range(len(off)):
            have = ~np.all(np.isnan(off[k]), axis=0)
            if have.any():
                root = np.linalg.cholesky(R[k][np.ix_(have, have)])
                white = np.linalg.solve(root, known[k][:, have].T)
                result[k] = -0.5 * (white**2).sum(axis=0)
        return result

    def _with_errors(self, off: np.ndarray) -> np.ndarray:
        """Return the same of outputs that have errors beyond their noise: per output, a mixture of
        Gaussians."""
        variances = np.diagonal(self._R[: len(off)], axis1=1, axis2=2)[:, None]
        rest = 1 - sum(probability for probability, _ in self._errors)
        parts = []
        for probability, std in ((rest, np.zeros(off.shape[-1])), *self._errors):
            own = variances + np.square(std)
            parts.append(np.log(probability) - 0.5 * (np.log(own) + off**2 / own))
        total = np.logaddexp.reduce(parts, axis=0)
        return np.where(np.isnan(off), 0.0, total).sum(axis=-1)
