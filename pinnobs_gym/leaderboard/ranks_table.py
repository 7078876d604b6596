"""The tables across systems and conditions, as text."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.leaderboard.applicable import cell_without_scores
from pinnobs_gym.leaderboard.contenders import label
from pinnobs_gym.leaderboard.grid import Column, Grid, Layouts
from pinnobs_gym.leaderboard.numerals import interval_text, number, optional
from pinnobs_gym.leaderboard.places import FAR, FEWEST, Place, Places
from pinnobs_gym.leaderboard.ranks import Line, worst_ranks
from pinnobs_gym.leaderboard.standings import Standing
from pinnobs_gym.leaderboard.standings_table import (
    facts_of,
    over_floor_text,
    track_blocks,
    with_letters,
)

NOTE = (
    "Under the condition that each system is ranked under. The factor is the error over the "
    "peer's: per system the interquartile mean over trainings and episodes of log(NRMSE / the "
    "peer's on the same episode), then the geometric mean over systems, with its 95 % interval "
    "from trainings and episodes. Lines stand in the order of the rank in the steady window. "
    "Estimators of one rank cannot be told apart: none is significantly worse than the best of "
    "them (5 % for each group). Diverging significantly more often outranks a smaller error; in "
    "the factors a diverged episode counts as an error of the whole scale or more. Columns of "
    "systems have the median steady NRMSE and, as `div`, how many episodes diverged; `diverged %` "
    "is the mean over systems. (0–∞): too few episodes for an interval. Without a rank are those "
    "that did not play every episode that the peer played or, under another condition than nominal "
    f"and that which the system is ranked under, fewer than {FEWEST}, and those that cannot be "
    f"told from the best of a rank although their error is over {FAR:g} times as large: too few "
    "trainings or episodes for how widely they differ. A rule stands between tracks."
)
"""Explanation of the overview."""
RANK_NOTE = (
    "Rank of each online estimator in the steady window under every condition, over all systems; "
    "of those alone that played all that the peer did. Estimators stand in the order of their "
    "worst rank."
)
"""Explanation of the table of ranks."""
TITLE = "Across systems"
AT_ONCE = (5, 3, 1)
"""Conditions in one table of ranks where not all fit: the most for which there is room."""
OF_GAME: tuple[tuple[Column, Callable[[Standing], str]], ...] = (
    (Column("steady"), lambda s: number(s.steady.value)),
    (Column("transient", 2), lambda s: number(s.transient.value)),
    (Column("diverged %", 1), lambda s: number(s.diverged.percent.value)),
    (Column("µs/step", 4), lambda s: optional(s.us_per_step, 2)),
)
"""The columns of one game in an overview that has a table per game."""


def grid(found: Sequence[Line], peer: str) -> Grid:
    """Return the overview as text, with a column per game that is never dropped."""
    return _overview(found, peer, _games(found))


def layouts(found: Sequence[Line], peer: str) -> Layouts:
    """Return the overview with a column per game and, where that does not fit, as a table across
    games followed by one of each game."""
    facts = facts_of(line.knows for line in found)
    across = with_letters(_overview(found, peer, ()), [line.knows for line in found], facts)
    narrow = (across, *(_game(game, found, facts) for game in _games(found)))
    return ((grid(found, peer),), narrow)


def _overview(found: Sequence[Line], peer: str, games: Sequence[GameName]) -> Grid:
    """Return the overview with columns of these games."""
    over = f" / {peer}" if peer else ""
    compared = any(line.over_floor for line in found)  # with a floor
    columns: list[tuple[Column, Callable[[Line], str]]] = [
        (Column("rank"), lambda line: _rank(line.places.get("steady"))),
        (Column("estimator", numeric=False), lambda line: line.estimator),
        (Column(f"steady{over}"), lambda line: _factor(line.places.get("steady"))),
        *(((Column("/ Bayes", 3), lambda line: _over_floor(line, "steady")),) if compared else ()),
        (Column("transient rank", 4), lambda line: _rank(line.places.get("transient"))),
        (Column(f"transient{over}", 2), lambda line: _factor(line.places.get("transient"))),
        *(
            ((Column("transient / Bayes", 4), lambda line: _over_floor(line, "transient")),)
            if compared
            else ()
        ),
        (Column("diverged %", 1), lambda line: number(100 * line.diverged, 2)),
        *((Column(label(game)), lambda line, game=game: _of_game(line, game)) for game in games),
        (Column("track", 3, numeric=False), lambda line: line.track),
        (Column("µs/step", 5), lambda line: optional(line.us_per_step, 2)),
        (Column("knows", numeric=False), lambda line: ", ".join(line.knows)),
    ]
    return Grid(
        TITLE,
        tuple(column for column, _ in columns),
        tuple(tuple(cell(line) for _, cell in columns) for line in found),
        track_blocks([line.track for line in found]),
        _floor_note(found) if compared else "",
    )


def _floor_note(found: Sequence[Line]) -> str:
    """Return over which games the ratios to floors are means."""
    means: dict[str, list[str]] = {}
    for line in found:
        if line.over_floor:
            games = (
                label(game) + (" (particle reference)" if particles else "")
                for game, particles in sorted(line.floor_games.items())
            )
            means.setdefault(", ".join(games), []).append(line.track)
    parts = [f"{', '.join(dict.fromkeys(tracks))}: {games}" for games, tracks in means.items()]
    over = "; ".join(parts) if len(parts) > 1 else next(iter(means))
    return (
        "/ Bayes: root mean square of the error over that of exact Bayes on the same episodes (see "
        f"the games), geometric mean over the games with a floor ({over})."
    )


def _games(found: Sequence[Line]) -> list[GameName]:
    return sorted({game for line in found for game in line.games}, key=label)


def _game(game: GameName, found: Sequence[Line], facts: Sequence[str]) -> Grid:
    """Return the overview's lines of one game, of the estimators that played it, with letters for
    what they know."""
    played = [line for line in found if game in line.games]
    known = [line.games[game].knows for line in played]
    whole = Grid(
        label(game),
        (
            Column("estimator", numeric=False),
            *(column for column, _ in OF_GAME),
            Column("track", 3, numeric=False),
            Column("knows", numeric=False),
        ),
        tuple(
            (line.estimator, *(cell(own) for _, cell in OF_GAME), line.track, ", ".join(own.knows))
            for line, own in ((line, line.games[game]) for line in played)
        ),
        track_blocks([line.track for line in played]),
    )
    return with_letters(whole, known, facts)


def rank_grid(found: Mapping[str, Places], knows: Mapping[str, Sequence[str]]) -> Grid:
    """Return the table of ranks as text: a line per estimator, sorted by worst rank, and a column
    per condition under which there are ranks.

    Args:
        found: places by condition.
        knows: what each estimator knows, by name.
    """
    ranked, notes = _ranked(found)
    return _ranks(found, ranked, knows, notes)


def rank_layouts(found: Mapping[str, Places], knows: Mapping[str, Sequence[str]]) -> Layouts:
    """Return the table of ranks with all conditions and, where that does not fit, in parts."""
    ranked, notes = _ranked(found)
    known = [knows[name] for name in worst_ranks(found)]

    def part(first: int, count: int) -> Grid:
        last = first + count >= len(ranked)
        grid = _ranks(found, ranked[first : first + count], knows, notes if last else "")
        return with_letters(grid, known, facts_of(known))

    parts = [
        [part(first, count) for first in range(0, max(len(ranked), 1), count)] for count in AT_ONCE
    ]
    return ((rank_grid(found, knows),), *parts)


def _ranks(
    found: Mapping[str, Places],
    conditions: Sequence[str],
    knows: Mapping[str, Sequence[str]],
    note: str,
) -> Grid:
    """Return the ranks under these conditions."""
    columns = (
        Column("estimator", numeric=False),
        *map(Column, conditions),
        Column("worst"),
        Column("knows", numeric=False),
    )
    lines = tuple(
        (
            name,
            *(_rank(found[condition].place("steady", name)) for condition in conditions),
            "" if worst is None else str(worst),
            ", ".join(knows[name]),
        )
        for name, worst in worst_ranks(found).items()
    )
    return Grid("Ranks", columns, lines, note=note)


def _ranked(found: Mapping[str, Places]) -> tuple[list[str], str]:
    """Return the conditions under which there are ranks, and remarks on what is left out."""
    ranked, notes = [], []
    for condition, places in found.items():
        if places.too_few:
            notes.append(f"{condition}: fewer than {FEWEST} episodes, which are not ranked.")
        elif not places.windows:
            notes.append(f"{condition}: not identifiable on any system, so that nothing is ranked.")
        else:
            ranked.append(condition)
            if places.left_out:
                games = ", ".join(game.system for game in places.left_out)
                notes.append(f"{condition}: without {games}, where states are not identifiable.")
    return ranked, " ".join(notes)


def _of_game(line: Line, game: GameName) -> str:
    s = line.games.get(game)
    if s is None:
        return cell_without_scores(line.estimator, game)
    lost = f"div {s.diverged.percent.value:.0f} %" if s.diverged.value else ""
    median = number(s.steady.value)
    return ", ".join(filter(None, [median, lost]))


def _over_floor(line: Line, window: str) -> str:
    ratio = line.over_floor.get(window)
    return over_floor_text(ratio, lambda interval: interval_text(interval, 2))


def _rank(place: Place | None) -> str:
    return "" if place is None or place.rank is None else str(place.rank)


def _factor(place: Place | None) -> str:
    return "" if place is None else interval_text(place.factor, 2)
