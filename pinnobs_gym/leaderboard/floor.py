"""The floor of errors in each game, exact Bayes or a particle reference, and errors over it."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.leaderboard.comparison import ROUNDING, estimate, interval
from pinnobs_gym.leaderboard.influence import SMALLEST, log_rms_ratio
from pinnobs_gym.leaderboard.intervals import Interval
from pinnobs_gym.scoring.row_format import FLOOR, FLOOR_WHOLE
from pinnobs_gym.scoring.rows import Row, game_of

TRACKS = (FLOOR, FLOOR_WHOLE)
"""The tracks of floors; their rows are never ranked."""
PARTICLES = "particle_reference"
"""Name in rows of the floor of plants with process noise; the other is exact Bayes."""
FEWEST_COMMON = 10
"""Fewest episodes with a floor that a ratio is given for."""
_SCORES = {"steady": "nrmse_steady_modulo", "transient": "nrmse_transient"}
"""The score of each window that is compared with the floor's."""
_SHOWN = 6
"""Number of characters of a hash that are shown."""


@dataclass(frozen=True)
class Floor:
    """The floor of one game for the estimators of one track."""

    rows: Mapping[str, Row] = field(default_factory=dict)
    """One row by episode."""

    def among(self, episodes: Iterable[str]) -> list[Row]:
        """Return the rows of those of these episodes that have one, in the floor's order."""
        wanted = set(episodes)
        return [row for episode, row in self.rows.items() if episode in wanted]


NO_FLOOR = Floor()
"""The floor of a game that has none."""


@dataclass(frozen=True)
class Floors:
    """The floors of all games."""

    by_game: Mapping[tuple[GameName, str], Floor] = field(default_factory=dict)
    """By game and the floor's own track."""
    notes: tuple[str, ...] = ()
    """What was left out, a sentence each."""

    @property
    def games(self) -> set[GameName]:
        """The games with a floor."""
        return {game for game, _ in self.by_game}

    def among(self, games: Iterable[GameName]) -> Floors:
        """Return the floors of these games, without notes."""
        wanted = set(games)
        return Floors({key: own for key, own in self.by_game.items() if key[0] in wanted})

    def of(self, game: GameName, track: str) -> Floor:
        """Return the floor of a game for estimators of a track: filtered for online ones, smoothed
        for offline ones."""
        own = FLOOR if track.startswith("online") else FLOOR_WHOLE
        return self.by_game.get((game, own), NO_FLOOR)


NO_FLOORS = Floors()
"""The floors where there are none."""


def is_floor(row: Row) -> bool:
    """Return whether a scored row is that of a floor, which no estimator is."""
    return row["track"] in TRACKS


def contending(rows: Iterable[Row]) -> list[Row]:
    """Return the rows of estimators, without those of floors."""
    return [row for row in rows if not is_floor(row)]


def floors(rows: Sequence[Row], shipped: Sequence[Row] = ()) -> Floors:
    """Return the floors of the games of some rows.

    Of several floors of an episode the most precise counts: exact Bayes before a particle
    reference, then the larger effective sample size or the smaller Monte-Carlo error. Of those in
    ``rows`` that different code computed, only the latest count. A floor of another ``game_hash``
    than the estimators' rows of its game is left out with a note.

    Args:
        rows: scored episodes of estimators and floors; those of a game have one ``game_hash``
            (`pinnobs_gym.leaderboard.distinct`).
        shipped: further rows of floors; those of games that are not in ``rows`` do not count.
    """
    own = _of_latest_code([row for row in rows if is_floor(row)])
    hashes = {game_of(row): row["game_hash"] for row in [*own, *contending(rows)]}
    known = [row for row in [*own, *shipped] if game_of(row) in hashes]
    older: Counter[tuple[GameName, str]] = Counter()
    chosen: dict[tuple[GameName, str], dict[str, Row]] = defaultdict(dict)
    for row in sorted(known, key=_precision):
        game = game_of(row)
        if row["game_hash"] == hashes[game]:
            chosen[game, row["track"]].setdefault(row["episode"], row)
        else:
            older[game, row["game_hash"]] += 1
    notes = tuple(
        f"{count} episodes of the floor of {', '.join(game)} are left out: they are of other code "
        f"or settings of the system, the simulation or the scores (hash {other[:_SHOWN]}) than the "
        f"estimators' ({hashes[game][:_SHOWN]})."
        for (game, other), count in sorted(older.items())
    )
    return Floors({key: Floor(rows) for key, rows in chosen.items()}, notes)


def _of_latest_code(rows: Sequence[Row]) -> list[Row]:
    """Return the floors that were computed by the code of the latest one of their game, track and
    kind: those of earlier code may be precise and wrong."""
    latest: dict[tuple[GameName, str, bool], tuple[str, str]] = {}
    for row in rows:
        kind = game_of(row), row["track"], is_particles(row)
        version = row["date"], row["estimator_code"]
        latest[kind] = max(latest.get(kind, version), version)
    return [
        row
        for row in rows
        if row["estimator_code"] == latest[game_of(row), row["track"], is_particles(row)][1]
    ]


def _precision(row: Row) -> tuple[bool, float, float]:
    """Return the sort key of floors of an episode, the most precise first."""
    size, error = row.get("effective_sample_size"), row.get("monte_carlo")
    return is_particles(row), -(size or 0.0), np.inf if error is None else error


def is_particles(row: Row) -> bool:
    """Return whether a floor is a particle reference, which has a Monte-Carlo error."""
    return row["estimator"].partition(" (")[0] == PARTICLES


def label(row: Row) -> str:
    """Return what a floor is called in charts."""
    name = "particle reference" if is_particles(row) else "exact Bayes"
    return name if row["track"] == FLOOR else f"{name}, whole record"


def over_floor(parts: Mapping[str, tuple[Sequence[Row], Floor]], window: str) -> Interval | None:
    """Return an estimator's errors over their floor: in a system the root mean square of the NRMSE
    over episodes, over that of the floor on the same episodes; the geometric mean over systems.

    An episode that diverged counts with its own error; where one is not finite, so is the ratio.
    The 95 % interval is from the variances between trainings and between episodes
    (`pinnobs_gym.leaderboard.comparison.estimate`); of a single training, it holds for this one.

    Args:
        parts: by system, the estimator's rows and the floor.
        window: ``steady`` (modulo states that no output tells apart) or ``transient``.

    Returns:
        None if a system has fewer than `FEWEST_COMMON` episodes that the floor and all trainings
        have, a floor of zero or, in the steady window, a floor that lies between states which no
        output tells apart; also without systems.
    """
    pairs = {system: _paired(*own, window) for system, own in parts.items()}
    found = {system: pair for system, pair in pairs.items() if pair is not None}
    if not parts or len(found) < len(parts):
        return None
    with np.errstate(over="ignore"):
        finite = all(np.isfinite(np.square(error).sum()) for error, _ in found.values())
    if not finite:
        return Interval(np.inf, np.inf, np.inf)
    ratio = estimate({name: log_rms_ratio(*pair) for name, pair in found.items()})
    if ratio.standard_error <= ROUNDING and abs(ratio.value) <= ROUNDING:
        return Interval(1.0, 1.0, 1.0)
    return interval(ratio).exp


def _paired(rows: Sequence[Row], floor: Floor, window: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the errors (training seeds, episodes) of the episodes that the floor and all trainings
    have, and the floor (episodes,); None if there are too few, the floor is zero, or it bounds
    nothing."""
    name = _SCORES[window]
    if window == "steady" and any(
        not np.isclose(row[name], row["nrmse_steady"], rtol=ROUNDING) for row in floor.rows.values()
    ):
        # The mean over states that no output tells apart has the least error from the true one, but
        # not from the nearest of them.
        return None
    least = {episode: row[name] for episode, row in floor.rows.items() if np.isfinite(row[name])}
    if len(least) < FEWEST_COMMON:
        return None
    played: dict[int | None, dict[str, float]] = defaultdict(dict)
    for row in rows:
        played[row["training_seed"]][row["episode"]] = row[name]
    common = [e for e in least if all(e in errors for errors in played.values())]
    floor_errors = np.array([least[episode] for episode in common])
    if len(common) < FEWEST_COMMON or not floor_errors.any():
        return None
    errors = [[own[episode] for episode in common] for own in played.values()]
    return np.maximum(np.array(errors, dtype=float), SMALLEST), floor_errors
