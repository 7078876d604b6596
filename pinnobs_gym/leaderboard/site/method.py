"""Provenance of the scores: settings, training, versions, and the commands that reproduce them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.leaderboard.board import Board
from pinnobs_gym.leaderboard.contenders import Contender, contenders
from pinnobs_gym.leaderboard.escapes import quoted
from pinnobs_gym.leaderboard.floor import contending
from pinnobs_gym.leaderboard.runs import ScoredRun, rows_of, runs_of
from pinnobs_gym.leaderboard.standings import training_of
from pinnobs_gym.scoring.row_format import LOG_FILES
from pinnobs_gym.scoring.rows import Row, Stored, game_of, seed_of


@dataclass(frozen=True)
class EstimatorMethod:
    """Provenance of one estimator's scores."""

    estimator: str
    track: str
    knows: str
    settings: str
    training: str
    episodes: int
    """Number of rows."""
    dates: str


@dataclass(frozen=True)
class FailedJob:
    """A job of the leaderboard that failed."""

    estimator: str
    game: GameName
    episodes: int
    error: str
    """The error in one line."""


@dataclass(frozen=True)
class Method:
    """Provenance of all scores."""

    estimators: tuple[EstimatorMethod, ...]
    floors: tuple[EstimatorMethod, ...]
    """Those of the floors of errors."""
    failures: tuple[FailedJob, ...]
    versions: Mapping[str, str]
    """Versions of each package."""
    notes: tuple[str, ...]
    """What was left out, a sentence each."""
    commands: tuple[str, ...]
    """Command lines that reproduce the rows of the estimators."""
    dates: str
    """The day, or the first and last day."""
    episodes: int
    """Number of rows of the estimators."""


def method_of(stored: Stored, drawn: Iterable[Contender], board: Board) -> Method:
    """Return the provenance of stored scores, given their contenders and tables."""
    scored = contending(stored.rows)
    floors = [row for floor in board.floors.by_game.values() for row in floor.rows.values()]
    return Method(
        estimators=tuple(map(estimator_method, drawn)),
        floors=tuple(map(estimator_method, contenders(runs_of(floors)))),
        failures=tuple(
            FailedJob(row["estimator"], game_of(row), row["episodes"], row["error"])
            for row in stored.failures
        ),
        versions=versions([*scored, *floors]),
        notes=board.notes,
        commands=tuple(commands(runs_of(scored))),
        dates=dates(scored or stored.rows),
        episodes=len(scored),
    )


def estimator_method(contender: Contender) -> EstimatorMethod:
    """Return the provenance of one contender's scores."""
    rows = rows_of(contender.runs)
    firsts = [runs[0].rows[0] for runs in contender.games.values()]
    return EstimatorMethod(
        estimator=contender.name,
        track=contender.track,
        knows=", ".join(rows[0]["knows"]),
        settings="; ".join(dict.fromkeys(_settings(row["options"]) for row in firsts)),
        training=training_of(rows),
        episodes=len(rows),
        dates=dates(rows),
    )


def _settings(options: Mapping[str, Any]) -> str:
    """Format settings in one line, without those that are None."""
    parts = []
    for name, value in options.items():
        if isinstance(value, Mapping):
            parts.append(f"{name}: {_settings(value)}")
        elif value is not None:
            parts.append(f"{name}={value:g}" if isinstance(value, float) else f"{name}={value}")
    return ", ".join(parts)


def dates(rows: Sequence[Row]) -> str:
    """Return the day, or the first and last day, of the rows."""
    days = {str(row["date"])[:10] for row in rows}
    return " to ".join(sorted({min(days), max(days)}))


def versions(rows: Iterable[Row]) -> dict[str, str]:
    """Return the versions of each package used for the rows."""
    by_package: dict[str, set[str]] = {}
    for versions in {tuple(row["versions"].items()) for row in rows}:
        for name, version in versions:
            by_package.setdefault(name, set()).add(version)
    return {name: ", ".join(sorted(those)) for name, those in sorted(by_package.items())}


def commands(runs: Iterable[ScoredRun]) -> list[str]:
    """Return command lines that reproduce these runs: one per setup for the default conditions, and
    one per set of other conditions for the systems played under it. They may produce more rows,
    since every named estimator plays every named system. Estimators play by their own recipe; any
    other, which their names in rows say in brackets, needs a suite of one's own. Submitted
    estimates are left out: no estimator here makes them. Of sensor logs there is a line for each
    estimator, without what it was told of noise and prior."""
    runs = [run for run in runs if not run.submitted]
    of_logs = [run for run in runs if "log" in run.rows[0]]
    runs = [run for run in runs if "log" not in run.rows[0]]
    usual: dict[str, list[ScoredRun]] = {}
    others: dict[tuple[str, str], list[ScoredRun]] = {}
    for run in runs:
        if run.ranked or run.game.condition == "nominal":
            usual.setdefault(run.game.setup, []).append(run)
        else:
            others.setdefault((run.game.setup, run.game.env_id), []).append(run)
    alike: dict[tuple[str, ...], list[ScoredRun]] = {}
    for (setup, _), some in others.items():
        played = {run.game.condition for run in some}
        alike.setdefault((setup, *sorted(played)), []).extend(some)
    lines = [_command(some) for some in usual.values()]
    lines += map(_command_of_logs, of_logs)
    return lines + [_command(some, conditions) for (_, *conditions), some in alike.items()]


def _command_of_logs(run: ScoredRun) -> str:
    """Return the command line that scores an estimator on sensor logs."""
    words = ["pinnobs evaluate --system", quoted(run.game.system.rpartition("-v")[0])]
    for option in LOG_FILES:
        files = dict.fromkeys((row["episode"], row[option]) for row in run.rows)
        words += [f"--{option}", *(quoted(name) for _, name in files)]
    return " ".join([*words, "--estimator", quoted(run.estimator.partition(" (")[0])])


def _command(runs: Sequence[ScoredRun], conditions: Sequence[str] = ()) -> str:
    rows = rows_of(runs)
    words = ["pinnobs leaderboard"]
    systems = {run.game.system.rpartition("-v")[0] for run in runs}
    words += ["--systems", *map(quoted, sorted(systems))]
    names = {run.estimator.partition(" (")[0] for run in runs}
    words += ["--estimators", *map(quoted, sorted(names))]
    setup = runs[0].game.setup
    words += ["--setup", quoted(setup)] if setup != "benchmark" else []
    words += ["--condition", *map(quoted, conditions)] if conditions else []
    alone = {seed_of(row) for row in rows if row["training"].get("per_record")}
    seeds = {seed_of(row) for row in rows}
    words += ["--episodes", str(max(seeds) - min(seeds) + 1)]
    words += ["--trained-episodes", str(max(alone) - min(alone) + 1)] if alone else []
    budgets = {row["training"].get("config", {}).get("budget") for row in rows} - {None}
    words += ["--budget", f"{max(budgets):g}"] if budgets else []
    words += ["--seed", str(min(seeds))] if min(seeds) else []
    return " ".join(words)
