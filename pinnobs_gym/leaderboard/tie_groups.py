"""Groups of estimators whose results cannot be told apart."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from pinnobs_gym.leaderboard.comparison import estimate, p_value
from pinnobs_gym.leaderboard.influence import (
    Field,
    Influence,
    Results,
    divergence,
    interquartile_mean,
)


@dataclass(frozen=True, eq=False)
class _Player:
    """An estimator with its results of each system."""

    name: str
    ratios: Mapping[str, Influence]
    divergences: Mapping[str, Influence]
    score: float
    rate: float


def tie_groups(field: Field, level: float = 0.05) -> tuple[tuple[str, ...], ...]:
    """Divide estimators into groups that tie, best group first.

    Each group is found among the estimators that are in no better one:

    1. Those that diverge significantly more often than the one that diverges least (of several,
       the one with the best score) are outranked.
    2. Of the others, the group is the one with the smallest `score` and all that are not
       significantly worse than it by `difference`.

    A test of k estimators compares the smallest of its k - 1 p-values with its level over the
    number of pairs k(k - 1)/2; if that is significant, the estimator is left out, and so on with
    the k - 1 that remain. This is Holm's procedure ("A simple sequentially rejective multiple test
    procedure", 1979) with the number of pairs (Shaffer, "Modified sequentially rejective multiple
    test procedures", 1986) in place of k - 1: the best is chosen by the same data, so that its
    distance from the worst is the range of k values, not the difference of two. Each of the two
    tests has half of the level.

    Rates at which 2, 5, 12 and 25 equal estimators were all tied, the lowest of 32 settings of
    made-up scores without divergence, with a level of 5 % for the second test: Holm over k - 1
    comparisons 94, 92, 88 and 82 %; over pairs 94, 95, 95 and 95 %. If up to 30 % of episodes
    diverged, two estimators were tied in 88 to 97 % with the whole level for each test, and in 94
    to 99 % with half of it. `made_up` of `scripts/null_test.py` repeats the check.

    Args:
        field: results by estimator and system.
        level: probability, at most, that equal estimators are told apart when a group is found.

    Returns:
        Names in the order of their score within a group.

    Raises:
        ValueError: in one line, if the level is not between 0 and 1, or the estimators differ in
            systems or in numbers of episodes.
    """
    if not 0 < level < 1:
        raise ValueError(f"level={level}; expected a number between 0 and 1")
    players = [_player(name, results) for name, results in field.items()]
    remaining = sorted(players, key=lambda player: (player.score, player.name))
    groups = []
    while remaining:
        group = _best_group(remaining, level)
        groups.append(tuple(player.name for player in group))
        remaining = [player for player in remaining if player not in group]
    return tuple(groups)


def ranks_of(groups: Sequence[Sequence[str]]) -> dict[str, int]:
    """Return the rank of each estimator: one more than the number of those in better groups."""
    ranks: dict[str, int] = {}
    for group in groups:
        ranks |= dict.fromkeys(group, 1 + len(ranks))
    return ranks


def _player(name: str, results: Mapping[str, Results]) -> _Player:
    """Return an estimator with its statistics."""
    ratios = {system: interquartile_mean(one) for system, one in results.items()}
    divergences = {system: divergence(one) for system, one in results.items()}
    mean_ratio, rate = estimate(ratios).value, estimate(divergences).value
    return _Player(name, ratios, divergences, mean_ratio, rate)


def _best_group(players: Sequence[_Player], level: float) -> list[_Player]:
    """Return the best group of estimators, which are in the order of their score."""
    least = min(players, key=lambda player: player.rate)
    converging = _tied(least, players, lambda player: player.divergences, level / 2)
    return _tied(converging[0], converging, lambda player: player.ratios, level / 2)


def _tied(
    best: _Player,
    players: Sequence[_Player],
    statistic: Callable[[_Player], Mapping[str, Influence]],
    level: float,
) -> list[_Player]:
    """Return the players, in their order, that are not significantly worse than the best of them
    in a statistic, by the procedure of `tie_groups`."""
    others = [statistic(player) for player in players]
    p_values = [p_value(estimate(other, statistic(best))) for other in others]
    left = set(range(len(players)))
    for index in sorted(left, key=lambda index: p_values[index]):
        pairs = len(left) * (len(left) - 1) / 2
        if pairs == 0 or p_values[index] > level / pairs:
            break
        left.remove(index)
    return [players[index] for index in sorted(left)]
