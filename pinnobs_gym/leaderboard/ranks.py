"""Comparison of estimators across systems and conditions, from stored scores only."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.leaderboard.contenders import WINDOWS, Contender, among
from pinnobs_gym.leaderboard.floor import FEWEST_COMMON, is_particles, over_floor
from pinnobs_gym.leaderboard.intervals import Interval
from pinnobs_gym.leaderboard.places import Place, Places, places
from pinnobs_gym.leaderboard.runs import rows_of
from pinnobs_gym.leaderboard.standings import Standing
from pinnobs_gym.simulation.conditions import CONDITIONS


@dataclass(frozen=True)
class Line:
    """One estimator across systems."""

    estimator: str
    track: str
    places: Mapping[str, Place]
    """Its place in each window; absent without episodes in common with the peer."""
    games: Mapping[GameName, Standing]
    """Summary of each game that it played."""
    us_per_step: float | None
    """Median over games; None where it is not known."""
    over_floor: Mapping[str, Interval] = field(default_factory=dict)
    """Its error over the floor in each window, the geometric mean over `floor_games` of its track
    (`pinnobs_gym.leaderboard.floor.over_floor`); absent if it lacks one of them."""
    floor_games: Mapping[GameName, bool] = field(default_factory=dict)
    """The games with a floor for its track, and whether this is a particle reference."""

    @property
    def diverged(self) -> float:
        """Rate of diverged episodes, the mean over games."""
        return float(np.mean([standing.diverged.value for standing in self.games.values()]))

    @property
    def knows(self) -> tuple[str, ...]:
        """The information given to it, the most in any of its games."""
        return max((standing.knows for standing in self.games.values()), key=len, default=())


def lines(contenders: Iterable[Contender]) -> tuple[list[Line], Places]:
    """Return a line per contender over the systems' ranked conditions, and their places.

    Online estimators come before others, then those with the most games, then those with the best
    rank in the steady window.
    """
    compared = among(contenders, lambda run: run.ranked)
    found = places(compared)
    floor_games = _floor_games(compared)
    unsorted = [_line(contender, found, floor_games[contender.track]) for contender in compared]
    order = {
        line.estimator: (line.track != "online", line.track, -len(line.games)) for line in unsorted
    }
    key = lambda line: (*order[line.estimator], *found.order(line.estimator))  # noqa: E731
    return sorted(unsorted, key=key), found


def _floor_games(compared: Iterable[Contender]) -> dict[str, dict[GameName, bool]]:
    """Return, for each track, the games in which any of its contenders can be compared with a
    floor, and whether this is a particle reference."""
    found: dict[str, dict[GameName, bool]] = defaultdict(dict)
    for contender in compared:
        own = found[contender.track]
        for run in contender.runs:
            known = run.floor.among(row["episode"] for row in run.rows)
            if len(known) >= FEWEST_COMMON:
                own[run.game] = is_particles(known[0])
    return found


def _over_floor(contender: Contender, games: Iterable[GameName]) -> dict[str, Interval]:
    """Return the ratios to the floor over these games, by window."""
    if not set(games) <= contender.games.keys():
        return {}
    parts = {
        " ".join(game): (rows_of(contender.games[game]), contender.games[game][0].floor)
        for game in games
    }
    ratios = {window: over_floor(parts, window) for window in WINDOWS}
    return {window: ratio for window, ratio in ratios.items() if ratio is not None}


def _line(contender: Contender, found: Places, floor_games: Mapping[GameName, bool]) -> Line:
    """Return the line of a contender."""
    standings = {game: contender.standing(game) for game in contender.games}
    costs = [s.us_per_step for s in standings.values() if s.us_per_step is not None]
    own = {window: placed.get(contender.name) for window, placed in found.windows.items()}
    return Line(
        estimator=contender.name,
        track=contender.track,
        places={window: place for window, place in own.items() if place is not None},
        games=standings,
        us_per_step=float(np.median(costs)) if costs else None,
        over_floor=_over_floor(contender, floor_games),
        floor_games=floor_games,
    )


def by_condition(contenders: Sequence[Contender]) -> dict[str, Places]:
    """Return the places of online contenders over the systems under each condition; conditions are
    in the order of `CONDITIONS`."""
    online = [contender for contender in contenders if contender.track == "online"]
    played = {run.game.condition for each in online for run in each.runs}
    return {
        condition: places(among(online, lambda run, c=condition: run.game.condition == c))
        for condition in sorted(played, key=_condition_order)
    }


def worst_ranks(found: Mapping[str, Places]) -> dict[str, int | None]:
    """Return the worst rank in the steady window under any condition of each estimator with a rank,
    the best first: those ranked under more conditions, then those with the smaller worst rank."""
    placed: dict[str, list[int]] = {}
    for places_ in found.values():
        for name in places_.windows.get("steady", {}):
            rank = places_.rank("steady", name)
            placed.setdefault(name, []).extend([] if rank is None else [rank])
    names = [name for name in placed if placed[name]]
    names.sort(key=lambda n: (-len(placed[n]), max(placed[n]), sum(placed[n])))
    return {name: max(placed[name]) for name in names}


def _condition_order(condition: str) -> tuple[int, str]:
    """Return the sort key of a condition: its place in `CONDITIONS`, with others last."""
    listed = list(CONDITIONS)
    return listed.index(condition) if condition in listed else len(listed), condition
