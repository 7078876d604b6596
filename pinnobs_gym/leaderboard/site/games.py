"""The content of the page for each game, from runs and curves."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pinnobs_gym.envs.game import Game, GameName
from pinnobs_gym.leaderboard.contenders import Contender
from pinnobs_gym.leaderboard.floor import NO_FLOORS, Floors, label
from pinnobs_gym.leaderboard.runs import ScoredRun, rows_of, runs_of
from pinnobs_gym.leaderboard.site.columns import Columns
from pinnobs_gym.leaderboard.site.over_episodes import over_floor, ratios, settling
from pinnobs_gym.leaderboard.site.over_samples import States, errors, reference, states
from pinnobs_gym.leaderboard.standings_table import Table
from pinnobs_gym.scoring import curves
from pinnobs_gym.scoring.curves import Curves
from pinnobs_gym.scoring.rows import Row, seed_of

Players = Mapping[str, Sequence[ScoredRun]]
"""Runs of one game by the contender's name."""


@dataclass(frozen=True)
class GameResults:
    """The results of one game."""

    number: int
    """Its index on the page."""
    game: GameName
    table: Table
    settling: Columns
    """``estimator``, ``t`` in s, and ``share`` of its episodes settled by then."""
    ratios: Columns
    """Quantiles ``q10`` to ``q90`` of each estimator's NRMSE over the Cramér-Rao reference."""
    errors: Columns
    """``estimator``, ``t``, and ``median``, ``q10``, ``q90`` over episodes of a sample's NRMSE."""
    reference: Columns
    """``t`` and the ``median`` over episodes of the error expected at the Cramér-Rao reference, in
    the steady window."""
    over_floor: Columns
    """Each estimator's errors over the floor; see `over_episodes.over_floor`."""
    floor_errors: Columns
    """Those of the floor, as `errors`."""
    floor_settling: Columns
    """That of the floor, as `settling`."""
    states: States | None
    """The example episode; None without curves."""


def games_of(
    contenders: Iterable[Contender],
    tables: Iterable[Table],
    folders: Sequence[Path],
    floors: Floors = NO_FLOORS,
) -> list[GameResults]:
    """Return the results of the games in a system's ranked condition, and of nominal games after
    them.

    Args:
        contenders: in the order of the charts.
        tables: of all games.
        folders: folders with their curves.
        floors: the floors of all games.

    Raises:
        ValueError: in one line, if a file of curves is damaged.
    """
    played: dict[GameName, dict[str, Sequence[ScoredRun]]] = defaultdict(dict)
    for contender in contenders:
        for game, runs in contender.games.items():
            if runs[0].ranked or game.condition == "nominal":
                played[game][contender.name] = runs
    ranked = {game: next(iter(players.values()))[0].ranked for game, players in played.items()}
    known = {table.game: table for table in tables}
    order = sorted(
        played, key=lambda game: (game.env_id, game.setup, not ranked[game], game.condition)
    )
    return [
        _results(number, known[game], played[game], _floors(floors, game, played[game]), folders)
        for number, game in enumerate(order)
    ]


def _floors(floors: Floors, game: GameName, players: Players) -> Players:
    """Return the floors of a game by their names, on the episodes that were played."""
    episodes = {row["episode"] for runs in players.values() for row in rows_of(runs)}
    found: dict[str, list[ScoredRun]] = defaultdict(list)
    for floor in floors.among([game]).by_game.values():
        for run in runs_of(floor.among(episodes)):
            found[label(run.rows[0])].append(run)
    return found


def _results(
    number: int, table: Table, players: Players, floors: Players, folders: Sequence[Path]
) -> GameResults:
    game = table.game
    own = _curves(game, players, folders)
    rows = {name: rows_of(runs) for name, runs in players.items()}
    floor_rows = {name: rows_of(runs) for name, runs in floors.items()}
    settled = settling(rows)
    return GameResults(
        number=number,
        game=game,
        table=table,
        settling=settled,
        ratios=ratios(rows),
        errors=errors(own),
        reference=reference(own.values(), _transient_end(game)),
        over_floor=over_floor({e.name: e.standing for e in table.entries if e.name in players}),
        floor_errors=errors(_curves(game, floors, folders)),
        floor_settling=settling(floor_rows, until=max(settled["t"])),
        states=states(own, _logs(rows.values()), _transient_end(game)),
    )


def _logs(rows: Iterable[Iterable[Row]]) -> dict[int, str]:
    """Return the names of the logs among the episodes of some rows, by their seeds."""
    return {seed_of(row): row["log"] for own in rows for row in own if "log" in row}


def _transient_end(game: GameName) -> float:
    """Return the end of a game's transient window in s from the first sample; infinite if this
    process does not know the game."""
    try:
        return Game.of(game.env_id, game.setup, game.condition).source.setup.transient_end
    except ValueError:
        return np.inf


def _curves(game: GameName, players: Players, folders: Sequence[Path]) -> dict[str, Curves]:
    """Return each contender's curves of the episodes that have rows."""
    parts: dict[tuple[str, str], list[Curves]] = defaultdict(list)
    for folder in folders:
        for name, listed in curves.read(folder, game).items():
            parts[name] += listed
    by_contender = {}
    for name, runs in players.items():
        names = sorted(run.hashes for run in runs)
        own = [part for each in names for part in parts.get(each, [])]
        merged = curves.merged(own, {seed_of(row) for row in rows_of(runs)})
        if merged is not None:
            by_contender[name] = merged
    return by_contender
