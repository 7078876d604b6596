"""The exact posterior of an episode's state: the floor of estimation errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pinnobs_gym.simulation.matrices import moments
from pinnobs_gym.simulation.model import model_step
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.start_law import StartLaw
from pinnobs_gym.simulation.system import Setup, System


@dataclass(frozen=True)
class Posterior:
    """Moments of the state at each sample given the outputs up to it."""

    mean: np.ndarray
    """Posterior means, shape (batch, num_samples, nx): the estimates of least mean squared
    error."""
    cov: np.ndarray
    """Posterior covariances, shape (batch, num_samples, nx, nx)."""
    ess: np.ndarray
    """Effective sample size of the weighted draws, shape (batch, num_samples)."""


def exact_bayes(
    system: System,
    setup: Setup,
    record: Record,
    R: np.ndarray,
    draws: int = 2000,
    seed: int = 0,
) -> Posterior:
    """Compute the posterior of the state of a plant without process noise by importance sampling of
    x₀, whose law is the setup's.

    Draws from the prior serve the first sample. Each time the number of samples doubles, new draws
    come from a Student distribution with 5 degrees of freedom, fitted to the previous weighted
    draws. They are weighted by the likelihood of all outputs so far over their proposal density
    (population Monte Carlo, Cappé et al. 2004). `Posterior.ess` shows whether there are enough
    draws.

    Args:
        system: the plant.
        setup: defines the set of initial states.
        record: the episodes.
        R: variances of the output noise, shape (ny,).
        draws: number of initial states per proposal.
        seed: of the draws.

    Raises:
        ValueError: in one line, if the law of x₀ has no density.
    """
    rng = np.random.default_rng(seed)
    batch, n, nx = record.batch, record.num_samples, system.nx
    law = setup.start(nx)
    law.log_density(law.mean)  # raises if there is none
    least = 1e-17 * np.diag(np.diag(law.cov))
    result = Posterior(np.empty((batch, n, nx)), np.empty((batch, n, nx, nx)), np.empty((batch, n)))
    x0 = np.broadcast_to(_prior_draws(system, law, draws, rng)[:, None], (draws, batch, nx))
    log_weight = np.zeros((draws, batch))
    start, stop = 0, 1
    while start < n:
        # Importance weights of the initial states given all outputs up to the last sample.
        weight = _reweighted(system, record, R, x0, log_weight, (start, min(stop, n)), result)
        mean, cov = moments(weight, x0)
        # Student proposal at their mean, wider than their covariance.
        spread = np.linalg.cholesky(2.0 * cov + least)
        student = rng.standard_normal((draws, 1, nx, 1))
        student = student / np.sqrt(rng.chisquare(5.0, (draws, 1, 1, 1)) / 5.0)
        x0 = mean + (spread @ student)[..., 0]
        # Prior over proposal density, up to constants.
        log_prior = np.where(system.admissible(x0), law.log_density(x0), -np.inf)
        log_density = -(nx + 5) / 2 * np.log1p((student**2).sum(axis=(2, 3)) / 5.0)
        log_weight = log_prior - log_density
        start, stop = stop, 2 * stop
    return result


def _prior_draws(system: System, law: StartLaw, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw admissible initial states (count, nx) of a law by rejection."""
    kept = np.empty((0, system.nx))
    while len(kept) < count:
        drawn = law.draw(rng, 4 * count)
        kept = np.concatenate([kept, drawn[np.asarray(system.admissible(drawn))]])
    return kept[:count]


def _reweighted(
    system: System,
    record: Record,
    R: np.ndarray,
    x0: np.ndarray,
    log_weight: np.ndarray,
    samples: tuple[int, int],
    result: Posterior,
) -> np.ndarray:
    """Write the posterior at the samples of a range to ``result``, and return the weights (draws,
    batch) at its last sample."""
    x, weight = x0, np.exp(log_weight - log_weight.max(axis=0))
    for k in range(samples[1]):
        if k:
            times = float(record.t[k - 1]), float(record.t[k])
            x = model_step(system, *times, x, record.u[:, k - 1], record.u[:, k])
        # Multiply the weights by the Gaussian likelihood of the outputs, missing ones left out.
        outputs = system.h(record.t[k], x, record.u[:, k])
        misfit = (record.y[:, k] - outputs) ** 2 / R
        log_weight = log_weight - np.nansum(misfit, axis=-1) / 2
        if k >= samples[0]:
            weight = np.exp(log_weight - log_weight.max(axis=0))
            # Normalise, and store the moments and the effective sample size.
            weight /= weight.sum(axis=0)
            result.mean[:, k], result.cov[:, k] = moments(weight, x)
            result.ess[:, k] = 1 / (weight**2).sum(axis=0)
    return weight
