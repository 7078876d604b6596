"""Null tests of the leaderboard's statistics: estimators that are equal have to tie."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimators.enkf import EnKF
from pinnobs_gym.leaderboard.comparison import p_value, score
from pinnobs_gym.leaderboard.contenders import LARGEST
from pinnobs_gym.leaderboard.influence import Field, Results
from pinnobs_gym.leaderboard.intervals import CONFIDENCE
from pinnobs_gym.leaderboard.tie_groups import tie_groups
from pinnobs_gym.scoring.evaluation import make_estimator
from pinnobs_gym.scoring.playing import play

SIZES = (2, 5, 12, 25)
"""Numbers of equal estimators in `made_up`."""
SYSTEMS = ("ReverseDuffing", "ModifiedAcademic")
"""Systems of `filter_rates`."""
POOL = 40
"""Number of filters that are run in `filter_rates`."""
EPISODES = 50
"""Number of episodes of each system in `filter_rates`."""


def made_up(repetitions: int = 500, seed: int = 0) -> dict[str, float]:
    """Return the rate at which 2, 5, 12 and 25 equal estimators are all in one tie group, by
    number, for made-up scores.

    There are 3 systems with 50 episodes. Every other estimator is trained with 5 seeds, the rest
    have one. Log ratios are sums of independent effects: of the episode for all estimators
    (standard deviation 0.5), of the training seed (0.1, normal), of the episode for this estimator
    (0.3) and of both together (0.2, trained ones only). All but the seed's follow Student's t₃.
    An episode diverges where another such sum exceeds 0.8, in about 5 % of episodes.
    """
    rates = {}
    for size in SIZES:
        rng = np.random.default_rng([seed, size])
        tied = [len(tie_groups(_equal_field(rng, size))) == 1 for _ in range(repetitions)]
        rates[f"{size} estimators"] = float(np.mean(tied))
    return rates


def _equal_field(rng: np.random.Generator, size: int) -> Field:
    """Draw the results of equal estimators as described in `made_up`."""
    field: dict[str, dict[str, Results]] = {str(each): {} for each in range(size)}
    for system in range(3):
        shared = 0.5 * _heavy(rng, 1, 50)
        for each in range(size):
            num_seeds = 5 if each % 2 else 1
            log_ratios, others = (
                shared + _scores(rng, num_seeds, 50, (0.1, 0.3, 0.2)) for _ in range(2)
            )
            field[str(each)][str(system)] = Results(log_ratios, others > 0.8)
    return field


def _scores(
    rng: np.random.Generator, num_seeds: int, episodes: int, spread: tuple[float, float, float]
) -> np.ndarray:
    """Draw log ratios (num_seeds, episodes) with these standard deviations of the effects of seeds,
    of episodes and of both together; with one seed only the episodes' effect."""
    of_seed, of_episode, of_both = spread
    log_ratios = of_episode * _heavy(rng, 1, episodes)
    if num_seeds == 1:
        return log_ratios
    seeds = of_seed * rng.standard_normal((num_seeds, 1))
    return log_ratios + seeds + of_both * _heavy(rng, num_seeds, episodes)


def _heavy(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Draw numbers of unit variance from Student's t₃."""
    return rng.standard_t(3, shape) / np.sqrt(3)


def coverage(repetitions: int = 1000, seed: int = 0) -> dict[str, float]:
    """Return the rate at which the 95 % interval of `score` contains the true score, by numbers of
    training seeds, episodes and systems, for made-up scores of `_scores` (0.2, 0.3, 0.2)."""
    rates = {}
    for num_seeds in (1, 2, 3, 5):
        for episodes in (20, 100):
            for systems in (1, 6):
                rng = np.random.default_rng([seed, num_seeds, episodes, systems])
                inside = [
                    p_value(score(_made_systems(rng, num_seeds, episodes, systems)))
                    >= 1 - CONFIDENCE
                    for _ in range(repetitions)
                ]
                name = f"{num_seeds} seeds, {episodes} episodes, {systems} systems"
                rates[name] = float(np.mean(inside))
    return rates


def _made_systems(
    rng: np.random.Generator, num_seeds: int, episodes: int, systems: int
) -> Mapping[str, Results]:
    """Draw one estimator's results by system."""
    drawn = [_scores(rng, num_seeds, episodes, (0.2, 0.3, 0.2)) for _ in range(systems)]
    return {str(i): Results(ratios, np.isnan(ratios)) for i, ratios in enumerate(drawn)}


def filter_seeds(repetitions: int = 500) -> float:
    """Return the smallest of the `filter_rates` but those of filters with one seed."""
    rates = filter_rates(repetitions)
    return min(rate for name, rate in rates.items() if "one seed" not in name)


def filter_rates(repetitions: int = 500) -> dict[str, float]:
    """Return the rates at which 2 or 5 ensemble Kalman filters that differ only in the seeds of
    their random numbers are all in one tie group.

    A pool of filters is run once on the benchmark episodes of `SYSTEMS`, relative to the first of
    them, in the steady window. The repetitions draw from the pool filters of three kinds:

    - ``five seeds``: five of the pool, as an estimator with five training seeds.
    - ``seed per episode``: in every episode another one of the pool.
    - ``one seed``: one of the pool. These do not test the statistics: a seed's random numbers are
      the same in all episodes, so that filters of two seeds are not equal. Their mean scores over
      episodes 0 to 49 and 50 to 99 of ReverseDuffing have a correlation of 0.46.
    """
    pool = _filter_pool()
    rates = {}
    for name, draw in _DRAWS.items():
        for size in (2, 5):
            rng = np.random.default_rng(size)
            tied = []
            for _ in range(repetitions):
                field: dict[str, dict[str, Results]] = {str(each): {} for each in range(size)}
                drawn = draw(rng, size)
                for system, members in zip(SYSTEMS, drawn, strict=True):
                    log_ratios, diverged = pool[system]
                    for results, rows in zip(field.values(), members, strict=True):
                        at = rows, np.arange(EPISODES)
                        results[system] = Results(log_ratios[at], diverged[at])
                tied.append(len(tie_groups(field)) == 1)
            rates[f"{size} filters, {name}"] = float(np.mean(tied))
    return rates


def _five_seeds(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw members of the pool, the same in all systems, shape (systems, filters, seeds, 1)."""
    members = rng.permutation(POOL)[: 5 * size].reshape(1, size, 5, 1)
    return members.repeat(len(SYSTEMS), axis=0)


def _seed_per_episode(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw members of the pool, others in each system, shape (systems, filters, 1, episodes)."""
    order = np.argsort(rng.random((len(SYSTEMS), POOL, EPISODES)), axis=1)
    return order[:, :size, None]


def _one_seed(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw members of the pool, the same in all systems, shape (systems, filters, 1, 1)."""
    members = rng.permutation(POOL)[:size].reshape(1, size, 1, 1)
    return members.repeat(len(SYSTEMS), axis=0)


_DRAWS = {
    "five seeds": _five_seeds,
    "seed per episode": _seed_per_episode,
    "one seed": _one_seed,
}


def _filter_pool() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return log ratios and divergence (filters, episodes) by system, of seeds 0, 1, ..."""
    results = {}
    for system in SYSTEMS:
        game = Game.of(system)
        scores = [
            play(game, make_estimator(EnKF, game, {"seed": seed}), range(EPISODES)).scores_alone
            for seed in range(POOL)
        ]
        log_error = np.log(np.minimum([each.nrmse_steady for each in scores], LARGEST))
        results[system] = log_error - log_error[0], np.array([each.diverged for each in scores])
    return results
