"""Comparison of estimators across systems and conditions, from stored scores only."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.leaderboard.contenders import PEER, Contender, among
from pinnobs_gym.leaderboard.intervals import (
    Interval,
    bootstrapped,
    improvement,
    interquartile_mean,
)
from pinnobs_gym.leaderboard.standings import Standing
from pinnobs_gym.simulation.conditions import CONDITIONS


@dataclass(frozen=True)
class Line:
    """One estimator across systems."""

    estimator: str
    track: str
    ratio: Interval | None
    """exp of the interquartile mean, over all systems and episodes, of log(NRMSE/NRMSE of the
    `PEER`) on the same episode; None without common episodes."""
    better: Interval | None
    """Probability of a smaller NRMSE than the peer's on the same episode."""
    games: Mapping[GameName, Standing]
    """Summary of each game that it played."""
    us_per_step: float
    """Median over games."""

    @property
    def knows(self) -> str:
        """The information given to it, the most in any of its games."""
        return max((standing.knows for standing in self.games.values()), key=len, default="")

    @property
    def known_ratio(self) -> float:
        """The ratio; infinite if it is missing or undefined."""
        return np.inf if self.ratio is None or np.isnan(self.ratio.value) else self.ratio.value


def lines(contenders: Iterable[Contender]) -> list[Line]:
    """Return a line per contender over the systems' ranked conditions: online before offline, then
    those with the most games, then those with the smallest ratio."""
    unsorted = [_line(contender) for contender in among(contenders, lambda run: run.ranked)]
    return sorted(unsorted, key=lambda x: (x.track != "online", -len(x.games), x.known_ratio))


def _line(contender: Contender) -> Line:
    """Return the line of a contender."""
    strata = list(contender.ratios.values())
    standings = {game: contender.standing(game) for game in contender.games}
    return Line(
        estimator=contender.name,
        track=contender.track,
        ratio=bootstrapped(strata, interquartile_mean).exp if strata else None,
        better=bootstrapped(strata, improvement) if strata else None,
        games=standings,
        us_per_step=float(np.median([s.us_per_step for s in standings.values()])),
    )


def log_ratios(contenders: Sequence[Contender]) -> dict[str, dict[str, float]]:
    """Return the interquartile mean of log(NRMSE/NRMSE of the `PEER`) over all systems and
    episodes, by condition and name.

    Only online contenders that have a ratio for each of the peer's games under the condition are
    included. Conditions are in the order of `CONDITIONS`.
    """
    online = [contender for contender in contenders if contender.track == "online"]
    ratios = {}
    for condition in sorted(
        {run.game.condition for each in online for run in each.runs}, key=_condition_order
    ):
        players = among(online, lambda run, played=condition: run.game.condition == played)
        needed = sum(len(player.games) for player in players if player.name == PEER)
        whole = [player for player in players if 0 < needed == len(player.ratios)]
        if whole:
            ratios[condition] = {player.name: _mean_ratio(player) for player in whole}
    return ratios


def _condition_order(condition: str) -> tuple[int, str]:
    """Return the sort key of a condition: its place in `CONDITIONS`, with others last."""
    listed = list(CONDITIONS)
    return listed.index(condition) if condition in listed else len(listed), condition


def _mean_ratio(contender: Contender) -> float:
    """Return the interquartile mean of a contender's ratios; infinite if it is undefined."""
    values = np.concatenate([ratio.ravel() for ratio in contender.ratios.values()])
    value = float(interquartile_mean(values))
    return np.inf if np.isnan(value) else value


def ranks(ratios: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, int]]:
    """Return each estimator's rank under every condition, by condition and name. The smallest of
    `log_ratios` has rank 1, and ties share a rank."""
    return {
        condition: {
            name: 1 + sum(other < value for other in values.values())
            for name, value in values.items()
        }
        for condition, values in ratios.items()
    }
