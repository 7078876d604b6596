"""The table of each game, as cells and as Markdown."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.leaderboard.contenders import WINDOWS, Contender, among
from pinnobs_gym.leaderboard.intervals import Interval
from pinnobs_gym.leaderboard.places import places
from pinnobs_gym.leaderboard.standings import Standing, is_identifiable
from pinnobs_gym.scoring.rows import Row, game_of


@dataclass(frozen=True)
class Entry:
    """One line of a table."""

    name: str
    standing: Standing
    ranks: Mapping[str, int | None]
    """Rank in each window within its track; None if it is not ranked."""


@dataclass(frozen=True)
class Table:
    """The standings of one game, best first, online before offline."""

    game: GameName
    entries: tuple[Entry, ...]
    note: str = ""
    """Remarks on the table, possibly empty."""

    @property
    def title(self) -> str:
        """The game in words."""
        return ", ".join(self.game)


def tables(contenders: Iterable[Contender], failures: Iterable[Row] = ()) -> list[Table]:
    """Return a table per game, including games with failures only; failed jobs are in the notes."""
    played: dict[GameName, list[Contender]] = defaultdict(list)
    for contender in contenders:
        for game in contender.games:
            played[game].append(contender)
    failed: dict[GameName, list[str]] = defaultdict(list)
    for row in failures:
        failed[game_of(row)].append(_failed(row))
    games = sorted(played.keys() | failed.keys())
    return [table(game, played[game], failed[game]) for game in games]


def table(game: GameName, contenders: Iterable[Contender], notes: Sequence[str] = ()) -> Table:
    """Return the table of a game with notes. Within a track, estimators are sorted by their rank in
    the steady window, those of one rank by their factor to the peer."""
    players = among(contenders, lambda run: run.game == game)
    found = places(players)
    entries = [
        Entry(each.name, each.standing(game), {w: found.rank(w, each.name) for w in WINDOWS})
        for each in players
    ]
    entries.sort(
        key=lambda e: (
            *(e.standing.track != "online", e.standing.track, *found.order(e.name)),
            e.standing.steady.value,
        )
    )
    own = [_uneven(players), _unidentifiable(players), *notes]
    return Table(game, tuple(entries), " ".join(filter(None, own)))


def _failed(row: Row) -> str:
    """Return a sentence about a failed job."""
    many = row["episodes"] > 1
    which = f"{row['episodes']} episodes" if many else f"episode {row['episode']}"
    return f"Failed: {row['estimator']}, {which}: {row['error'].rstrip('.')}."


def _uneven(players: Sequence[Contender]) -> str:
    """Return a warning if estimators of one track were not run on the same episodes."""
    for track in dict.fromkeys(player.track for player in players):
        own = [player for player in players if player.track == track]
        if len({frozenset(e.episodes) for player in own for e in player.errors.values()}) > 1:
            return (
                f"Not all {track} estimators were run on the same episodes: those that lack some "
                f"have no rank."
            )
    return ""


def _unidentifiable(players: Sequence[Contender]) -> str:
    """Return a remark if the states cannot be told from the outputs."""
    first = next((run.rows[0] for player in players for run in player.runs), None)
    if first is None or is_identifiable(first):
        return ""
    return (
        "Not identifiable, so that nothing is ranked: the outputs do not tell the states from the "
        "parameters that the condition changes, which enlarges the smallest error that can be "
        f"reached {number(first['free_over_known'], 2)} times."
    )


HEADER = (
    "",
    "estimator",
    "track",
    "episodes",
    "diverged %",
    "settled s",
    "NRMSE",
    "tail NRMSE",
    "90th pct.",
    "/ CRR",
    "tail / CRR",
    "ANEES",
    "covers %",
    "NIS",
    "corr.",
    "µs/step",
    "knows",
    "training",
)
"""The column headings of a table."""


def cells(table: Table, intervals: bool = True) -> list[list[str]]:
    """Return the table's rows as text, a cell per column of `HEADER`, with or without intervals."""
    lines, ranks = [], defaultdict(int)
    for standing, name in zip(table.standings, names(table.standings), strict=True):
        ranks[standing.track] += 1
        lines.append([str(ranks[standing.track]), name, *_cells(standing, intervals)])
    return lines


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


def _cells(s: Standing, intervals: bool) -> list[str]:
    """Return the cells of a standing, except its rank and name."""
    shown = _interval if intervals else lambda interval: number(interval.value)
    tail = shown(s.tail)
    if s.tail_modulo is not None and number(s.tail_modulo) != number(s.tail.value):
        tail += f" [{number(s.tail_modulo)}]"
    return [
        s.track,
        str(s.episodes),
        shown(s.diverged.percent),
        number(s.settling.value),
        shown(s.nrmse),
        tail,
        number(s.tail_90),
        _optional(s.reference_ratio),
        _optional(s.reference_ratio_tail),
        _banded(s.anees),
        _optional(None if s.coverage is None else 100 * s.coverage, 2),
        _optional(s.nis),
        _optional(s.innovation_correlation, 2),
        number(s.us_per_step),
        s.knows,
        s.training,
    ]


def markdown(tables: Iterable[Table]) -> str:
    """Return the tables in Markdown."""
    parts = ["# Each game\n", NOTE + "\n"]
    for table in tables:
        parts.append(f"\n## {markdown_text(table.title)}\n")
        parts.append(text_table(HEADER, cells(table)))
        parts += [f"\n{markdown_text(table.note)}"] if table.note else []
    return "\n".join(parts) + "\n"


def markdown_table(header: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Return one table in Markdown, of cells in Markdown."""
    rules = ["---"] * len(header)
    return "\n".join("| " + " | ".join(line) + " |" for line in (header, rules, *lines))


def text_table(header: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Return one table in Markdown, of cells that are text, whatever characters are in them."""
    return markdown_table(
        [markdown_text(cell) for cell in header],
        ([markdown_text(cell) for cell in line] for line in lines),
    )


def markdown_text(text: str) -> str:
    """Return text with the characters escaped that Markdown, HTML or a table would take for
    markup; brackets only where they could be a link."""
    text = re.sub(r"[\\`*<>|]", r"\\\g<0>", " ".join(text.split()))
    return re.sub(r"\](?=[(\[:])", r"\\]", text)


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
