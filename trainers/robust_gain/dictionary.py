"""The beliefs whose probabilities the trainer learns."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimation.learned.beliefs import Beliefs, Layout, divided
from pinnobs_gym.simulation.initial_set import prior_moments
from pinnobs_gym.simulation.matrices import cholesky
from pinnobs_gym.simulation.system import vector
from pinnobs_gym.simulation.uncertain_plant import with_uncertain_plant
from trainers.robust_gain.config import RobustGainConfig

RIGHT = (1e-5, 3e-5, 1e-4)
"""Process noise of the beliefs that the model is right, of which one is kept: with the smaller one,
a plant that contracts may have a covariance below the error of the model's steps."""
DEVIATING = 1e-4
"""Process noise of the beliefs that the plant deviates from the model, or starts further away."""
FEW = 5
"""Parts of the initial law under beliefs with process noise."""
WIDER = 1.3
"""Its standard deviations, in those of the prior."""
MOST_STATES = 12
"""Largest number of states, with further ones, of a plant that deviates from its model."""
_DRAWS = 20_000
"""Number of draws that are divided."""


class Kind(NamedTuple):
    """A belief, but for outliers."""

    layout: Layout
    """Its hypotheses about the initial state."""
    noise: float
    """Its process noise."""
    deviation: float = 0.0
    """The standard deviation of what the plant deviates by."""
    absolute: bool = False
    """Whether the hypotheses are in scales of the states."""


def dictionary(source: EpisodeSource, config: RobustGainConfig) -> Beliefs:
    """Return all beliefs, each with the same probability: every kind with and without outliers.

    Args:
        source: the episodes, whose initial states are divided into parts.
        config: the settings.
    """
    system = source.system
    rng = np.random.default_rng(config.seed)
    normal = rng.standard_normal((_DRAWS, system.nx))
    # A single initial state would tell the filters where the truth begins.
    inside = normal if source.fixed_x0 else _standard(source, rng)
    near = divided(inside, config.near, config.seed)
    half = divided(inside, max(1, config.near // 2), config.seed)
    few = _scaled(divided(normal, FEW, config.seed), WIDER)
    wide = _scaled(divided(normal, config.wide, config.seed), config.spread)
    mean, cov = prior_moments(system, source.setup)
    L = cholesky(cov[..., None], semidefinite=True)[..., 0]
    scale = vector(system.scale, system.nx, "scale")
    L, mean = L / scale[:, None], mean / scale
    set_itself = Layout(near.share, mean + near.mean @ L.T, L @ near.cov @ L.T)
    kinds = [Kind(near, noise) for noise in RIGHT]
    kinds += [Kind(set_itself, DEVIATING, absolute=True), Kind(wide, DEVIATING)]
    kinds += [Kind(few, noise) for noise in config.noise_levels]
    for deviation in config.deviation:
        larger = with_uncertain_plant(system, deviation)
        if larger is not None and larger.nx <= MOST_STATES:
            kinds.append(Kind(half, DEVIATING, deviation))
    pairs = list(product(kinds, (0.0, config.outliers)))
    layouts = [kind.layout for kind, _ in pairs]
    return Beliefs(
        assumed_noise=np.array([kind.noise for kind, _ in pairs]),
        deviation=np.array([kind.deviation for kind, _ in pairs]),
        outliers=np.array([rate for _, rate in pairs]),
        absolute=np.array([kind.absolute for kind, _ in pairs]),
        weight=np.full(len(pairs), 1 / len(pairs)),
        belief=np.repeat(np.arange(len(pairs)), [len(each.share) for each in layouts]),
        share=np.concatenate([each.share for each in layouts]),
        mean=np.concatenate([each.mean for each in layouts]),
        cov=np.concatenate([each.cov for each in layouts]),
    )


def right(beliefs: Beliefs, noise: float) -> np.ndarray:
    """Return which beliefs are that the model is right, with this process noise and an initial
    state of the set, bool (beliefs,)."""
    near = ~(beliefs.wide | beliefs.absolute)
    return (beliefs.assumed_noise == noise) & (beliefs.deviation == 0) & near


def _standard(source: EpisodeSource, rng: np.random.Generator) -> np.ndarray:
    """Draw initial states (n, nx), and return them for a prior of mean 0 and covariance I. A state
    that is the same in all draws is 0."""
    system = source.system
    x = source.start.draw(rng, _DRAWS)
    x = x[np.asarray(system.admissible(x))]
    if not len(x):
        raise ValueError(f"{type(system).__name__}: no initial state of {_DRAWS} is admissible")
    mean, cov = prior_moments(system, source.setup)
    # The root is that of the estimator, `starts`; a state without variance has none in it.
    L = cholesky(cov[..., None], semidefinite=True)[..., 0]
    return (x - mean) @ np.linalg.pinv(L).T


def _scaled(layout: Layout, factor: float) -> Layout:
    return Layout(layout.share, factor * layout.mean, factor**2 * layout.cov)
