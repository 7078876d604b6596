"""All beliefs from which the trainer chooses."""

from __future__ import annotations

from itertools import product

import numpy as np

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimation.learned.beliefs import Beliefs, Layout, divided
from pinnobs_gym.simulation.initial_set import prior_moments
from pinnobs_gym.simulation.matrices import cholesky
from pinnobs_gym.simulation.uncertain_plant import with_uncertain_plant
from trainers.robust_gain.config import RobustGainConfig

RIGHT = 1e-5
"""Process noise of the belief that the model is right."""
DEVIATING = 1e-4
"""Process noise of the beliefs that the plant deviates from the model."""
FEW = 5
"""Parts of the initial law under beliefs with process noise."""
LARGE = 0.2
"""Process noise from which on the initial law is wider, too."""
WIDER = 1.5
"""Its standard deviations, in those of the prior."""
MOST_STATES = 12
"""Largest number of states, with further ones, of a plant that deviates from its model."""
_DRAWS = 20_000
"""Number of draws that are divided."""


def dictionary(source: EpisodeSource, config: RobustGainConfig) -> Beliefs:
    """Return all beliefs, each with the same probability: every kind with and without outliers.

    Args:
        source: the episodes, whose initial states are divided into parts.
        config: the settings.
    """
    system = source.system
    rng = np.random.default_rng(config.seed)
    normal = rng.standard_normal((_DRAWS, system.nx))
    inside = _standard(source, rng)
    near = divided(inside, config.near, config.seed)
    few = divided(normal, FEW, config.seed)
    kinds = [
        (RIGHT, 0.0, near),
        (RIGHT, 0.0, _scaled(divided(normal, config.wide, config.seed), config.spread)),
    ]
    for noise in config.process_noise:
        kinds.append((noise, 0.0, _scaled(few, WIDER) if noise > LARGE else few))
    half = divided(inside, max(1, config.near // 2), config.seed)
    for deviation in config.deviation:
        larger = with_uncertain_plant(system, deviation)
        if larger is not None and larger.nx <= MOST_STATES:
            kinds.append((DEVIATING, deviation, half))
    kinds = list(product(kinds, (0.0, config.outliers)))
    layouts = [layout for (_, _, layout), _ in kinds]
    return Beliefs(
        assumed_noise=np.array([noise for (noise, _, _), _ in kinds]),
        deviation=np.array([deviation for (_, deviation, _), _ in kinds]),
        outliers=np.array([rate for _, rate in kinds]),
        weight=np.full(len(kinds), 1 / len(kinds)),
        belief=np.repeat(np.arange(len(kinds)), [len(each.share) for each in layouts]),
        share=np.concatenate([each.share for each in layouts]),
        mean=np.concatenate([each.mean for each in layouts]),
        cov=np.concatenate([each.cov for each in layouts]),
    )


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
