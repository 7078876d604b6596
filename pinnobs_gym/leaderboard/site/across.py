"""The page's results across systems and conditions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pinnobs_gym.leaderboard.contenders import Contender, among
from pinnobs_gym.leaderboard.places import Place, Places
from pinnobs_gym.leaderboard.ranks import Line, by_condition, worst_ranks
from pinnobs_gym.leaderboard.runs import rows_of
from pinnobs_gym.leaderboard.site.columns import Columns, extend, number


@dataclass(frozen=True)
class Factors:
    """Factors of online estimators to the peer in the steady window under several conditions."""

    of: str
    """A system, or "all systems"."""
    estimators: tuple[str, ...]
    """Estimators, those played under more conditions first, then those with the better worst
    rank."""
    worst: tuple[int | None, ...]
    """Worst rank of each estimator; None if it has none."""
    values: Mapping[str, Mapping[str, Place]]
    """Places by condition and estimator, of those with a rank; empty under a condition under which
    no states are identifiable or too few episodes were played."""
    left_out: Mapping[str, tuple[str, ...]]
    """By condition, the systems that are not compared since states are not identifiable; by name
    and without repetition."""


def factors(contenders: Sequence[Contender], over_all: Mapping[str, Places]) -> list[Factors]:
    """Return the factors over all systems and, if there are several systems, of each system; only
    those with several conditions.

    Args:
        contenders: estimators of all tracks, in one setup.
        over_all: their places under each condition, over all systems.
    """
    online = [contender for contender in contenders if contender.track == "online"]
    systems = sorted({game.system for contender in online for game in contender.games})
    found = {"all systems": over_all}
    for system in systems if len(systems) > 1 else ():
        own = among(online, lambda run, wanted=system: run.game.system == wanted)
        found[system] = by_condition(own)
    return [_factors(of, placed) for of, placed in found.items() if len(placed) > 1]


def _factors(of: str, found: Mapping[str, Places]) -> Factors:
    values = {
        condition: {
            name: place
            for name, place in placed.windows.get("steady", {}).items()
            if place.rank is not None
        }
        for condition, placed in found.items()
    }
    ranks = worst_ranks(found)
    left_out = {
        condition: tuple(dict.fromkeys(game.system for game in placed.left_out))
        for condition, placed in found.items()
    }
    return Factors(of, tuple(ranks), tuple(ranks.values()), values, left_out)


def training_seconds(contender: Contender) -> float | None:
    """Return the median CPU seconds of its trainings; None if it is not trained."""
    spent = [row["training"].get("seconds") for row in rows_of(contender.runs)]
    known = [seconds for seconds in spent if seconds is not None]
    return float(np.median(known)) if known else None


def costs(lines: Sequence[Line], seconds: Mapping[str, float | None]) -> Columns:
    """Return a row per line of the overview: its factor to the peer in the steady window with the
    interval, its µs per step, and the CPU seconds of its training, with gaps where these are not
    known or the estimator is not trained.

    ``front`` is true for the Pareto front: lines that no other of their track beats in both
    accuracy and speed. Lines without a factor are left out.
    """
    table: Columns = {name: [] for name in ("estimator", "track", "ratio", "low", "high", "us")}
    table |= {"seconds": [], "front": []}
    for line in lines:
        if "steady" not in line.places:
            continue
        factor = line.places["steady"].factor
        spent = seconds.get(line.estimator)
        extend(
            table,
            estimator=[line.estimator],
            track=[line.track],
            ratio=[number(factor.value)],
            low=[number(factor.low)],
            high=[number(factor.high)],
            us=[None if line.us_per_step is None else number(line.us_per_step)],
            seconds=[None if spent is None else number(spent)],
            front=[
                line.us_per_step is not None and not any(_beats(other, line) for other in lines)
            ],
        )
    return table


def _beats(other: Line, line: Line) -> bool:
    """Return whether the other line is both faster and more accurate."""
    if "steady" not in other.places or other.track != line.track:
        return False
    if other.us_per_step is None or line.us_per_step is None:
        return False
    faster = other.us_per_step < line.us_per_step
    return faster and other.places["steady"].factor.value < line.places["steady"].factor.value
