"""Logging of scores for TensorBoard."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from pinnobs_gym.files import file_name
from pinnobs_gym.scoring.curves import curves_of
from pinnobs_gym.scoring.playing import Played
from pinnobs_gym.scoring.rows import Row, seed_of
from pinnobs_gym.training.log import FOLDER, HPARAMS, Log

LOGGED = ("nrmse", "nrmse_transient", "nrmse_steady", "rmse", "settling", "peak")
"""The scores that are logged."""
DIGITS = 6
"""Digits of an estimator's hash in the names of runs."""
SQUARED = ("nrmse_transient", "nrmse_steady_modulo")
"""The scores whose root mean square over episodes is logged: that which a floor bounds."""


def log_episodes(log: Log, rows: list[Row], played: Played | None) -> None:
    """Log the scores of each episode against its seed, or of each sensor log against its number
    from 0. Of the episodes that were run now, log the median error against the sample, and a
    figure of the first."""
    steps = {row["episode"]: i if "log" in row else seed_of(row) for i, row in enumerate(rows)}
    for row in rows:
        for name in LOGGED:
            if np.isfinite(row[name]):
                log.scalar(f"episode/{name}", row[name], steps[row["episode"]])
    if played is not None and log.active:
        (drawn,) = (row for row in rows if seed_of(row) == played.seeds[0])
        what = drawn.get("log", drawn["condition"])
        title = f"{drawn['env_id']}, {what}: {drawn['estimator']}"
        log.figure("states", played.figure(title), steps[drawn["episode"]])
        _log_error(log, played)


def _log_error(log: Log, played: Played) -> None:
    """Log the curve of the median over episodes of the NRMSE of a sample."""
    found = curves_of(played)
    samples = np.searchsorted(played.record.t - played.record.t[0], found.t)
    known = ~np.isnan(found.error).all(axis=0)
    for k, error in zip(samples[known], np.nanmedian(found.error[:, known], axis=0), strict=True):
        if np.isfinite(error):
            log.scalar("over samples/median_nrmse", float(error), int(k))


def log_summary(log: Log, rows: list[Row]) -> None:
    """Log an estimator's settings and scores for the HPARAMS table: medians, in which diverged
    episodes count as infinite, and root mean squares, in which they count with their own errors.
    What is not finite is left out. Of a floor (`pinnobs_gym.scoring.row_format.FLOOR`), log also
    how precise it is."""
    first = rows[0]
    parameters = {HPARAMS["estimator"]: first["estimator"], HPARAMS["system"]: _system(first)}
    parameters |= {name: first[name] for name in ("setup", "condition", "track")}
    parameters |= first["options"]
    diverged = np.array([row["diverged"] for row in rows])
    scores = {name: np.where(diverged, np.inf, [row[name] for row in rows]) for name in LOGGED}
    medians = {f"median/{name}": float(np.median(values)) for name, values in scores.items()}
    with np.errstate(over="ignore"):
        squares = {name: np.mean(np.square([row[name] for row in rows])) for name in SQUARED}
    means = {f"rms/{name}": float(np.sqrt(square)) for name, square in squares.items()}
    summary = {
        n: value for n, value in (medians | means | _precision(rows)).items() if np.isfinite(value)
    }
    summary["diverged"] = float(diverged.mean())
    log.hparams(parameters, summary)


def _precision(rows: list[Row]) -> dict[str, float]:
    """Return the smallest effective sample size and the largest Monte-Carlo error of a floor's
    episodes, where they are known."""
    found = {}
    for name, worst in (("effective_sample_size", min), ("monte_carlo", max)):
        known = [row[name] for row in rows if row.get(name) is not None]
        if known:
            found[name] = float(worst(known))
    return found


def log_folder(folder: Path, row: Row) -> Path:
    """Return the log folder of a row's estimator; other settings of it have another folder. Below
    that of all runs its path is their name in TensorBoard, which leaves out what is usual: the
    setup ``benchmark`` and the condition ``nominal``."""
    parts = [row["estimator"], _system(row)]
    parts += [] if row["setup"] == "benchmark" else [f"setup-{row['setup']}"]
    parts += [] if row["condition"] == "nominal" else [row["condition"]]
    return folder.joinpath(FOLDER, *map(file_name, parts), row["estimator_hash"][:DIGITS])


def _system(row: Row) -> str:
    return row["env_id"].removeprefix("pinnobs/")


def log_summaries(folder: Path, rows: Iterable[Row]) -> None:
    """Log a summary of every estimator in these rows for TensorBoard's HPARAMS table."""
    groups: dict[Path, list[Row]] = {}
    for row in rows:
        groups.setdefault(log_folder(folder, row), []).append(row)
    for place, group in groups.items():
        with Log(place) as log:
            log_summary(log, group)
