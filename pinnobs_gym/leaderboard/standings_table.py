"""The table of each game, as text."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from string import ascii_lowercase
from typing import TypeAlias

from pinnobs_gym.leaderboard.grid import Column, Grid, Layouts
from pinnobs_gym.leaderboard.intervals import Interval
from pinnobs_gym.leaderboard.numerals import interval_text, number, optional
from pinnobs_gym.leaderboard.places import FAR
from pinnobs_gym.leaderboard.standings import Standing
from pinnobs_gym.leaderboard.tables import Entry, Table

Show: TypeAlias = Callable[[Interval], str]
"""How a number is shown: with or without its interval."""

COLUMNS: tuple[tuple[Column, Callable[[Entry, Show], str]], ...] = (
    (Column("rank"), lambda e, _: _rank(e.ranks["steady"])),
    (Column("estimator", numeric=False), lambda e, _: e.name),
    (Column("steady"), lambda e, show: _steady(e.standing, show)),
    (Column("/ Bayes", 2), lambda e, show: over_floor_text(e.standing.over_floor_steady, show)),
    (Column("transient rank", 4), lambda e, _: _rank(e.ranks["transient"])),
    (Column("transient", 2), lambda e, show: show(e.standing.transient)),
    (
        Column("transient / Bayes", 4),
        lambda e, show: over_floor_text(e.standing.over_floor_transient, show),
    ),
    (Column("diverged %", 1), lambda e, show: show(e.standing.diverged.percent)),
    (Column("settled s", 5), lambda e, _: number(e.standing.settling.value)),
    (Column("track", 3, numeric=False), lambda e, _: e.standing.track),
    (Column("episodes", 5), lambda e, _: _episodes(e.standing)),
    (Column("/ CRR", 6), lambda e, _: optional(e.standing.over_reference)),
    (Column("ANEES", 6), lambda e, _: _banded(e.standing.anees)),
    (Column("covers %", 6), lambda e, _: optional(_percent(e.standing.coverage), 2)),
    (Column("90th pct.", 8), lambda e, _: number(e.standing.steady_90)),
    (Column("first", 9), lambda e, _: number(e.standing.first)),
    (Column("whole", 8), lambda e, _: number(e.standing.whole)),
    (Column("last 75 %", 9), lambda e, _: number(e.standing.late)),
    (Column("last 25 %", 9), lambda e, _: number(e.standing.tail)),
    (Column("NIS", 8), lambda e, _: optional(e.standing.nis)),
    (Column("corr.", 8), lambda e, _: optional(e.standing.innovation_correlation, 2)),
    (Column("µs/step", 7), lambda e, _: optional(e.standing.us_per_step)),
    (Column("knows", numeric=False), lambda e, _: ", ".join(e.standing.knows)),
    (Column("training", 10, numeric=False), lambda e, _: e.standing.training),
)
"""The columns of a table, and the text of each for a line."""


def grid(table: Table, intervals: bool = True) -> Grid:
    """Return the table as text, with or without intervals, and a rule between the tracks and before
    the floor."""
    show: Show = interval_text if intervals else lambda interval: number(interval.value)
    lines = tuple(tuple(cell(entry, show) for _, cell in COLUMNS) for entry in table.lines)
    columns = tuple(
        column if any(line[i] for line in lines) or not column.priority else _emptied(column)
        for i, (column, _) in enumerate(COLUMNS)
    )
    tracks = [*(entry.standing.track for entry in table.entries), *("floor" for _ in table.floor)]
    return Grid(table.title, columns, lines, track_blocks(tracks), table.note)


def _emptied(column: Column) -> Column:
    """Return a column without any text in its cells, the first to be dropped."""
    return replace(column, priority=max(other.priority for other, _ in COLUMNS) + 1)


def layouts(table: Table) -> Layouts:
    """Return the table as text with intervals; where they do not fit, without them and with letters
    for what estimators know; and where that does not fit either, and lines become records, with
    intervals again."""
    whole = grid(table)
    known = [entry.standing.knows for entry in table.lines]
    short = with_letters(grid(table, intervals=False), known, facts_of(known))
    note = " ".join(filter(None, [short.note, "95 % intervals are not shown at this width."]))
    return ((whole,), (replace(short, note=note),), (whole,))


def facts_of(known: Iterable[Sequence[str]]) -> list[str]:
    """Return what any of some estimators knows, in the order in which it first appears."""
    return list(dict.fromkeys(fact for facts in known for fact in facts))


def with_letters(grid: Grid, known: Sequence[Sequence[str]], facts: Sequence[str]) -> Grid:
    """Return a table in which letters stand for what each line's estimator knows, with a legend.

    Args:
        grid: a table with a column ``knows``.
        known: what the estimator of each line knows.
        facts: what the letters stand for, in the order of the alphabet; tables that are shown
            together have the same. If there are more than letters, the table stays as it is.
    """
    if len(facts) > len(ascii_lowercase):
        return grid
    letters = dict(zip(facts, ascii_lowercase, strict=False))
    place = grid.header.index("knows")
    lines = tuple(
        (*line[:place], "".join(letters[fact] for fact in own), *line[place + 1 :])
        for line, own in zip(grid.lines, known, strict=True)
    )
    used = facts_of(known)
    legend = ", ".join(f"{letters[fact]} {fact}" for fact in facts if fact in used)
    note = " ".join(filter(None, [f"knows: {legend}." if legend else "", grid.note]))
    return replace(grid, lines=lines, note=note)


def track_blocks(tracks: Sequence[str]) -> tuple[int, ...]:
    """Return the indices of lines before which a rule is drawn: where another track begins."""
    return tuple(i for i in range(1, len(tracks)) if tracks[i] != tracks[i - 1])


NOTE = (
    "Medians over episodes with 95 % intervals; of fewer than six episodes, the interval of a "
    "median is their whole range. NRMSE is the root mean squared error over the system's fixed "
    "scale: transient from the second sample to a time that is fixed for each system, steady over "
    "all later ones, and also of the first sample, the whole episode, its last 75 % and its last "
    "25 %. Lines stand in the order of the steady rank. Estimators of one rank cannot be told "
    "apart: none is significantly worse than the best of them (5 % for each group). Diverging "
    "significantly more often outranks a smaller error. An episode diverged if the NRMSE of its "
    "last 25 % is above 0.2 or anything is not finite; its medians count it as infinite, "
    "comparisons as an error of the whole scale or more. 5 × 100 are 100 episodes of each of five "
    "trainings, and the total is given where trainings played different ones; a single training "
    "says nothing about how much trainings differ. One that cannot be told from the best of a rank "
    f"although its error is over {FAR:g} times as large has no rank: its trainings or episodes are "
    "too few for how widely they differ. Online estimators are causal; offline ones see "
    "the whole record first and are ranked apart, as are those that were trained under the very "
    "condition that is scored; a rule stands between tracks. Submitted estimates were made "
    "elsewhere from the records: what they know and whether they are causal is what their author "
    "says and cannot be checked, so that they are ranked apart, too; their cost is not known. "
    "`initial set`: the estimator knows the set that initial states are drawn from, beyond its "
    "mean and covariance, which all are given. `tuned`: its settings were searched on nominal "
    "episodes that are never scored. In brackets: modulo states that no output tells apart. "
    "Seconds behind a name are the "
    "CPU time that each training was given. / CRR: root mean square over episodes of the steady "
    "NRMSE, over that of the Cramér-Rao reference of the same episodes; empty where there is none "
    "(the condition is not in the model, there is no noise, or the reference is below the error of "
    "a single step of the model). / Bayes: root mean square over episodes of the NRMSE, in the "
    "steady window modulo states that no output tells apart, over that of the floor on the same "
    "episodes, with its 95 % interval; diverged episodes count with their own errors, and fewer "
    "than ten common ones give no ratio. The floor, in lines of its own at the end, is exact "
    "Bayes, the mean of the posterior under the law that makes the episodes, whatever estimators "
    "are told: filtered for online estimators, smoothed for offline ones; with process noise it is "
    "a particle reference. It bounds mean squares over that law, not medians: below 1 beyond the "
    "interval (▼) is chance, or the estimator knows more. For those that give covariances, means "
    "over episodes: ANEES, which should be 1 (▲ above its 95 % band: errors are larger than P "
    "says, ▼ below); how many errors the central 90 % interval covers; NIS, which should be 1; and "
    "the correlation of successive innovations, 0 if white. The samples of an episode depend on "
    "each other, so that over few episodes even the ANEES of the floor, whose covariances are "
    "right, is off 1: compare with it."
)
"""Explanation of the tables."""


def over_floor_text(ratio: Interval | None, show: Show) -> str:
    """Format a ratio to the floor, marked if it is below 1 beyond its interval; empty if there is
    none."""
    if ratio is None:
        return ""
    return show(ratio) + (" ▼" if ratio.high < 1 else "")


def _percent(part: float | None) -> float | None:
    return None if part is None else 100 * part


def _rank(rank: int | None) -> str:
    return "" if rank is None else str(rank)


def _episodes(s: Standing) -> str:
    """Format the number of episodes of each training; the total where they differ."""
    if s.trainings == 1:
        return str(s.episodes)
    if s.scored == s.trainings * s.episodes:
        return f"{s.trainings} × {s.episodes}"
    return f"{s.scored}, {s.trainings} trainings"


def _steady(s: Standing, show: Show) -> str:
    """Format the NRMSE over the steady window, in brackets that modulo indistinguishable states if
    it differs."""
    steady = show(s.steady)
    if s.steady_modulo is not None and number(s.steady_modulo) != number(s.steady.value):
        steady += f" [{number(s.steady_modulo)}]"
    return steady


def _banded(value: Interval | None) -> str:
    """Format the value, marked if it is outside its band."""
    if value is None:
        return ""
    side = " ▲" if value.value > value.high else " ▼" if value.value < value.low else ""
    return number(value.value) + side
