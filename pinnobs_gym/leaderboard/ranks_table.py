"""The tables across systems and conditions, as text and as Markdown."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.leaderboard.contenders import PEER, label
from pinnobs_gym.leaderboard.grid import Column, Grid, Layouts, text_table
from pinnobs_gym.leaderboard.intervals import Interval
from pinnobs_gym.leaderboard.ranks import Line
from pinnobs_gym.leaderboard.standings import Standing
from pinnobs_gym.leaderboard.standings_table import number, track_blocks

NOTE = (
    "Median NRMSE over the whole episode, under the condition that a system is ranked under; `div` "
    "is the part of the episodes that diverged, which score infinity. Lines stand in the order of "
    "`/ ekf`: the interquartile mean over all systems and episodes of log(NRMSE / the EKF's on the "
    "same episode), as a factor, with its 95 % bootstrap interval. Infinite scores count: they are "
    "trimmed only as part of the highest quarter. `better` is the part of the episodes with a "
    "smaller NRMSE than the EKF's. Offline estimators see the whole record first."
)
"""Explanation of the overview."""
TITLE = "Across systems"
ACROSS: tuple[tuple[Column, Callable[[Line], str]], ...] = (
    (Column("estimator", numeric=False), lambda line: line.estimator),
    (Column("track", 2, numeric=False), lambda line: line.track),
    (Column(f"/ {PEER}"), lambda line: "" if line.ratio is None else _factor(line.ratio)),
    (Column("better", 1), lambda line: _better(line)),
    (Column("µs/step", 3), lambda line: number(line.us_per_step, 2)),
    (Column("knows", 4, numeric=False), lambda line: line.knows),
)
"""The columns of the overview that are about all games, and the text of each for a line; those of
games stand behind the fourth."""
OF_GAME: tuple[tuple[Column, Callable[[Standing], str]], ...] = (
    (Column("NRMSE"), lambda s: number(s.nrmse.value)),
    (Column("diverged %"), lambda s: number(s.diverged.percent.value)),
    (Column("µs/step", 1), lambda s: number(s.us_per_step, 2)),
)
"""The columns of one game in an overview that has a table per game."""


def grid(found: Sequence[Line]) -> Grid:
    """Return the overview as text, with a column per game that is never dropped."""
    games = _games(found)
    before, after = ACROSS[:4], ACROSS[4:]
    columns = (
        *(column for column, _ in before),
        *(Column(label(game)) for game in games),
        *(column for column, _ in after),
    )
    lines = tuple(
        (
            *(cell(line) for _, cell in before),
            *(_of_game(line.games.get(game)) for game in games),
            *(cell(line) for _, cell in after),
        )
        for line in found
    )
    return Grid(TITLE, columns, lines, track_blocks([line.track for line in found]))


def layouts(found: Sequence[Line]) -> Layouts:
    """Return the overview with a column per game and, where that does not fit, as a table across
    games followed by one of each game."""
    across = Grid(
        TITLE,
        tuple(column for column, _ in ACROSS),
        tuple(tuple(cell(line) for _, cell in ACROSS) for line in found),
        track_blocks([line.track for line in found]),
    )
    return ((grid(found),), (across, *(_game(game, found) for game in _games(found))))


def _games(found: Sequence[Line]) -> list[GameName]:
    return sorted({game for line in found for game in line.games}, key=label)


def _game(game: GameName, found: Sequence[Line]) -> Grid:
    """Return the overview's lines of one game, of the estimators that played it."""
    played = [line for line in found if game in line.games]
    return Grid(
        label(game),
        (Column("estimator", numeric=False), *(column for column, _ in OF_GAME)),
        tuple((x.estimator, *(cell(x.games[game]) for _, cell in OF_GAME)) for x in played),
        track_blocks([line.track for line in played]),
    )


def rank_grid(found: Mapping[str, Mapping[str, int]]) -> Grid:
    """Return the table of ranks as text: a column per estimator, sorted by worst rank, a line per
    condition, and a last line with the worst rank."""
    worst = _worst(found)
    columns = (Column("condition", numeric=False), *map(Column, worst))
    lines = [
        (condition, *(str(placed.get(name, "")) for name in worst))
        for condition, placed in found.items()
    ]
    lines.append(("worst", *map(str, worst.values())))
    return Grid("Ranks", columns, tuple(lines), (len(lines) - 1,))


def rank_layouts(found: Mapping[str, Mapping[str, int]]) -> Layouts:
    """Return the table of ranks with a column per estimator and, where that does not fit, with a
    line per estimator, in which the last conditions are dropped first."""
    columns = (
        Column("estimator", numeric=False),
        Column("worst"),
        *(Column(condition, 1 + i) for i, condition in enumerate(found)),
    )
    lines = tuple(
        (name, str(rank), *(str(placed.get(name, "")) for placed in found.values()))
        for name, rank in _worst(found).items()
    )
    return ((rank_grid(found),), (Grid("Ranks", columns, lines),))


def _worst(found: Mapping[str, Mapping[str, int]]) -> dict[str, int]:
    """Return the worst rank of each estimator, in the order of these."""
    worst: dict[str, int] = {}
    total: dict[str, int] = defaultdict(int)
    for placed in found.values():
        for name, rank in placed.items():
            worst[name] = max(worst.get(name, 0), rank)
            total[name] += rank
    order = sorted(worst, key=lambda name: (worst[name], total[name]))
    return {name: worst[name] for name in order}


RANK_NOTE = (
    "Rank of each online estimator under every condition, by the same interquartile mean; of those "
    "alone that played every system that the EKF did. Estimators stand in the order of their worst "
    "rank."
)
"""Explanation of the table of ranks."""


def markdown(found: Sequence[Line], placed: Mapping[str, Mapping[str, int]]) -> str:
    """Return the overview of `lines` in Markdown, followed by the table of `ranks` if it has
    several conditions."""
    overview = grid(found)
    parts = ["# Leaderboard\n", NOTE, "", text_table(overview.header, overview.lines), ""]
    if len(placed) > 1:
        ranks = rank_grid(placed)
        parts += ["# Conditions\n", RANK_NOTE, "", text_table(ranks.header, ranks.lines), ""]
    return "\n".join(parts) + "\n"


def _of_game(s: Standing | None) -> str:
    if s is None:
        return ""
    lost = f"div {s.diverged.percent.value:.0f} %" if s.diverged.value else ""
    median = number(s.nrmse.value) if np.isfinite(s.nrmse.value) else ""
    return ", ".join(filter(None, [median, lost]))


def _better(line: Line) -> str:
    return "" if line.better is None else f"{100 * line.better.value:.0f} %"


def _factor(ratio: Interval) -> str:
    if np.isnan(ratio.value):
        return "?"
    return f"{number(ratio.value, 2)} ({number(ratio.low, 2)}-{number(ratio.high, 2)})"
