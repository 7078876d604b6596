"""Beliefs about a plant, each with several hypotheses about its initial state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from pinnobs_gym.estimation.outliers import log_density
from pinnobs_gym.simulation.initial_set import prior_moments
from pinnobs_gym.simulation.matrices import cholesky
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.system import System

OUTLIER_SIZE = 30.0
"""Standard deviation of outliers, in those of the output noise."""


@dataclass(frozen=True, eq=False)
class Beliefs:
    """What may be true of a plant, with probabilities, and hypotheses about the initial state.

    A belief says how large the process noise is, whether parameters or rates of the plant deviate
    from those of the model, and whether outputs have outliers. Each of its hypotheses is a Gaussian
    law of the initial state, given for a prior of mean 0 and covariance I or, where a belief is
    that the initial set is that of the training whatever the prior, in scales of the states.
    """

    assumed_noise: np.ndarray
    """Process noise of each belief as in `GaussianEstimator.assumed_noise`, shape (beliefs,)."""
    deviation: np.ndarray
    """Standard deviation of relative deviations of the plant, see `with_uncertain_plant`, shape
    (beliefs,); 0 for none."""
    outliers: np.ndarray
    """Probability that an output is an outlier, shape (beliefs,); 0 for none."""
    absolute: np.ndarray
    """Whether the initial laws of a belief are given in scales, bool, shape (beliefs,)."""
    weight: np.ndarray
    """Probability of each belief before the first sample, shape (beliefs,)."""
    belief: np.ndarray
    """The belief of each hypothesis, ascending, shape (hypotheses,)."""
    share: np.ndarray
    """Probability of each hypothesis given its belief, shape (hypotheses,)."""
    mean: np.ndarray
    """Mean of the initial state of each hypothesis, shape (hypotheses, nx)."""
    cov: np.ndarray
    """Its covariance, shape (hypotheses, nx, nx)."""

    @cached_property
    def wide(self) -> np.ndarray:
        """Whether the initial law of a belief is wider than the prior, bool (beliefs,)."""
        square = np.einsum("kii->ki", self.cov) + self.mean**2
        parts = [self.belief == i for i in range(len(self.weight))]
        found = np.array([(self.share[p] @ square[p]).max(initial=0.0) > WIDE**2 for p in parts])
        return found & ~self.absolute

    @property
    def names(self) -> tuple[str, ...]:
        """The beliefs in a few words."""
        return tuple(self._name(i) for i in range(len(self.weight)))

    def _name(self, i: int) -> str:
        if self.deviation[i]:
            name = f"plant off by {100 * self.deviation[i]:.3g} %"
        elif self.assumed_noise[i] > SMALL_NOISE:
            name = f"process noise {self.assumed_noise[i]:.2g}"
        else:
            name = "wider start" if self.wide[i] else "model right"
            name = "start of the training" if self.absolute[i] else name
        return name + (", outliers" if self.outliers[i] else "")

    @cached_property
    def log_prior(self) -> np.ndarray:
        """Logarithms of the probabilities of the hypotheses before the first sample, shape
        (hypotheses,)."""
        probability = self.weight[self.belief] * self.share
        return np.log(probability / probability.sum())

    def kept(self, beliefs: np.ndarray, weight: np.ndarray) -> Beliefs:
        """Return some of the beliefs (their numbers, ascending), with other probabilities."""
        rows = np.flatnonzero(np.isin(self.belief, beliefs))
        return Beliefs(
            self.assumed_noise[beliefs],
            self.deviation[beliefs],
            self.outliers[beliefs],
            self.absolute[beliefs],
            weight,
            np.searchsorted(beliefs, self.belief[rows]),
            self.share[rows],
            self.mean[rows],
            self.cov[rows],
        )

    def densities(
        self, innovation: np.ndarray, S: np.ndarray, R: np.ndarray, missing: np.ndarray
    ) -> np.ndarray:
        """Return the logarithms of the densities of the hypotheses' innovations, shape (batch,
        hypotheses, n); −∞ where they are not finite.

        Args:
            innovation: y − ŷ, shape (batch, hypotheses, n, ny); zero where y is missing.
            S: their covariances, shape (batch, hypotheses, n, ny, ny).
            R: covariance of the output noise, shape (n or 1, ny, ny, batch or 1).
            missing: which outputs are missing, bool, shape (batch, n, ny).
        """
        shape, ny = innovation.shape[:3], innovation.shape[3]
        rates = np.broadcast_to(self.outliers[self.belief][:, None], shape)
        absent = np.broadcast_to(missing[:, None], innovation.shape)
        noise = R[0, :, :, :1]
        if R.shape[0] > 1 or R.shape[3] > 1:
            by_row = np.broadcast_to(R.transpose(3, 0, 1, 2)[:, None], (*shape, ny, ny))
            noise = by_row.reshape(-1, ny, ny).transpose(1, 2, 0)
        with np.errstate(all="ignore"):
            found = log_density(
                innovation.reshape(-1, ny).T,
                S.reshape(-1, ny, ny).transpose(1, 2, 0),
                noise,
                absent.reshape(-1, ny).T,
                rates.reshape(-1),
                OUTLIER_SIZE,
            )
        return np.where(np.isfinite(found), found, -np.inf).reshape(shape)


WIDE = 1.2
"""Standard deviation of an initial law, in those of the prior, above which it counts as wider."""
SMALL_NOISE = 1e-4
"""Process noise, as in `GaussianEstimator.assumed_noise`, up to which a model counts as right."""


def starts(beliefs: Beliefs, systems: Sequence[System], prior: Prior) -> list[Prior]:
    """Return the prior of the hypotheses of each belief, of batch × hypotheses rows, those of an
    episode one after the other.

    Args:
        beliefs: the beliefs.
        systems: the model of each, which may have further states.
        prior: the prior of the episodes.
    """
    L = cholesky(prior.cov.transpose(1, 2, 0), semidefinite=True).transpose(2, 0, 1)
    told = ~beliefs.absolute[beliefs.belief]
    relative = prior.mean[:, None] + np.einsum("bij,kj->bki", L, beliefs.mean)
    nx = prior.mean.shape[1]
    scale = np.array(systems[0].scale[:nx], dtype=float)
    mean = np.where(told[:, None], relative, scale * beliefs.mean)
    relative = np.einsum("bij,kjl,bml->bkim", L, beliefs.cov, L)
    cov = np.where(told[:, None, None], relative, scale[:, None] * beliefs.cov * scale)
    found = []
    for i, system in enumerate(systems):
        rows = beliefs.belief == i
        own, P = mean[:, rows].reshape(-1, nx), cov[:, rows].reshape(-1, nx, nx)
        if system.nx > nx:
            more, spread = prior_moments(system, system.setups["benchmark"])
            own = np.concatenate([own, np.tile(more[nx:], (len(own), 1))], axis=1)
            larger = np.zeros((len(P), system.nx, system.nx))
            larger[:, :nx, :nx], larger[:, nx:, nx:] = P, spread[nx:, nx:]
            P = larger
        found.append(Prior(own, (P + P.swapaxes(1, 2)) / 2))
    return found


class Layout(NamedTuple):
    """Hypotheses about initial states, for a prior of mean 0 and covariance I."""

    share: np.ndarray
    """Their probabilities, shape (hypotheses,)."""
    mean: np.ndarray
    """Shape (hypotheses, nx)."""
    cov: np.ndarray
    """Shape (hypotheses, nx, nx)."""


def divided(draws: np.ndarray, number: int, seed: int) -> Layout:
    """Divide a law of initial states into parts, of each of which the mean and the covariance
    become a hypothesis: the clusters of `scipy.cluster.vq.kmeans2` (Lloyd 1982; the start of Arthur
    & Vassilvitskii 2007).

    Args:
        draws: states drawn from the law, shape (draws, nx).
        number: number of parts; the result may have fewer.
        seed: seed of the clusters' start.
    """
    from scipy.cluster.vq import kmeans2

    number = min(number, len(np.unique(draws, axis=0)))  # of a law of a few states, one each
    if number == 1:
        labels = np.zeros(len(draws), dtype=int)
    else:
        _, labels = kmeans2(draws, number, rng=seed, minit="++", missing="warn")
    nx = draws.shape[1]
    parts = [part for i in range(number) if len(part := draws[labels == i]) > nx]
    share = np.array([len(part) for part in parts], dtype=float)
    mean = np.stack([part.mean(axis=0) for part in parts])
    cov = np.stack([np.atleast_2d(np.cov(part.T, bias=True)) for part in parts])
    return Layout(share / share.sum(), mean, cov)
