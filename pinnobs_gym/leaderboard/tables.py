"""The standings of each game, with ranks and remarks."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.leaderboard.contenders import WINDOWS, Contender, among
from pinnobs_gym.leaderboard.numerals import number
from pinnobs_gym.leaderboard.places import FEWEST, Places, places
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
    own = [_uneven(players), _unranked(players, found), *notes]
    return Table(game, tuple(entries), " ".join(filter(None, own)))


def _failed(row: Row) -> str:
    """Return a sentence about a failed job."""
    many = row["episodes"] > 1
    which = f"{row['episodes']} episodes" if many else row["episode"]
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


def _unranked(players: Sequence[Contender], found: Places) -> str:
    """Return why nothing is ranked; empty if something is or nobody played."""
    first = next((run.rows[0] for player in players for run in player.runs), None)
    if first is None:
        return ""
    if not is_identifiable(first):
        return (
            "Not identifiable, so that nothing is ranked: the outputs do not tell the states from "
            "what the condition changes. Not knowing it makes the smallest error that can be "
            f"reached {number(first['free_over_known'], 2)} times as large, and a filter that "
            f"ignores the change has {first['nominal_over_free']:.1f} times this error."
        )
    if not found.peer:
        return "Nothing is ranked: no online estimator was played, with which others are compared."
    if found.too_few:
        return (
            f"Nothing is ranked: fewer than {FEWEST} episodes under a condition other than nominal "
            "and that which the system is ranked under."
        )
    if not found.windows["steady"]:
        return f"Nothing is ranked: the trainings of {found.peer} have no episode in common."
    return ""
