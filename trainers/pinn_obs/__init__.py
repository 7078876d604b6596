"""PINN-Obs: a network and a gain for one record, by the paper's recipe or a fast one.

Farkane, Boutayeb, Oudani & Ghogho, "PINN-Obs: Physics-Informed Neural Network-Based Observer for
Nonlinear Dynamical Systems". Equation numbers are the paper's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from pinnobs_gym.estimators.pinn_obs import Trained
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System, vector
from pinnobs_gym.training.log import SILENT, Log
from pinnobs_gym.training.loop import bar, interruption
from trainers.pinn_obs.config import Config
from trainers.pinn_obs.fast import FastRun
from trainers.pinn_obs.paper import PaperRun
from trainers.pinn_obs.progress import described, gain_figure, log_end, log_terms
from trainers.pinn_obs.run import Run
from trainers.pinn_obs.stacked import advance

__all__ = ["Config", "gain_figure", "train", "train_many", "train_rows"]

MIN_SAMPLES = 10
"""The shortest record that is trained on."""
_RUNS: dict[str, type[Run]] = {"adam": PaperRun, "ssbroyden": FastRun}


def train(
    system: System,
    config: Config,
    *,
    record: Record,
    noise_std: Sequence[float] | float | None = None,
    log: Log = SILENT,
    checkpoint: Path | None = None,
    resume: bool = False,
    progress: bool = False,
) -> Trained:
    """Train PINN-Obs on the record of one episode.

    The weights of the least training loss are kept. Ctrl-C ends it early and keeps them as well.
    If the loss leaves the finite numbers, it begins again from the next seed, three times at most.
    On a CPU the same seed gives the same weights.

    Args:
        system: the model.
        config: the recipe.
        record: the samples of one episode and the initial estimate; NaN is a missing output.
        noise_std: standard deviation of the output noise in output units, shape (ny,) or one number
            for all; zero if None. The paper's recipe makes no use of it.
        log: where curves and figures go.
        checkpoint: a file to keep the training's state in, written again as it goes on.
        resume: go on from that file, exactly.
        progress: show a bar with the terms of the loss in the terminal.

    Raises:
        ValueError: in one line, if the record cannot be trained on, or the checkpoint is missing,
            damaged, or of another system, record or config (`Config` may differ in ``iterations``,
            ``budget``, ``checkpoint_every`` and ``log_every``).
        FloatingPointError: if the loss does not stay finite from any of four seeds.
    """
    _check(system, record, config)
    if resume and checkpoint is None:
        raise ValueError("resume=True without a checkpoint; name its file")
    noise = vector(0.0 if noise_std is None else noise_std, system.ny, "noise_std")
    run = _RUNS[config.optimiser](system, config, record, noise)
    if resume and checkpoint is not None:
        run.restore(checkpoint)
    try:
        with bar(config.iterations if progress else None) as show, interruption() as stopped:
            while not run.finished() and not (stopped and run.best):
                _iterate(run, log, checkpoint, show if progress else None)
        if checkpoint is not None and run.best is not None:
            run.save(checkpoint)
    except KeyboardInterrupt:  # amid a step: the last checkpoint stays as it is
        if run.best is None:
            raise
    trained = run.result()
    log_end(log, system, trained, run)
    return trained


def train_many(
    system: System,
    config: Config,
    *,
    record: Record,
    noise_std: Sequence[float] | float | None = None,
) -> list[Trained]:
    """Train PINN-Obs on each row of a record, of one episode each, with one seed; see `train`.

    With a GPU the fast recipe trains on all rows at once, each until its own patience, iterations
    or budget end it (of the CPU seconds of all); see `Config.device`. Otherwise it is one row after
    another, exactly as by `train`: on a CPU that is the fastest. After Ctrl-C rows keep the best
    weights that they have, be it those of their first iteration.

    Args:
        system: the model.
        config: the recipe.
        record: the samples of all episodes.
        noise_std: see `train`.
    """
    rows = [record.rows(slice(i, i + 1)) for i in range(record.batch)]
    for row in rows:
        _check(system, row, config)
    noise = vector(0.0 if noise_std is None else noise_std, system.ny, "noise_std")
    device, kind = _device(config), _RUNS[config.optimiser]
    with interruption() as stopped:
        if device != "cpu" and config.optimiser == "ssbroyden":
            runs = [kind(system, config, row, noise) for row in rows]
            advance(runs, device, stopped)
            return [run.result() for run in runs]
        found = []
        for row in rows:
            run = kind(system, config, row, noise)
            while not run.finished() and not (stopped and run.best):
                run.step()
            found.append(run.result())
        return found


def train_rows(
    system: System,
    config: Config,
    *,
    record: Record,
    noise_std: Sequence[float] | float | None = None,
    folder: Path | None = None,
) -> list[Trained]:
    """Train on each row of a record, and keep what comes of it in a folder if one is given.

    Args:
        system: the model.
        config: the recipe; its seed is that of every row.
        record: the samples of all episodes.
        noise_std: see `train`.
        folder: where a folder ``row-<i>`` per row goes, with its log, checkpoint and trained
            network, by `train`; without one nothing is kept, and `train_many` is used.
    """
    if folder is None:
        return train_many(system, config, record=record, noise_std=noise_std)
    found = []
    for i in range(record.batch):
        place = folder / f"row-{i}"
        with Log(place) as log:
            trained = train(
                system,
                config,
                record=record.rows(slice(i, i + 1)),
                noise_std=noise_std,
                log=log,
                checkpoint=place / "checkpoint.pt",
            )
        trained.save(place / "trained.pt")
        found.append(trained)
    return found


def _device(config: Config) -> str:
    there = torch.cuda.is_available()
    if config.device == "cuda" and not there:
        raise ValueError("device='cuda'; torch finds no GPU here")
    return "cuda" if there and config.device != "cpu" else "cpu"


def _iterate(
    run: Run, log: Log, checkpoint: Path | None, show: Callable[[int, str], None] | None
) -> None:
    """One iteration, and what is to be shown and kept of it."""
    config = run.config
    told = run.iteration % config.log_every == 0
    run.step()
    if told:
        log_terms(log, run)
        if show is not None:
            show(run.iteration, described(run))
    if checkpoint is not None and run.iteration % config.checkpoint_every == 0:
        run.save(checkpoint)


def _check(system: System, record: Record, config: Config) -> None:
    """Whether the record can be trained on."""
    name = type(system).__name__
    if (np.diff(record.t.astype(config.dtype)) <= 0).any():
        raise ValueError(
            f"sample times from t={record.t[0]} s on are the same in {config.dtype}; subtract the"
            " first, or use dtype float64"
        )
    if record.batch != 1:
        raise ValueError(f"the record holds {record.batch} episodes; PINN-Obs is trained on one")
    if record.num_samples < MIN_SAMPLES:
        raise ValueError(
            f"the record has {record.num_samples} samples; PINN-Obs needs {MIN_SAMPLES} or more"
        )
    sizes = (("y", record.y, system.ny), ("u", record.u, system.nu))
    for symbol, array, size in (*sizes, ("xhat0", record.prior.mean, system.nx)):
        if array.shape[-1] != size:
            raise ValueError(f"{symbol} has {array.shape[-1]} columns; {name} has n={size}")
    y = record.y[0]
    if np.isinf(y).any():
        raise ValueError(
            f"y holds infinite numbers; {name} needs finite ones, or NaN where missing"
        )
    there = [column[~np.isnan(column)] for column in y.T]
    if not any(len(column) and np.ptp(column) > 0 for column in there):
        raise ValueError(f"y of {name} does not vary over the record; there is nothing to learn")
