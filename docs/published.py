"""The published scores, as tables on the pages of systems and estimators."""

from __future__ import annotations

from functools import lru_cache

from pinnobs_gym.envs.game import Game, GameName
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.leaderboard.board import Board, board
from pinnobs_gym.leaderboard.grid import markdown_table
from pinnobs_gym.leaderboard.numerals import number, optional
from pinnobs_gym.leaderboard.published.reading import PUBLISHED, load_rows
from pinnobs_gym.leaderboard.site.method import dates
from pinnobs_gym.leaderboard.tables import Entry, Table
from pinnobs_gym.scoring.provenance import estimator_code, game_hash
from pinnobs_gym.scoring.rows import Row, game_of
from pinnobs_gym.simulation.system import System
from pinnobs_gym.systems import SYSTEMS

NUMBERS = ("rank", "steady NRMSE", "transient NRMSE", "diverged %", "settled (s)", "µs/step")
"""The columns of a table beside its names."""


@lru_cache(maxsize=1)
def _published() -> tuple[Board, list[Row]]:
    rows = load_rows((PUBLISHED,))
    return board(rows), rows.rows


def scores_of_estimator(name: str) -> str:
    """Return an estimator's published scores in the condition that each system is ranked under,
    with a heading; empty if there are none."""
    own = [
        (table, entry)
        for table in _ranked()
        for entry in table.entries
        if _base(entry.standing.estimator) == name
    ]
    named = any(entry.name != name for _, entry in own)
    lines = [
        (
            f"[{_system(table)}](../systems/{_system(table)}.md)",
            *((entry.name,) if named else ()),
            f"`{table.game.condition}`",
            *_cells(entry),
        )
        for table, entry in own
    ]
    rows = [row for row in _published()[1] if _base(row["estimator"]) == name]
    header = ("system", *(("as",) if named else ()), "condition", *NUMBERS)
    return _section(header, lines, rows)


def scores_on_system(cls: type[System]) -> str:
    """Return the published scores of all estimators on a system in the condition that it is ranked
    under, best first, with a heading; empty if there are none."""
    own = [table for table in _ranked() if _system(table) == cls.__name__]
    lines = [
        (_link(entry), entry.standing.track, *_cells(entry))
        for table in own
        for entry in table.entries
    ]
    games = {table.game for table in own}
    rows = [row for row in _published()[1] if game_of(row) in games]
    return _section(("estimator", "track", *NUMBERS), lines, rows)


def _ranked() -> list[Table]:
    """Return the tables of the benchmark in the condition that each system is ranked under."""
    known = {f"pinnobs/{name}-v{cls.version}": cls for name, cls in SYSTEMS.classes().items()}
    return [
        table
        for table in _published()[0].main.tables
        if (cls := known.get(table.game.env_id)) is not None
        and table.game.setup == "benchmark"
        and table.game.condition == cls.ranked_condition
    ]


def _section(header: tuple[str, ...], lines: list[tuple[str, ...]], rows: list[Row]) -> str:
    if not lines:
        return ""
    said = (
        f"Medians over the episodes of the [published results](../../guides/published.md), run on "
        f"{dates(rows)}; the [metrics](../metrics.md) say what they are, and "
        "`pinnobs tables published` prints them with their intervals."
    )
    if not _is_present(rows):
        said += (
            " **They are of earlier code**: a system, an estimator, the simulation or the scores "
            "have been edited since, and `make publish` has not renewed them yet."
        )
    return f"\n## Published scores\n\n{said}\n\n{markdown_table(header, lines)}\n"


def _is_present(rows: list[Row]) -> bool:
    """Return whether all of these rows are of the present code."""
    played = {(_base(row["estimator"]), row["estimator_code"]) for row in rows}
    games = {(game_of(row), row["game_hash"]) for row in rows}
    return all(code == _code(name) for name, code in played) and all(
        own == _hash(game) for game, own in games
    )


@lru_cache
def _code(name: str) -> str:
    known = ESTIMATORS.classes().get(name)
    return "" if known is None else estimator_code(known)


@lru_cache
def _hash(game: GameName) -> str:
    return game_hash(Game.of(game.env_id, game.setup, game.condition).source)


def _system(table: Table) -> str:
    return table.game.env_id.removeprefix("pinnobs/").rpartition("-v")[0]


def _base(label: str) -> str:
    """Return the name of an estimator, without its recipe and whether it is tuned."""
    return label.partition(" (")[0].partition(",")[0]


def _link(entry: Entry) -> str:
    name = _base(entry.standing.estimator)
    known = name in ESTIMATORS.sources
    return f"[{entry.name}](../estimators/{name}.md)" if known else entry.name


def _cells(entry: Entry) -> tuple[str, ...]:
    own, rank = entry.standing, entry.ranks["steady"]
    return (
        "" if rank is None else str(rank),
        number(own.steady.value),
        number(own.transient.value),
        number(own.diverged.percent.value, 2),
        number(own.settling.value),
        optional(own.us_per_step, 2),
    )
