"""The exact posterior of an episode's state: the floor of estimation errors."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

from pinnobs_gym.scoring.episode_law import EpisodeLaw
from pinnobs_gym.scoring.proposals import Mixture
from pinnobs_gym.simulation.record import Record

LEAST_ESS = 500.0
"""Smallest effective sample size of a posterior that counts as exact: the mean squared error of its
mean is then at most 1/500 above that of the exact one, on average."""
_FIRST = 2**17
"""Number of draws from the prior for the first sample."""
_ATTEMPTS = 12
"""Number of proposals for one sample before a smaller effective sample size is accepted."""


@dataclass(frozen=True)
class Posterior:
    """Moments of the state at each sample given outputs."""

    mean: np.ndarray
    """Posterior means, shape (batch, num_samples, nx): the estimates of least mean squared
    error."""
    cov: np.ndarray
    """Posterior covariances, shape (batch, num_samples, nx, nx)."""
    ess: np.ndarray
    """Effective sample size of the weighted draws, shape (batch, num_samples)."""


@dataclass(frozen=True)
class Posteriors:
    """The posteriors of a batch of episodes."""

    filtered: Posterior
    """Given the outputs up to each sample."""
    smoothed: Posterior
    """Given all outputs of the record."""


def exact_bayes(law: EpisodeLaw, record: Record, draws: int = 4096, seed: int = 0) -> Posteriors:
    """Compute the posterior of the state of a plant without process noise by adaptive importance
    sampling of x₀ and of the plant.

    Draws from the prior serve the first sample. Weighted by the likelihood of the outputs so far,
    over the density that they were drawn from, draws serve as many further samples as their
    effective sample size stays above `LEAST_ESS`; then a mixture is fitted to the latest of these
    posteriors, and new draws come from it (population Monte Carlo, Cappé et al. 2004, "Population
    Monte Carlo"; Cappé et al. 2008, "Adaptive importance sampling in general mixture classes").
    Trajectories are those of the simulation's own solver, so that the posterior is that of the
    law which makes the episode. An episode's result does not depend on the others.

    Args:
        law: the law of the episodes.
        record: the episodes.
        draws: number of initial states per proposal, of all plants together.
        seed: of the draws.

    Returns:
        The posteriors; ``ess`` is below `LEAST_ESS` where no proposal reached it.

    Raises:
        ValueError: in one line, if the record is not of these episodes' sample times.
    """
    times = law.source.times[: record.num_samples]
    if not np.array_equal(record.t, times):
        raise ValueError("the record has other sample times than the episodes of this law")
    each = [_Sampler.of(law, record, i, draws, seed).run() for i in range(record.batch)]
    batches = [
        Posterior(*(np.stack([getattr(part, name) for part in parts]) for name in _MOMENTS))
        for parts in zip(*each, strict=True)
    ]
    return Posteriors(*batches)


_MOMENTS = ("mean", "cov", "ess")


@dataclass
class _Draws:
    """Weighted draws of initial states of each plant, with what they imply up to some sample."""

    x: np.ndarray
    """Trajectories, shape (num_samples, count, nx), those of all plants after each other."""
    log_weight: np.ndarray
    """Log weights after each sample, shape (num_samples, count)."""

    def __post_init__(self) -> None:
        top = self.log_weight.max(axis=1, keepdims=True)
        self.weight = np.exp(self.log_weight - np.where(np.isfinite(top), top, 0.0))
        self.weight /= np.maximum(self.weight.sum(axis=1, keepdims=True), 1e-300)

    @property
    def ess(self) -> np.ndarray:
        """Effective sample size after each sample, (num_samples,)."""
        return 1 / np.maximum((self.weight**2).sum(axis=1), 1e-300)

    def moments(self, weight: np.ndarray, part: slice) -> tuple[np.ndarray, np.ndarray]:
        """Return means (k, nx) and covariances (k, nx, nx) of the states at some samples, given
        weights (k, count) or (1, count)."""
        x = np.where(np.isfinite(self.x[part]), self.x[part], 0.0)  # such states have no weight
        mean = np.matmul(weight[:, None], x)[:, 0]
        off = x - mean[:, None]
        return mean, np.matmul((weight[..., None] * off).transpose(0, 2, 1), off)


@dataclass
class _Sampler:
    """Adaptive importance sampling of one episode."""

    law: EpisodeLaw
    y: np.ndarray
    """Received outputs, shape (num_samples, ny)."""
    u: np.ndarray
    """Inputs, shape (num_samples, nu)."""
    draws: int
    rng: np.random.Generator

    @staticmethod
    def of(law: EpisodeLaw, record: Record, row: int, draws: int, seed: int) -> _Sampler:
        """Return the sampler of one episode of a record. Its random numbers are those of the seed
        and of the outputs, so that they do not depend on the batch."""
        y = np.ascontiguousarray(record.y[row])
        digest = hashlib.sha256(y.tobytes()).digest()
        entropy = [seed, *np.frombuffer(digest[:16], "<u4").tolist()]
        return _Sampler(law, y, record.u[row], draws, np.random.default_rng(entropy))

    def run(self) -> tuple[Posterior, Posterior]:
        """Return the filtered and the smoothed posterior, without the axis of the batch."""
        num_samples, nx = len(self.y), self.law.source.system.nx
        shapes = ((num_samples, nx), (num_samples, nx, nx), (num_samples,))
        filtered = Posterior(*(np.empty(shape) for shape in shapes))
        found, start, attempts, count = self._first(), 0, 0, self.draws
        while True:
            ess = found.ess
            low = np.flatnonzero(ess[start:] < LEAST_ESS)
            stop = start + int(low[0]) if len(low) else len(ess)
            if stop == start and attempts >= _ATTEMPTS:
                stop += 1  # go on with too few
            if stop > start:
                part = slice(start, stop)
                filtered.mean[part], filtered.cov[part] = found.moments(found.weight[part], part)
                filtered.ess[part] = ess[part]
                attempts, count = 0, self.draws
                if stop == num_samples:
                    mean, cov = found.moments(found.weight[-1:], slice(0, num_samples))
                    return filtered, Posterior(mean, cov, np.full(num_samples, ess[-1]))
                fitted_to = found.log_weight[stop - 1]
            else:
                # No sample is served: the proposal is refined with weights that are flattened.
                attempts += 1
                count = self.draws * 2 ** (attempts // 3)
                fitted_to = _flattened(found.log_weight[start], 0.5 * LEAST_ESS)
            start = stop
            further = min(num_samples, 3 * start + 8)
            found = self._proposed(found.x[0], fitted_to, further, count)

    def _first(self) -> _Draws:
        """Return draws from the prior, the same number of each plant, after the first sample."""
        plants = self.law.plants
        x0 = self.law.draw(_FIRST, self.rng)
        parts = np.array_split(x0, len(plants))
        likelihood = [
            self.law.log_likelihood(plant, part[None], self.y, self.u)
            for plant, part in zip(plants, parts, strict=True)
        ]
        self._plant = np.repeat(np.arange(len(plants)), [len(part) for part in parts])
        return _Draws(x0[None], np.concatenate(likelihood, axis=1))

    def _proposed(
        self, x0: np.ndarray, log_weight: np.ndarray, num_samples: int, count: int
    ) -> _Draws:
        """Return new draws up to a number of samples, from a mixture fitted to weighted ones.

        Args:
            x0: earlier initial states, shape (earlier, nx).
            log_weight: their log weights, shape (earlier,).
            num_samples: number of samples to serve.
            count: number of draws.
        """
        law, free = self.law, self.law.free
        top = log_weight.max()
        probability = np.array(
            [np.exp(log_weight[self._plant == i] - top).sum() for i in range(len(law.plants))]
        )
        # Each plant keeps a share, as later outputs may speak for it.
        share = probability / probability.sum()
        share = 0.8 * share + 0.2 / len(law.plants) if len(law.plants) > 1 else share
        xs, weights, which = [], [], []
        for i, plant in enumerate(law.plants):
            # Of a plant that is hardly possible, few draws have a weight; flattened, more do.
            own = _flattened(log_weight[self._plant == i], 0.2 * LEAST_ESS)
            weight = np.exp(own - own.max())
            earlier = x0[self._plant == i]
            mixture = Mixture.fitted(earlier[:, free], weight / weight.sum(), self.rng)
            number = max(1, round(share[i] * count))
            # Components that do not vary are those of any draw; conditions may have scaled them.
            drawn = np.tile(x0[0], (number, 1))
            drawn[:, free] = mixture.draw(number, self.rng)
            log_prior = law.log_prior(drawn)
            allowed = np.isfinite(log_prior)
            drawn, log_prior = drawn[allowed], log_prior[allowed]
            # Every draw counts for the share of its plant that is not admissible, too.
            density = mixture.log_density(drawn[:, free]) + np.log(number)
            x = law.trajectories(plant, drawn, num_samples, self.u)
            likelihood = law.log_likelihood(plant, x, self.y, self.u)
            xs.append(x)
            weights.append(log_prior - density + np.cumsum(likelihood, axis=0))
            which.append(np.full(len(drawn), i))
        self._plant = np.concatenate(which)
        return _Draws(np.concatenate(xs, axis=1), np.concatenate(weights, axis=1))


def _flattened(log_weight: np.ndarray, ess: float) -> np.ndarray:
    """Return log weights times the largest power up to 1 that leaves an effective sample size, or
    half the number of weights above zero if that is less."""
    log_weight = log_weight - log_weight.max()
    if _ess(log_weight) >= ess:
        return log_weight
    ess = min(ess, 0.5 * np.isfinite(log_weight).sum())
    low, high = 0.0, 1.0
    for _ in range(40):
        power = (low + high) / 2
        if _ess(_power(log_weight, power)) < ess:
            high = power
        else:
            low = power
    return _power(log_weight, low)


def _power(log_weight: np.ndarray, power: float) -> np.ndarray:
    """Return the log weights (count,) of weights to a power; those of zero stay -inf."""
    return np.where(np.isfinite(log_weight), power * log_weight, -np.inf)


def _ess(log_weight: np.ndarray) -> float:
    """Return the effective sample size of log weights (count,), of which the largest is 0."""
    weight = np.exp(log_weight)
    return float(weight.sum() ** 2 / (weight**2).sum())
