"""A gain shared by all episodes, trained on outputs and the model's equations over many of them.

What the true states were is never seen. Two things stand for them: the trajectories that explain
the outputs of whole records best (`smooth`), and the model. The gain is run over these records
online, its errors against the smoothed trajectories are propagated back in time through the model,
the covariance and the gain, and the outputs are drawn anew with noise of many levels, of which the
gain is told through R.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pinnobs_gym.estimators.pinn_gain import TrainedGain
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System, vector
from pinnobs_gym.training.log import SILENT, Log
from pinnobs_gym.training.loop import bar, interruption
from trainers.pinn_gain.checkpoint import restore, save
from trainers.pinn_gain.config import Config
from trainers.pinn_gain.run import Run

__all__ = ["Config", "train"]

MIN_SAMPLES = 10
"""The shortest records that are trained on."""


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
) -> TrainedGain:
    """Train a gain on the records of a batch of episodes.

    It begins as the EKF, and the weights of the least error on the records held out are kept, the
    first ones among them. Ctrl-C ends it early and keeps them as well. If the loss leaves the
    finite numbers for long, it begins again from the next seed, three times at most. On a CPU the
    same seed gives the same weights.

    Args:
        system: the model.
        config: the recipe.
        record: the samples of ``config.episodes`` episodes and their prior; NaN is a missing
            output.
        noise_std: standard deviation of the output noise in output units, shape (ny,) or one number
            for all; the benchmark's if None.
        log: where curves go.
        checkpoint: a file to keep the training's state in, written again as it goes on.
        resume: go on from that file, exactly.
        progress: show a bar with the loss in the terminal.

    Raises:
        ValueError: in one line, if the records cannot be trained on or the model does not explain
            them, or the checkpoint is missing, damaged, or of another system, record or config
            (`Config` may differ in ``iterations``, ``budget``, ``checkpoint_every`` and
            ``log_every``).
        FloatingPointError: if the loss does not stay finite from any of four seeds.
    """
    _check(system, record, config)
    if resume and checkpoint is None:
        raise ValueError("resume=True without a checkpoint; name its file")
    told = system.setups["benchmark"].noise_std if noise_std is None else noise_std
    run = Run(system, config, record, vector(told, system.ny, "noise_std"))
    if resume and checkpoint is not None:
        restore(run, checkpoint)
    try:
        with bar(config.iterations if progress else None) as show, interruption() as stopped:
            while not run.finished() and not stopped:
                run.step()
                if run.iteration % config.log_every == 0:
                    _log(log, run)
                    show(run.iteration, f"loss {run.value:.3g} held out {run.latest:.3f} of EKF's")
                if checkpoint is not None and run.iteration % config.checkpoint_every == 0:
                    save(run, checkpoint)
        if checkpoint is not None:
            save(run, checkpoint)
    except KeyboardInterrupt:  # amid a step: the last checkpoint stays as it is
        pass
    trained = run.result()
    log.hparams(
        {"system": trained.system, **trained.config},
        {"end/loss": trained.loss, "end/iterations": float(trained.iterations)},
    )
    return trained


def _log(log: Log, run: Run) -> None:
    assert run.best is not None
    log.scalar("loss/train", run.value, run.iteration)
    log.scalar("loss/gradient", run.gradient, run.iteration)
    log.scalar("loss/held_out", run.latest, run.iteration)
    log.scalar("loss/best", run.best.loss, run.iteration)


def _check(system: System, record: Record, config: Config) -> None:
    """Whether the record can be trained on."""
    name = type(system).__name__
    sizes = (("y", record.y, system.ny), ("u", record.u, system.nu))
    for symbol, array, size in (*sizes, ("xhat0", record.prior.mean, system.nx)):
        if array.shape[-1] != size:
            raise ValueError(f"{symbol} has {array.shape[-1]} columns; {name} has n={size}")
    if record.batch != config.episodes:
        raise ValueError(f"the record holds {record.batch} episodes; expected {config.episodes}")
    if record.num_samples < MIN_SAMPLES:
        raise ValueError(
            f"the records have {record.num_samples} samples; pinn_gain needs {MIN_SAMPLES} or more"
        )
    if np.isinf(record.y).any():
        raise ValueError(
            f"y holds infinite numbers; {name} needs finite ones, or NaN where missing"
        )
    if np.ptp(np.diff(record.t)) > 1e-6 * np.diff(record.t).mean():
        raise ValueError(
            "the records' sample times are irregular; pinn_gain trains on regular ones"
        )
