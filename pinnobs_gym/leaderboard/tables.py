"""The standings of each game, with ranks and remarks."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.leaderboard.contenders import WINDOWS, Contender, among
from pinnobs_gym.leaderboard.floor import (
    NO_FLOORS,
    TRACKS,
    Floors,
    is_particles,
)
from pinnobs_gym.leaderboard.numerals import number
from pinnobs_gym.leaderboard.places import FEWEST, Places, places
from pinnobs_gym.leaderboard.standings import Standing, is_identifiable, standing
from pinnobs_gym.scoring.exact_bayes import LEAST_ESS
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
    floor: tuple[Entry, ...] = ()
    """The floor of errors, for online and for offline estimators, on the episodes that any of the
    estimators played; it has no ranks."""

    @property
    def lines(self) -> tuple[Entry, ...]:
        """All lines: estimators, and below them the floor."""
        return self.entries + self.floor

    @property
    def title(self) -> str:
        """The game in words."""
        return ", ".join(self.game)


def tables(
    contenders: Iterable[Contender], failures: Iterable[Row] = (), floors: Floors = NO_FLOORS
) -> list[Table]:
    """Return a table per game, including games with failures or a floor only; failed jobs are in
    the notes."""
    played: dict[GameName, list[Contender]] = defaultdict(list)
    for contender in contenders:
        for game in contender.games:
            played[game].append(contender)
    failed: dict[GameName, list[str]] = defaultdict(list)
    for row in failures:
        failed[game_of(row)].append(_failed(row))
    games = sorted(played.keys() | failed.keys() | floors.games)
    return [table(game, played[game], failed[game], floors) for game in games]


def table(
    game: GameName,
    contenders: Iterable[Contender],
    notes: Sequence[str] = (),
    floors: Floors = NO_FLOORS,
) -> Table:
    """Return the table of a game with notes and its floor. Within a track, estimators are sorted by
    their rank in the steady window, those of one rank by their factor to the peer."""
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
    rows = _floor_rows(game, players, floors)
    own = [_uneven(players), _unranked(players, found), *notes, _floor_note(rows)]
    return Table(game, tuple(entries), " ".join(filter(None, own)), _floor_entries(rows))


def _floor_rows(game: GameName, players: Sequence[Contender], floors: Floors) -> list[Row]:
    """Return the rows of a game's floors, of the episodes that any of the contenders played, or of
    all if none did."""
    played = {row["episode"] for player in players for run in player.runs for row in run.rows}
    own = [floors.by_game[game, track] for track in TRACKS if (game, track) in floors.by_game]
    return [row for floor in own for row in floor.among(played or floor.rows)]


def _floor_entries(rows: Sequence[Row]) -> tuple[Entry, ...]:
    """Return a line per floor."""
    named: dict[tuple[str, str], list[Row]] = defaultdict(list)
    for row in rows:
        named[row["track"], row["estimator"]].append(row)
    unranked: dict[str, int | None] = dict.fromkeys(WINDOWS)
    return tuple(Entry(name, standing(own), unranked) for (_, name), own in named.items())


def _floor_note(rows: Sequence[Row]) -> str:
    """Return how precise the floors are."""
    parts = []
    exact = [row for row in rows if not is_particles(row)]
    sizes = [row["effective_sample_size"] for row in exact if row.get("effective_sample_size")]
    if exact:
        least = min(sizes, default=0.0)
        few = f", fewer than the {LEAST_ESS:.0f} that make it exact"
        counted = f"at least {number(least)} effective draws{few if least < LEAST_ESS else ''}"
        parts.append(f"Floor: exact Bayes, with {counted if sizes else 'unknown precision'}.")
    particles = [row for row in rows if is_particles(row)]
    errors = [row["monte_carlo"] for row in particles if row.get("monte_carlo") is not None]
    if particles:
        size = f"at most {number(100 * max(errors), 2)} %" if errors else "unknown"
        parts.append(
            "Floor: a particle reference in place of exact Bayes; the Monte-Carlo standard error "
            f"of its RMS is {size} in an episode."
        )
    return " ".join(parts)


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
