"""Estimators across systems and conditions, from stored scores. Nothing here runs an estimator."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pinnobs_gym.leaderboard.intervals import (
    Interval,
    bootstrapped,
    improvement,
    interquartile_mean,
    log_ratio,
)
from pinnobs_gym.leaderboard.standings import Standing, standing
from pinnobs_gym.scoring.rows import Row
from pinnobs_gym.simulation.conditions import CONDITIONS

PEER = "ekf"
"""The estimator that all are compared with."""

Games = Mapping[str, Sequence[Row]]
"""Rows of one estimator by what is played."""


@dataclass(frozen=True)
class Line:
    """One estimator across systems."""

    estimator: str
    track: str
    ratio: Interval | None
    """exp of the interquartile mean, over all systems and episodes, of log(NRMSE/NRMSE of the
    `PEER`), that of the same episode; None without common episodes."""
    better: Interval | None
    """Probability of a smaller NRMSE than the peer's of the same episode."""
    games: Mapping[str, Standing]
    """How it did on each game that it played."""
    us_per_step: float
    """Median over games."""

    @property
    def place(self) -> tuple[bool, int, float]:
        """What lines are sorted by: online first, then those that played more, then the ratio."""
        ratio = np.inf if self.ratio is None or np.isnan(self.ratio.value) else self.ratio.value
        return self.track != "online", -len(self.games), ratio


def lines(rows: Iterable[Row]) -> list[Line]:
    """Every estimator on the systems under the conditions that these are ranked under, best first,
    online before offline."""
    found = contenders(row for row in rows if row["ranked"])
    peer = found.get(PEER, {})
    result = []
    for name, games in found.items():
        standings = {game: standing(group) for game, group in games.items()}
        strata = _strata(games, peer)
        result.append(
            Line(
                estimator=name,
                track=next(iter(games.values()))[0]["track"],
                ratio=bootstrapped(strata, interquartile_mean).exp if strata else None,
                better=bootstrapped(strata, improvement) if strata else None,
                games=standings,
                us_per_step=float(np.median([s.us_per_step for s in standings.values()])),
            )
        )
    return sorted(result, key=lambda line: line.place)


def ranks(rows: Iterable[Row]) -> dict[str, dict[str, int]]:
    """Each online estimator's rank under every condition, by `log_ratios`; by condition and
    estimator."""
    return {
        condition: {
            name: 1 + sum(other < value for other in values.values())
            for name, value in values.items()
        }
        for condition, values in log_ratios(rows).items()
    }


def log_ratios(rows: Iterable[Row]) -> dict[str, dict[str, float]]:
    """Each online estimator's interquartile mean of log(NRMSE/NRMSE of the `PEER`) over all systems
    and episodes under every condition; of those alone that played every system that the peer did.
    By condition, in the order in which these are listed, and estimator."""
    online: dict[str, list[Row]] = defaultdict(list)
    for row in rows:
        if row["track"] == "online":
            online[row["condition"]].append(row)
    order = list(CONDITIONS)
    found = {}
    for condition in sorted(online, key=lambda c: (order.index(c) if c in order else 99, c)):
        players = contenders(online[condition])
        peer = players.get(PEER, {})
        values = {}
        for name, games in players.items():
            strata = _strata(games, peer)
            if strata and len(strata) == len(peer):
                value = float(interquartile_mean(np.concatenate([s.ravel() for s in strata])))
                values[name] = np.inf if np.isnan(value) else value
        if values:
            found[condition] = values
    return found


def contenders(rows: Iterable[Row]) -> dict[str, dict[str, list[Row]]]:
    """Estimators as the lines of the overview tell them apart: rows by the name of their estimator,
    and by what is played. Training seeds are of one name; budgets of training are in it, and
    settings where they tell two of a name apart: all but those that the most rows are of."""
    groups: dict[tuple[str, str], dict[str, list[Row]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        budget = row["training"].get("config", {}).get("budget")
        name = row["estimator"] if budget is None else f"{row['estimator']}, {budget:g} s"
        settings = "" if row["training"] else json.dumps(row["options"], sort_keys=True)
        game = row["env_id"].removeprefix("pinnobs/")
        if row["condition"] != "nominal":
            game += f" ({row['condition']})"
        if row["setup"] != "benchmark":
            game += f", {row['setup']}"
        groups[name, settings][game].append(row)
    found: dict[str, dict[str, list[Row]]] = {}
    for (name, settings), games in sorted(groups.items(), key=_size, reverse=True):
        found[f"{name} {settings}" if name in found else name] = dict(sorted(games.items()))
    return found


def _size(group: tuple[object, Games]) -> int:
    """How many rows a group has."""
    return sum(map(len, group[1].values()))


def _strata(games: Games, peer: Games) -> list[np.ndarray]:
    """For every game that both played, log(NRMSE/the peer's), shape (training seeds, episodes), of
    the episodes that both played, all training seeds of one."""
    strata = []
    for game in sorted(games.keys() & peer.keys()):
        theirs = {row["episode_seed"]: _score(row) for row in peer[game]}
        own: dict[object, dict[int, float]] = defaultdict(dict)
        for row in games[game]:
            own[row["training_seed"]][row["episode_seed"]] = _score(row)
        common = sorted(set(theirs).intersection(*own.values()))
        if common:
            mine = np.array([[scores[seed] for seed in common] for scores in own.values()])
            strata.append(log_ratio(mine, np.array([theirs[seed] for seed in common])))
    return strata


def _score(row: Row) -> float:
    return np.inf if row["diverged"] else row["nrmse"]
