"""The posterior of a plant with process noise, from two large particle filters."""

from __future__ import annotations

import hashlib

import numpy as np

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.scoring.episode_law import EpisodeLaw
from pinnobs_gym.scoring.exact_bayes import Posterior
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.runge_kutta import longest_step
from pinnobs_gym.simulation.truth import disturbed_truth, noise_shape

PARTICLES = 20_000
"""Number of particles of each filter."""
_FIRST = 2**17
"""Number of draws of the initial state."""


def particle_reference(
    source: EpisodeSource, record: Record, particles: int = PARTICLES, seed: int = 0
) -> tuple[Posterior, np.ndarray]:
    """Compute the filtered posterior of a plant with process noise by two bootstrap particle
    filters (Gordon, Salmond & Smith 1993) with independent draws, which move as the simulation
    does.

    Args:
        source: of the episodes, under a condition that changes what is told by the noise alone.
        record: the episodes.
        particles: number of particles of each filter.
        seed: of the draws.

    Returns:
        The mean of both filters' posteriors, with their effective sample sizes; and for each
        episode, shape (batch,), the Monte-Carlo standard error of its means, root mean square over
        samples and states, relative to the posterior's standard deviation.

    Raises:
        ValueError: in one line, if the law of the outputs is not known.
    """
    law = EpisodeLaw.of(source, process_noise=True)
    if len(law.plants) > 1 or not source.condition.reference:
        raise ValueError("a particle reference takes noise and missing outputs only")
    parts = [_both(law, record, row, particles, seed) for row in range(record.batch)]
    first, second = (
        Posterior(*map(np.stack, zip(*each, strict=True))) for each in zip(*parts, strict=True)
    )
    mean = (first.mean + second.mean) / 2
    off = first.mean - mean
    cov = (first.cov + second.cov) / 2 + off[..., None] * off[..., None, :]
    variance = np.maximum(np.einsum("bkii->bki", cov), 1e-300)
    error = np.sqrt(np.mean(off**2 / variance, axis=(1, 2)))
    return Posterior(mean, cov, np.minimum(first.ess, second.ess)), error


def _both(
    law: EpisodeLaw, record: Record, row: int, particles: int, seed: int
) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """Return the moments and effective sample sizes of two filters of one episode."""
    y, u = np.ascontiguousarray(record.y[row]), record.u[row]
    digest = np.frombuffer(hashlib.sha256(y.tobytes()).digest()[:16], "<u4").tolist()
    first, second = (
        _filtered(law, y, u, particles, np.random.default_rng([seed, number, *digest]))
        for number in (0, 1)
    )
    return first, second


def _filtered(
    law: EpisodeLaw, y: np.ndarray, u: np.ndarray, particles: int, rng: np.random.Generator
) -> tuple[np.ndarray, ...]:
    """Return means, covariances and effective sample sizes at the samples of one episode, given
    outputs y (num_samples, ny) and inputs u (num_samples, nu)."""
    source = law.source
    system, noise, times = source.system, source.noise, source.times
    shape = noise_shape(system, noise, source.setup.dt, longest_step(system))
    x = law.draw(_FIRST, rng)
    results: list[tuple[np.ndarray, np.ndarray, float]] = []
    for k in range(len(y)):
        if k:
            # Move each particle with noise of its own.
            drawn = rng.standard_normal((1, *shape[:2], len(x), shape[2]))
            inputs = None
            if system.draws_input:
                inputs = np.repeat(u[k - 1 : k + 1, None], len(x), axis=1)
            ends = times[k - 1 : k + 1]
            x = disturbed_truth(system, noise, x, ends, drawn, law.step, None, inputs)[-1]
        # Weigh the particles by the outputs.
        likelihood = law.log_likelihood(system, x[None], y[k : k + 1], u[k : k + 1], first=k)[0]
        weight = np.exp(likelihood - likelihood.max())
        weight /= weight.sum()
        mean = weight @ x
        off = x - mean
        results.append((mean, (weight[:, None] * off).T @ off, 1 / float((weight**2).sum())))
        # Systematic resampling.
        places = (np.arange(particles) + rng.uniform()) / particles
        chosen = np.minimum(np.searchsorted(np.cumsum(weight), places), len(x) - 1)
        x = x[chosen]
    return tuple(map(np.array, zip(*results, strict=True)))
