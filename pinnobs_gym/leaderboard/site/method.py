"""Provenance of the scores: settings, training, versions, and the commands that reproduce them."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.leaderboard.board import Board
from pinnobs_gym.leaderboard.contenders import Contender, contenders
from pinnobs_gym.leaderboard.display import one_line
from pinnobs_gym.leaderboard.escapes import quoted
from pinnobs_gym.leaderboard.floor import contending
from pinnobs_gym.leaderboard.runs import ScoredRun, rows_of, runs_of
from pinnobs_gym.leaderboard.standings import training_of
from pinnobs_gym.leaderboard.suites import Entry
from pinnobs_gym.scoring.deviations import preset_of
from pinnobs_gym.scoring.row_format import LOG_FILES, is_name
from pinnobs_gym.scoring.rows import Row, Stored, game_of, seed_of
from pinnobs_gym.scoring.tuned import SUFFIX

SUITE_FILE = "reproduced.toml"
"""The file of a suite that a command writes."""


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
    since every named estimator plays every named system. Where an estimator has settings or a name
    of its own, the command begins with the suite that says so, which it writes to a file. What no
    command plays is said in a comment of the shell. Submitted estimates are left out: no estimator
    here makes them. Of sensor logs there is a line for each estimator, without what it was told of
    noise and prior."""
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
    words = ["pinnobs evaluate --system", quoted(_system_of(run))]
    for option in LOG_FILES:
        files = dict.fromkeys((row["episode"], row[option]) for row in run.rows)
        words += [f"--{option}", *(quoted(name) for _, name in files)]
    return " ".join([*words, "--estimator", quoted(_entry_of(run).name)])


def _command(runs: Sequence[ScoredRun], conditions: Sequence[str] = ()) -> str:
    rows = rows_of(runs)
    entries = list({repr(entry): entry for entry in map(_entry_of, runs)}.values())
    named = sorted(entry.name + SUFFIX * entry.tuned for entry in entries)
    words = ["pinnobs leaderboard"]
    suite = "" if _are_plain(entries) else _suite(entries)
    words += [f"--suite {SUITE_FILE}"] if suite else []
    words += ["--systems", *map(quoted, sorted({_system_of(run) for run in runs}))]
    words += [] if suite else ["--estimators", *map(quoted, named)]
    setup = runs[0].game.setup
    words += ["--setup", quoted(setup)] if setup != "benchmark" else []
    words += ["--condition", *map(quoted, conditions)] if conditions else []
    alone = {seed_of(row) for row in rows if row["training"].get("per_record")}
    seeds = {seed_of(row) for row in rows}
    words += ["--episodes", str(max(seeds) - min(seeds) + 1)]
    words += ["--trained-episodes", str(max(alone) - min(alone) + 1)] if alone else []
    budgets = {row["training"].get("config", {}).get("budget") for row in rows} - {None}
    words += ["--budget", *(f"{budget:g}" for budget in sorted(budgets))] if budgets else []
    trainings = {row["training_seed"] for row in rows} - {None}
    words += ["--training-seeds", *map(str, sorted(trainings))] if trainings - {0} else []
    words += ["--seed", str(min(seeds))] if min(seeds) else []
    return "\n".join([*suite.splitlines(), " ".join(words), *_not_played(runs)])


def _system_of(run: ScoredRun) -> str:
    """Return what a command takes for the system of a run."""
    name = run.game.system.rpartition("-v")[0]
    return _made_by(run).get("system", name)


def _made_by(run: ScoredRun) -> Mapping[str, Any]:
    found = run.rows[0].get("made_by", {})
    return {name: value for name, value in found.items() if name == "settings" or is_name(value)}


def _entry_of(run: ScoredRun) -> Entry:
    """Return what a suite takes for the estimator of a run."""
    row, made_by = run.rows[0], _made_by(run)
    tuned = row["estimator"].endswith(SUFFIX)
    name = row["estimator"].partition(" (")[0].removesuffix(SUFFIX)
    labelled, known = "settings" in made_by, _settings_of(run)
    if not labelled and " (" in row["estimator"]:  # a recipe that is not its own
        known = {**_preset(name, row), **known}
    return Entry(
        made_by.get("estimator", name),
        row["estimator"] if labelled else None,
        {key: value for key, value in known.items() if _is_setting(row, key, value)},
        tuned,
    )


def _settings_of(run: ScoredRun) -> Mapping[str, Any]:
    """Return the settings of a run that are not the usual ones, also those that a label stands
    for."""
    found = _made_by(run).get("settings", run.rows[0]["settings"])
    return found if isinstance(found, Mapping) else {}


def _preset(name: str, row: Row) -> dict[str, str]:
    """Return the preset of a training as a setting, if this process knows it."""
    cls = ESTIMATORS.classes().get(name)
    try:
        preset = preset_of(cls, row["training"].get("config", {})) if cls is not None else ""
    except ValueError:
        return {}
    return {"preset": preset} if preset else {}


def _is_setting(row: Row, name: str, value: Any) -> bool:
    """Return whether a suite can set what differs from the usual: a setting of the estimator or of
    its training, as far as TOML has such a value."""
    options = {*row["options"], *row["training"].get("config", {}), "preset"}
    return name in options and bool(_toml(value))


def _are_plain(entries: Sequence[Entry]) -> bool:
    return not any(entry.settings or entry.label for entry in entries)


def _suite(entries: Sequence[Entry]) -> str:
    """Return the shell command that writes the estimators of a suite to `SUITE_FILE`."""
    lines = []
    for entry in sorted(entries, key=repr):
        parts = {"name": entry.name, **({"label": entry.label} if entry.label else {})}
        parts |= {"settings": dict(entry.settings)} if entry.settings else {}
        parts |= {"tuned": True} if entry.tuned else {}
        lines.append(f"    {_toml(parts)},")
    return "\n".join([f"cat > {SUITE_FILE} << 'TOML'", "estimators = [", *lines, "]", "TOML"])


def _toml(value: Any) -> str:
    """Return a value in TOML, in one line; empty if it has none."""
    if isinstance(value, Mapping):
        parts = {json.dumps(str(name)): _toml(part) for name, part in value.items()}
        shown = ", ".join(f"{_bare(name)} = {part}" for name, part in parts.items())
        return f"{{ {shown} }}" if all(parts.values()) else ""
    if isinstance(value, list | tuple):
        items = [_toml(item) for item in value]
        return f"[{', '.join(items)}]" if all(items) else ""
    return "" if value is None else json.dumps(value)


def _bare(key: str) -> str:
    """Return a key without quotes where TOML needs none."""
    return key[1:-1] if re.fullmatch(r'"[A-Za-z0-9_-]+"', key) else key


def _not_played(runs: Sequence[ScoredRun]) -> list[str]:
    """Return, as comments, what the command cannot repeat of some runs."""
    found = []
    for run in runs:
        row = run.rows[0]
        lost = sorted(_settings_of(run).keys() - _entry_of(run).settings.keys())
        if lost:
            found.append(
                f"# {row['estimator']}: without its {', '.join(lost)}, which evaluate() has"
            )
        specs = (_made_by(run).get("estimator", ""), _system_of(run))
        if any(spec.startswith("__main__:") or "<locals>" in spec for spec in specs):
            found.append(
                f"# {row['estimator']}: of a script or a notebook; put it in a module first"
            )
    return list(dict.fromkeys(map(one_line, found)))
