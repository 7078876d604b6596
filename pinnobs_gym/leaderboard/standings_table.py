"""The table of each game, as text and as Markdown."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.leaderboard.grid import Column, Grid, Layouts
from pinnobs_gym.leaderboard.intervals import Interval
from pinnobs_gym.leaderboard.runs import ScoredRun
from pinnobs_gym.leaderboard.standings import Standing
from pinnobs_gym.scoring.rows import Row, game_of


@dataclass(frozen=True)
class Table:
    """The standings of one game, best first, online before offline."""

    game: GameName
    standings: tuple[Standing, ...]
    note: str = ""
    """Remarks on the table, possibly empty."""

    @property
    def title(self) -> str:
        """The game in words."""
        return ", ".join(self.game)


def tables(runs: Iterable[ScoredRun], failures: Iterable[Row] = ()) -> list[Table]:
    """Return a table per game, including games with failures only; failed jobs are in the notes."""
    played: dict[GameName, list[ScoredRun]] = defaultdict(list)
    for run in runs:
        played[run.game].append(run)
    failed: dict[GameName, list[str]] = defaultdict(list)
    for row in failures:
        failed[game_of(row)].append(_failed(row))
    games = sorted(played.keys() | failed.keys())
    return [table(game, played[game], failed[game]) for game in games]


def table(game: GameName, runs: Iterable[ScoredRun], notes: Sequence[str] = ()) -> Table:
    """Return the table of a game's runs, with notes. Within a track, estimators are sorted by
    median NRMSE over the whole episode, with diverged episodes as infinite."""
    runs = list(runs)
    standings = [run.standing for run in runs]
    standings.sort(key=lambda s: (s.track != "online", s.nrmse.value, s.tail.value))
    return Table(game, tuple(standings), " ".join(filter(None, [_uneven(runs), *notes])))


def _failed(row: Row) -> str:
    """Return a sentence about a failed job."""
    many = row["episodes"] > 1
    which = f"{row['episodes']} episodes" if many else f"episode {row['episode_seed']}"
    return f"Failed: {row['estimator']}, {which}: {row['error'].rstrip('.')}."


def _uneven(runs: Sequence[ScoredRun]) -> str:
    """Return a warning if estimators of one track were not run on the same episodes."""
    for track in dict.fromkeys(run.track for run in runs):
        episodes = {
            frozenset(row["episode_seed"] for row in run.rows) for run in runs if run.track == track
        }
        if len(episodes) > 1:
            return f"Not all {track} estimators were run on the same episodes: ranks are uncertain."
    return ""


Show: TypeAlias = Callable[[Interval], str]
"""How a number is shown: with or without its interval."""

COLUMNS: tuple[tuple[Column, Callable[[Standing, Show], str]], ...] = (
    (Column("track", 3, numeric=False), lambda s, _: s.track),
    (Column("episodes", 1), lambda s, _: str(s.episodes)),
    (Column("diverged %"), lambda s, show: show(s.diverged.percent)),
    (Column("settled s", 1), lambda s, _: number(s.settling.value)),
    (Column("NRMSE"), lambda s, show: show(s.nrmse)),
    (Column("tail NRMSE"), lambda s, show: _tail(s, show)),
    (Column("90th pct.", 3), lambda s, _: number(s.tail_90)),
    (Column("/ CRR", 3), lambda s, _: _optional(s.reference_ratio)),
    (Column("tail / CRR", 3), lambda s, _: _optional(s.reference_ratio_tail)),
    (Column("ANEES", 2), lambda s, _: _banded(s.anees)),
    (Column("covers %", 2), lambda s, _: _optional(_percent(s.coverage), 2)),
    (Column("NIS", 3), lambda s, _: _optional(s.nis)),
    (Column("corr.", 3), lambda s, _: _optional(s.innovation_correlation, 2)),
    (Column("µs/step", 3), lambda s, _: number(s.us_per_step)),
    (Column("knows", 4, numeric=False), lambda s, _: s.knows),
    (Column("training", 5, numeric=False), lambda s, _: s.training),
)
"""The columns of a table behind rank and name, and the text of each for a standing."""


def grid(table: Table, intervals: bool = True) -> Grid:
    """Return the table as text, with or without intervals, and a rule between the tracks."""
    show: Show = _interval if intervals else lambda interval: number(interval.value)
    ranks: dict[str, int] = defaultdict(int)
    lines = []
    for standing, name in zip(table.standings, names(table.standings), strict=True):
        ranks[standing.track] += 1
        shown = (cell(standing, show) for _, cell in COLUMNS)
        lines.append((str(ranks[standing.track]), name, *shown))
    columns = (Column("rank"), Column("estimator", numeric=False), *(c for c, _ in COLUMNS))
    blocks = track_blocks([standing.track for standing in table.standings])
    return Grid(table.title, columns, tuple(lines), blocks, table.note)


def layouts(table: Table) -> Layouts:
    """Return the table as text with intervals; where they do not fit, without them; and where that
    does not fit either, and lines become records, with intervals again."""
    whole, short = grid(table), grid(table, intervals=False)
    note = " ".join(filter(None, [short.note, "95 % intervals are not shown at this width."]))
    return ((whole,), (replace(short, note=note),), (whole,))


def track_blocks(tracks: Sequence[str]) -> tuple[int, ...]:
    """Return the indices of lines of these tracks, online first, before which a rule is drawn."""
    online = [track == "online" for track in tracks]
    return (online.index(False),) if not all(online) else ()


def names(standings: Iterable[Standing]) -> list[str]:
    """Return the names of the lines, with the training budget and, where that is not enough to tell
    them apart, the training seed."""
    standings = list(standings)
    named = [
        s.estimator if s.budget is None else f"{s.estimator}, {s.budget:g} s" for s in standings
    ]
    return [
        name if named.count(name) == 1 else f"{name}, seed {standing.seed}"
        for name, standing in zip(named, standings, strict=True)
    ]


def markdown(tables: Iterable[Table]) -> str:
    """Return the tables in Markdown."""
    return "\n\n".join(["# Each game", NOTE, *(grid(table).markdown() for table in tables)]) + "\n"


NOTE = (
    "Medians over episodes with 95 % intervals; NRMSE is the root mean squared error over the "
    "system's fixed scale, transient included, and tail NRMSE that over the last 25 %; an episode "
    "diverged if its tail NRMSE is above 0.2 or anything is not finite, and then scores infinity. "
    "Online estimators are causal; offline ones see the whole record first and are ranked apart. "
    "In brackets: modulo states that no output tells apart. Seconds behind a name are the CPU time "
    "that each training was given. / CRR: median NRMSE over the Cramér-Rao reference of the same "
    "episode, empty where there is none (the condition is not in the model, there is no noise, or "
    "the reference is below the error of a single step of the model). "
    "For those that give covariances, means over episodes: ANEES, which should be 1 (▲ above its "
    "95 % band: errors are larger than P says, ▼ below); how many errors the central 90 % interval "
    "covers; NIS, which should be 1; and the correlation of successive innovations, 0 if white."
)
"""Explanation of the tables."""


def number(value: float, digits: int = 3) -> str:
    """Format a score with this number of significant digits."""
    if not np.isfinite(value):
        return "∞"
    if abs(value) >= 10**digits:
        return f"{value:.0f}" if abs(value) < 1e5 else f"{value:.1e}"
    return f"{value:.{digits}g}"


def _optional(value: float | None, digits: int = 3) -> str:
    return "" if value is None else number(value, digits)


def _percent(part: float | None) -> float | None:
    return None if part is None else 100 * part


def _tail(s: Standing, show: Show) -> str:
    """Format the NRMSE over the last quarter, in brackets that modulo indistinguishable states if
    it differs."""
    tail = show(s.tail)
    if s.tail_modulo is not None and number(s.tail_modulo) != number(s.tail.value):
        tail += f" [{number(s.tail_modulo)}]"
    return tail


def _banded(value: Interval | None) -> str:
    """Format the value, marked if it is outside its band."""
    if value is None:
        return ""
    side = " ▲" if value.value > value.high else " ▼" if value.value < value.low else ""
    return number(value.value) + side


def _interval(interval: Interval) -> str:
    if interval.low == interval.high:
        return number(interval.value)
    return f"{number(interval.value)} ({number(interval.low, 2)}-{number(interval.high, 2)})"
