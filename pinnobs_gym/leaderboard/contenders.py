"""Estimators as compared in the overview: across games, and with the `PEER`."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.leaderboard.distinct import name_of
from pinnobs_gym.leaderboard.intervals import log_ratio
from pinnobs_gym.leaderboard.runs import ScoredRun, rows_of
from pinnobs_gym.leaderboard.standings import Standing, standing
from pinnobs_gym.scoring.rows import Row

PEER = "ekf"
"""The estimator with which all others are compared."""


@dataclass(frozen=True)
class Contender:
    """An estimator with all its training seeds and one training budget; if it is not trained, with
    one choice of settings."""

    name: str
    games: Mapping[GameName, Sequence[ScoredRun]]
    """Runs of each game, in the order of their `label`; several runs where training seeds
    differ."""
    ratios: Mapping[GameName, np.ndarray]
    """log(NRMSE/NRMSE of the `PEER`) of each game with common episodes, shape (training seeds,
    episodes), over the episodes played by the peer and all training seeds."""

    @property
    def track(self) -> str:
        """``online`` or ``offline``, with ``condition known`` if that is so in any of its games."""
        return max((run.track for run in self.runs), key=len)

    @property
    def runs(self) -> list[ScoredRun]:
        """Runs of all games."""
        return [run for runs in self.games.values() for run in runs]

    def standing(self, game: GameName) -> Standing:
        """Return the summary of one of its games over all training seeds."""
        runs = self.games[game]
        return runs[0].standing if len(runs) == 1 else standing(rows_of(runs))


def contenders(runs: Iterable[ScoredRun]) -> list[Contender]:
    """Group runs into contenders by name and training budget, those with the most rows first. The
    rows must be `distinct`."""
    groups: dict[str, dict[GameName, list[ScoredRun]]] = defaultdict(lambda: defaultdict(list))
    for run in runs:
        groups[name_of(run.rows[0])][run.game].append(run)
    named = {
        name: dict(sorted(games.items(), key=lambda item: label(item[0])))
        for name, games in sorted(groups.items(), key=lambda group: _order(group[1]))
    }
    peer = named.get(PEER, {})
    return [Contender(name, games, _ratios(games, peer)) for name, games in named.items()]


def among(contenders: Iterable[Contender], wanted: Callable[[ScoredRun], bool]) -> list[Contender]:
    """Return the contenders restricted to games whose runs are wanted, those with the most rows
    first. Contenders without such a game are left out."""
    restricted = []
    for contender in contenders:
        games = {game: runs for game, runs in contender.games.items() if wanted(runs[0])}
        ratios = {game: ratio for game, ratio in contender.ratios.items() if game in games}
        if games:
            restricted.append(replace(contender, games=games, ratios=ratios))
    return sorted(restricted, key=lambda contender: _order(contender.games))


def label(game: GameName) -> str:
    """Return the heading of a game's column: the system, with the condition and setup unless these
    are nominal and benchmark."""
    condition = "" if game.condition == "nominal" else f" ({game.condition})"
    setup = "" if game.setup == "benchmark" else f", {game.setup}"
    return game.system + condition + setup


def _order(games: Mapping[GameName, Sequence[ScoredRun]]) -> tuple[int, int]:
    """Return the sort key of contenders: the most rows first, then the earliest row."""
    runs = [run for group in games.values() for run in group]
    return -sum(len(run.rows) for run in runs), min(run.position for run in runs)


def _ratios(
    games: Mapping[GameName, Sequence[ScoredRun]], peer: Mapping[GameName, Sequence[ScoredRun]]
) -> dict[GameName, np.ndarray]:
    """Compute `Contender.ratios` of a contender's games."""
    ratios = {}
    for game in games:
        theirs = {row["episode_seed"]: _score(row) for row in rows_of(peer.get(game, ()))}
        own: dict[object, dict[int, float]] = defaultdict(dict)
        for row in rows_of(games[game]):
            own[row["training_seed"]][row["episode_seed"]] = _score(row)
        common = sorted(set(theirs).intersection(*own.values()))
        if common:
            mine = np.array([[scores[seed] for seed in common] for scores in own.values()])
            ratios[game] = log_ratio(mine, np.array([theirs[seed] for seed in common]))
    return ratios


def _score(row: Row) -> float:
    return np.inf if row["diverged"] else row["nrmse"]
