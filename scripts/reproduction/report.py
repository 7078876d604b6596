"""Tables of the results beside the paper's figures, and the file of the results."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pinnobs_gym.scoring.rows import Row
from pinnobs_gym.simulation.initial_set import prior_moments
from pinnobs_gym.systems import SYSTEMS
from reproduction.running import REPEATS, SETUP, PaperJob
from reproduction.tables import RECIPES, Case, Printed, Table, recipe

HEADER = (
    "case",
    "by",
    "RMSE",
    "MAE",
    "replay RMSE",
    "best loss",
    "found at",
    "iterations",
    "training s",
    "inference ms",
)
_NUMBERS = ("rmse", "mae", "replay_rmse", "loss", "seconds", "inference_ms")

PROTOCOL = (
    f"Ours: setup `{SETUP}`, without noise. RMSE and MAE are those of the network's own x̂(t), "
    "in state units, over all samples of the record and all states, the transient included. The "
    "replay is the observer integrated with the learned L(t) over the same record, which the paper "
    "does not score. The loss is that of the samples trained on, and “found at” the iteration that "
    "found it, to within a hundred. Training is CPU seconds of one thread, inference the network "
    f"at all times of the record, one thread, median of {REPEATS}.",
    "The paper's: 60 % of the samples are trained on and 40 % are for tests; it does not say which "
    "of them its RMSE and MAE are of. Its “Conv. Iter.” stand under “found at”, since some are "
    "over 180,000 with a patience of 20,000 and a limit of 200,000. Training and inference are on "
    "a Tesla T4.",
)


def starts(table: Table) -> str:
    """Describe the records of a table: initial states and estimates, and samples."""
    parts, sizes = [], set()
    for name in dict.fromkeys(case.system for case in table.cases):
        system, setup = SYSTEMS.resolve(name).configured(SETUP)
        x0, xhat0 = _vector(setup.start(system.nx).mean), _vector(prior_moments(system, setup)[0])
        parts.append(f"{name} x₀ = {x0}, x̂₀ = {xhat0}")
        sizes.add(f"{setup.num_steps:,} samples over {setup.duration:g} s")
    return f"Records of {' or '.join(sorted(sizes))}: {'; '.join(parts)}."


def _vector(values: Sequence[float] | np.ndarray) -> str:
    return "[" + ", ".join(f"{value:g}" for value in np.atleast_1d(values)) + "]"


def read(path: Path) -> list[Row]:
    """Read the last row of each key from a results file; none if the file does not exist.

    Raises:
        ValueError: in one line, if the file cannot be read, or a line of it is not a row.
    """
    if not path.exists():
        return []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"cannot read results from {path}: {error}") from None
    results: dict[str, Row] = {}
    for number, line in enumerate(lines, 1):
        try:
            row = json.loads(line)
            results[row["key"]] = row | {
                n: math.inf if row[n] is None else row[n] for n in _NUMBERS
            }
        except (ValueError, TypeError, KeyError):
            raise ValueError(
                f"{path}, line {number}, is cut off or no result: {line[:40]!r}; delete that line "
                "and run again"
            ) from None
    return list(results.values())


def of_case(case: Case, rows: Iterable[Row]) -> list[Row]:
    """Return the rows of a case, of any table, ordered by preset, seed and budget."""

    def job(row: Row) -> PaperJob:
        free = {name: row["config"][name] for name in ("seed", "budget")}
        return PaperJob(case, row["preset"], recipe(row["preset"], case, **free), Path())

    def order(row: Row) -> tuple[str, int, float]:
        return row["preset"], row["config"]["seed"], _budget(row)

    return sorted((row for row in rows if job(row).key == row["key"]), key=order)


def is_done(job: PaperJob, rows: Iterable[Row]) -> bool:
    """Return whether the result of a job is known.

    It is known from the job's own row, or from a training with another budget that finished within
    the job's budget.
    """
    budget, seed = job.config.budget, job.config.seed
    for row in of_case(job.case, rows):
        if (row["preset"], row["config"]["seed"]) == (job.preset, seed):
            ended = not _is_cut(row) and (budget is None or row["seconds"] < budget)
            if ended or row["key"] == job.key:
                return True
    return False


def longest(rows: Iterable[Row]) -> list[Row]:
    """Return, among rows that differ only in their budget, those with the largest budget."""
    largest = {}
    for row in sorted(rows, key=_budget):
        settings = {name: value for name, value in row["config"].items() if name != "budget"}
        largest[row["system"], json.dumps(settings, sort_keys=True)] = row
    return list(largest.values())


def _budget(row: Row) -> float:
    budget = row["config"]["budget"]
    return math.inf if budget is None else budget


def lines(table: Table, rows: Sequence[Row]) -> list[tuple[str, ...]]:
    """Return the rows of a table: for each case the paper's, then ours."""
    cells = []
    for case in table.cases:
        if case.printed != Printed():
            cells.append((case.name, "the paper", *_printed(case.printed)))
        cells += [(case.name, _recipe(row), *_measured(row)) for row in of_case(case, rows)]
    return cells


def _printed(printed: Printed) -> tuple[str, ...]:
    def shown(value: float | None, form: str) -> str:
        return "" if value is None else format(value, form)

    return (
        "" if printed.rmse is None else _error(printed.rmse),
        shown(printed.mae, ".5f"),
        "",
        shown(printed.loss, ".2e"),
        shown(printed.iterations, ",d"),
        "",
        shown(printed.seconds, ".0f"),
        shown(printed.inference_ms, ".2f"),
    )


def _error(value: float) -> str:
    """Format an RMSE with the paper's number of digits."""
    if not math.isfinite(value):
        return "diverges"
    return format(value, ".5f" if value < 0.01 else ".4f" if value < 10 else ".4g")


def _recipe(row: Row) -> str:
    """Describe the preset and seed of a row, and whether its training was finished."""
    config = row["config"]
    seed = f", seed {config['seed']}" if config["seed"] else ""
    end = f"stopped at {_budget(row):g} s" if _is_cut(row) else "to the end"
    return f"{RECIPES[row['preset']]}{seed}, {end}"


def _is_cut(row: Row) -> bool:
    return row["seconds"] >= _budget(row)


def _measured(row: Row) -> tuple[str, ...]:
    return (
        _error(row["rmse"]),
        f"{row['mae']:.5f}",
        _error(row["replay_rmse"]),
        f"{row['loss']:.2e}",
        f"{row['best_iteration']:,}",
        f"{row['iterations']:,}",
        f"{row['seconds']:.0f}",
        f"{row['inference_ms']:.2f}",
    )


def measured_on(rows: Sequence[Row]) -> str:
    """Describe in a line when and on which machine the rows were measured."""
    dates = sorted({row["date"][:10] for row in rows})
    span = dates[0] if len(dates) == 1 else f"{dates[0]} to {dates[-1]}"
    machines = {f"Python {row['versions']['python']}, {row['processor']}" for row in rows}
    return f"Measured on {span}, one thread ({'; '.join(sorted(machines))})."


def markdown(table: Table, rows: Sequence[Row]) -> str:
    """Return the table with its notes as Markdown."""
    cells = [HEADER, ("---",) * 2 + ("---:",) * (len(HEADER) - 2), *lines(table, rows)]
    body = "\n".join("| " + " | ".join(line) + " |" for line in cells)
    source = f"In the paper: {table.source}."
    return "\n\n".join([body, *table.notes, source, starts(table)])


def readme_section(rows: Sequence[Row], tables: Iterable[Table]) -> str:
    """Return the README's section: the tables with results of the current recipes, each case with
    its longest training; empty if there are no results."""
    parts, used = [], []
    for table in tables:
        results = {case: longest(of_case(case, rows)) for case in table.cases}
        shown = [row for chosen in results.values() for row in chosen]
        if shown:
            with_rows = tuple(case for case, chosen in results.items() if chosen)
            parts += [f"**{table.title}**", markdown(replace(table, cases=with_rows), shown)]
            used += shown
    if not used:
        return ""
    intro = (
        "`python scripts/reproduce_paper.py depth` (`activation`, `weights`, `examples`) makes the "
        f"paper's tables anew. {measured_on(used)} `paper` is the recipe of the paper, `fast, "
        "paper's loss` a faster one with its loss; `fast, guided` adds a guide, which draws x̂ "
        "towards a Kalman smoother's estimates of the same record, and L towards Riccati's gain."
    )
    return "\n\n".join([intro, *parts, *PROTOCOL])
