"""The content of the page for each game, from runs and curves."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.leaderboard.contenders import Contender
from pinnobs_gym.leaderboard.runs import ScoredRun, rows_of
from pinnobs_gym.leaderboard.site.columns import Columns
from pinnobs_gym.leaderboard.site.over_episodes import ratios, settling
from pinnobs_gym.leaderboard.site.over_samples import States, errors, reference, states
from pinnobs_gym.leaderboard.standings_table import Table
from pinnobs_gym.scoring import curves
from pinnobs_gym.scoring.curves import Curves
from pinnobs_gym.scoring.rows import seed_of

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
    """``t`` and the ``median`` over episodes of the error expected at the Cramér-Rao reference."""
    states: States | None
    """The example episode; None without curves."""


def games_of(
    contenders: Iterable[Contender], tables: Iterable[Table], folders: Sequence[Path]
) -> list[GameResults]:
    """Return the results of the games in a system's ranked condition, and of nominal games after
    them.

    Args:
        contenders: in the order of the charts.
        tables: of all games.
        folders: folders with their curves.

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
        _results(number, known[game], played[game], folders) for number, game in enumerate(order)
    ]


def _results(number: int, table: Table, players: Players, folders: Sequence[Path]) -> GameResults:
    game = table.game
    own = _curves(game, players, folders)
    rows = {name: rows_of(runs) for name, runs in players.items()}
    return GameResults(
        number=number,
        game=game,
        table=table,
        settling=settling(rows),
        ratios=ratios(rows),
        errors=errors(own),
        reference=reference(own.values()),
        states=states(own),
    )


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
