"""One estimator among stored scores of others, on the same episodes of one game."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pinnobs_gym.envs.game import AnyGame, GameName
from pinnobs_gym.leaderboard.board import board
from pinnobs_gym.leaderboard.escapes import quoted
from pinnobs_gym.leaderboard.published import reading
from pinnobs_gym.leaderboard.published.reading import published_floors
from pinnobs_gym.leaderboard.tables import Table
from pinnobs_gym.scoring import rows
from pinnobs_gym.scoring.log_game import LOG_SETUP
from pinnobs_gym.scoring.provenance import game_hash
from pinnobs_gym.scoring.rows import Row, Stored

_SHOWN = 6
"""Number of characters of a hash that are shown."""


@dataclass(frozen=True)
class Opponents:
    """The stored scores of one game that others are compared with."""

    path: Path
    """The rows file, or ``published``."""
    source: str
    """Where they come from, in words."""
    rows: list[Row]
    """The scored episodes, at least one."""


@dataclass(frozen=True)
class Comparison:
    """An estimator among its opponents."""

    table: Table
    """The standings on the episodes that both have."""
    summary: str
    """The ranks of the estimator, in a sentence."""


def opponents(source: Path, game: AnyGame, seeds: Sequence[int]) -> Opponents:
    """Return the stored scores of a game with which those of some episodes can be compared.

    Args:
        source: a rows file, or ``published`` for the rows that ship with the package.
        game: the game.
        seeds: of the episodes that are compared.

    Raises:
        ValueError: in one line, if there are none: none of this game, none of its present code, or
            none of these episodes.
    """
    name = game.name
    if source == reading.PUBLISHED:
        published = reading.present()
        where = f"the rows published on {published.date[:10]}"
        # What other games there are is told without reading their rows.
        games = {entry.game for entry in published.rows}
        stored = reading.rows_in(published, [e for e in published.rows if e.game == name])
    else:
        where = str(source)
        stored = rows.load_all([source]).rows
        games = {rows.game_of(row) for row in stored}
    own = [row for row in stored if rows.game_of(row) == name]
    if not own:
        raise ValueError(f"{where}: no scores of {', '.join(name)}; {_known(games, name)}")
    present = game_hash(game.source)
    comparable = [row for row in own if row["game_hash"] == present]
    if not comparable:
        found = " and ".join(sorted({row["game_hash"][:_SHOWN] for row in own}))
        raise ValueError(
            f"{where}: the scores of {', '.join(name)} are of other code or settings of the game "
            f"(hash {found}) than the present ones ({present[:_SHOWN]}), so that they cannot be "
            f"compared; make new ones by {_command(game)}"
        )
    wanted = set(map(rows.episode_of, seeds))
    common = [row for row in comparable if row["episode"] in wanted]
    if not common and name.setup == LOG_SETUP:
        files = ", ".join(dict.fromkeys(row["log"] for row in comparable))
        raise ValueError(
            f"{where}: no scores of these logs with these references; it has those of {files}, as "
            "they were read then"
        )
    if not common:
        numbers = [rows.seed_of(row) for row in comparable]
        raise ValueError(
            f"{where}: no scores of the episodes of seeds {seeds[0]} to {seeds[-1]}; it "
            f"has those of {min(numbers)} to {max(numbers)}"
        )
    return Opponents(source, where, common)


def compare(own: Sequence[Row], others: Opponents) -> Comparison:
    """Return the standings of an estimator among others on the episodes that both have.

    Args:
        own: the scored episodes of one estimator in the game of the others.
        others: the scores to compare with.
    """
    played = {row["episode"] for row in others.rows}
    mine = [row for row in own if row["episode"] in played]
    keys = set(map(rows.key, mine))
    both = [*mine, *(row for row in others.rows if rows.key(row) not in keys)]
    games = {rows.game_of(row) for row in mine}
    results = board(Stored(both, []), published_floors(games))
    per_record = bool(mine[0]["training"].get("per_record"))
    part = results.on_record if per_record and results.on_record is not None else results.main
    (table,) = part.tables
    hashes = mine[0]["game_hash"], mine[0]["estimator_hash"]
    (name,) = {each.name for each in part.contenders for run in each.runs if run.hashes == hashes}
    return Comparison(table, _summary(table, name, len(mine), len(own), others.source))


def _summary(table: Table, name: str, common: int, played: int, source: str) -> str:
    """Return the ranks of an estimator in a sentence, and with what it was compared."""
    (own,) = (entry for entry in table.entries if entry.name == name)
    track = own.standing.track
    count = sum(entry.standing.track == track for entry in table.entries)
    ranks = [f"{rank} ({window})" for window, rank in own.ranks.items() if rank is not None]
    placed = f"rank {' and '.join(ranks)}" if ranks else "no rank"
    episodes = f"{common} episodes" if common == played else f"the {common} of {played} episodes"
    return f"{name}: {placed} of {count} estimators of the track {track}, on {episodes} of {source}"


def _known(games: set[GameName], name: GameName) -> str:
    """Return in words of which games of a system there are scores; if of none, of which systems."""
    own = [", ".join(game[1:]) for game in sorted(games) if game.env_id == name.env_id]
    if own:
        return f"of this system there are those of {'; '.join(own)}"
    systems = sorted({game.system for game in games})
    return f"there are those of {', '.join(systems) or 'no system'}"


def _command(game: AnyGame) -> str:
    """Return the command that scores every estimator in a game, or an estimator on logs."""
    if game.name.setup == LOG_SETUP:
        return "pinnobs evaluate with each estimator, and the same noise and prior"
    cls, setup, condition = type(game.source.system), game.name.setup, game.name.condition
    own = game.name.env_id.removeprefix("pinnobs/").rpartition("-v")[0]
    inside = cls.__module__.startswith("pinnobs_gym.systems.")
    system = own if inside else f"{cls.__module__}:{cls.__qualname__}"
    options = "" if setup == "benchmark" else f" --setup {quoted(setup)}"
    options += "" if condition == "nominal" else f" --condition {quoted(condition)}"
    return f"pinnobs leaderboard --systems {quoted(system)}{options}, and name its rows file"
