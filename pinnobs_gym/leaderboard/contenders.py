"""Estimators as they are compared: all training seeds of one estimator together, across games."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.leaderboard.distinct import name_of
from pinnobs_gym.leaderboard.influence import SMALLEST
from pinnobs_gym.leaderboard.runs import ScoredRun, rows_of
from pinnobs_gym.leaderboard.standings import Standing, standing

WINDOWS = ("steady", "transient")
"""The windows that are ranked, each by itself (`pinnobs_gym.scoring.metrics.windows`)."""
LOST = 1.0
"""Smallest NRMSE that counts for a diverged episode in comparisons: an error of the whole scale."""
LARGEST = 10.0
"""Largest NRMSE that counts for any episode in comparisons."""


@dataclass(frozen=True)
class Errors:
    """The errors of one estimator in one game, over the episodes that all its trainings played."""

    episodes: tuple[str, ...]
    logs: Mapping[str, np.ndarray]
    """By window: the log of the NRMSE between `SMALLEST` and `LARGEST`, and at least `LOST` where
    the episode diverged, shape (training seeds, episodes)."""
    diverged: np.ndarray
    """Which episodes diverged, bool, same shape."""

    def of(self, episodes: Sequence[str]) -> Errors:
        """Return the errors of some of the episodes, in their order."""
        place = {episode: i for i, episode in enumerate(self.episodes)}
        chosen = [place[episode] for episode in episodes]
        logs = {window: values[:, chosen] for window, values in self.logs.items()}
        return Errors(tuple(episodes), logs, self.diverged[:, chosen])


@dataclass(frozen=True, eq=False)
class Contender:
    """An estimator with all its training seeds and one training budget; if it is not trained, with
    one choice of settings."""

    name: str
    games: Mapping[GameName, Sequence[ScoredRun]]
    """Runs of each game, in the order of their `label`; several runs where training seeds
    differ."""

    @property
    def track(self) -> str:
        """``online`` or ``offline``, with ``condition known`` if that is so in any of its games."""
        return max((run.track for run in self.runs), key=len)

    @property
    def runs(self) -> list[ScoredRun]:
        """Runs of all games."""
        return [run for runs in self.games.values() for run in runs]

    @cached_property
    def errors(self) -> Mapping[GameName, Errors]:
        """The errors in each game."""
        return {game: _errors(runs) for game, runs in self.games.items()}

    def standing(self, game: GameName) -> Standing:
        """Return the summary of one of its games over all training seeds."""
        runs = self.games[game]
        return runs[0].standing if len(runs) == 1 else standing(rows_of(runs), runs[0].floor)


def contenders(runs: Iterable[ScoredRun]) -> list[Contender]:
    """Group runs into contenders by name and training budget, those with the most rows first. The
    rows must be `distinct`."""
    groups: dict[str, dict[GameName, list[ScoredRun]]] = defaultdict(lambda: defaultdict(list))
    for run in runs:
        groups[name_of(run.rows[0])][run.game].append(run)
    return [
        Contender(name, dict(sorted(games.items(), key=lambda item: label(item[0]))))
        for name, games in sorted(groups.items(), key=lambda group: _order(group[1]))
    ]


def among(contenders: Iterable[Contender], wanted: Callable[[ScoredRun], bool]) -> list[Contender]:
    """Return the contenders restricted to games whose runs are wanted, those with the most rows
    first. Contenders without such a game are left out."""
    restricted = []
    for contender in contenders:
        games = {game: runs for game, runs in contender.games.items() if wanted(runs[0])}
        if games:
            restricted.append(replace(contender, games=games))
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


def _errors(runs: Sequence[ScoredRun]) -> Errors:
    """Return the errors of a game's runs, a row of the arrays per training seed."""
    played = [{row["episode"]: row for row in run.rows} for run in runs]
    episodes = [episode for episode in played[0] if all(episode in run for run in played)]
    rows = [[run[episode] for episode in episodes] for run in played]
    shape = len(runs), len(episodes)
    diverged = np.array([[row["diverged"] for row in run] for run in rows], bool).reshape(shape)
    logs = {}
    for window in WINDOWS:
        error = np.array([[row[f"nrmse_{window}"] for row in run] for run in rows], float)
        error = np.where(diverged, np.maximum(error.reshape(shape), LOST), error.reshape(shape))
        logs[window] = np.log(np.clip(error, SMALLEST, LARGEST))
    return Errors(tuple(episodes), logs, diverged)
