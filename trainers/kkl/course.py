"""The course of a training, and of a sweep of the cut-off."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pinnobs_gym.estimation.learned.trained_file import read
from pinnobs_gym.estimators.kkl import TrainedKKL
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System, vector
from pinnobs_gym.training.log import SILENT, Log
from pinnobs_gym.training.loop import bar, interruption
from trainers.kkl.run import Method, Run

MIN_SAMPLES = 20
"""Fewest samples of the record whose times are trained on."""
_TICKS = 1000
"""Steps of the progress bar."""
SWEEP = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""The cut-offs of a sweep, over that of the recipe."""
SWEEP_SHARE = 0.5
"""Part of a budget that a sweep takes."""
_SWEEP_STEPS = 120
"""Steps of each training of a sweep that no budget limits."""


def train(
    method: Method,
    system: System,
    config: Any,
    *,
    record: Record,
    noise_std: Sequence[float] | float | None = None,
    log: Log = SILENT,
    checkpoint: Path | None = None,
    resume: bool = False,
    progress: bool = False,
) -> TrainedKKL:
    """Train T and T* on simulated episodes of the model.

    Args:
        method: the trainer's; each trainer module has this function with its own filled in.
        system: the model.
        config: the recipe.
        record: whose sample times are trained on, and the prior.
        noise_std: standard deviation of the output noise; the benchmark setup's if None.
        log: where curves go.
        checkpoint: file that progress is kept in.
        resume: go on from that file.
        progress: show a bar.

    Raises:
        ValueError: in one line, if the recipe gives no observer of the system, or the checkpoint is
            of another one.
    """
    _check(system, record)
    if resume and checkpoint is None:
        raise ValueError("resume=True without a checkpoint; name its file")
    told = system.setups["benchmark"].noise_std if noise_std is None else noise_std
    std = vector(told, system.ny, "noise_std")

    gap = method.gap(config, system, record)

    def make(config: Any) -> Run:
        return Run(method, system, config, record, std, gap)

    if resume and checkpoint is not None:
        run = make(_as_swept(config, checkpoint))
        run.restore(checkpoint)
    else:
        found = sweep(make, config, system, log, progress) if config.sweep == "cutoff" else []
        if found:
            cutoff = min(found, key=lambda point: point["loss"])["cutoff"]
            left = None if config.budget is None else config.budget * (1 - SWEEP_SHARE)
            config = replace(config, cutoff=cutoff, budget=left)
        run = make(config)
        run.facts["sweep"] = found
    try:
        with bar(_TICKS if progress else None) as show, interruption() as stopped:
            while not run.finished() and not stopped:
                run.step()
                steps = run.iterations
                if run.finished() or steps % config.log_every == 0:
                    _log(log, run)
                    show(round(_TICKS * run.done), f"{run.stage}: held out {run.latest:.3g}")
                if checkpoint is not None and steps % config.checkpoint_every == 0:
                    run.save(checkpoint)
        if checkpoint is not None:
            run.save(checkpoint)
    except KeyboardInterrupt:  # amid a step: the last checkpoint stays as it is
        pass
    trained = run.result()
    log.hparams(
        {"system": trained.system, **trained.config},
        {"end/loss": trained.loss, "end/iterations": float(trained.iterations)},
    )
    return trained


def sweep(
    make: Callable[[Any], Run], config: Any, system: System, log: Log, progress: bool
) -> list[dict[str, float]]:
    """Short trainings at several cut-offs, one after another.

    Returns:
        For each its ``cutoff`` in Hz; the ``loss`` that cut-offs are chosen by; the NRMSE at the
        end of an episode without (``clean``) and with noise (``noisy``), their difference in
        squares (``noise_gain``, over the NRMSE of the outputs' own noise); and the time in s after
        which the error stays below twice that at the end (``convergence``).
    """
    found = []
    budget = None if config.budget is None else config.budget * SWEEP_SHARE / len(SWEEP)
    steps = min(config.iterations, _SWEEP_STEPS)
    with bar(len(SWEEP) if progress else None) as show:
        for number, factor in enumerate(SWEEP):
            cutoff = factor * config.cutoff_for(system)
            run = make(replace(config, cutoff=cutoff, iterations=steps, budget=budget))
            while not run.finished():
                run.step()
            found.append({"cutoff": cutoff, "loss": run.best["T*"].error, **run.traded()})
            for name, value in found[-1].items():
                log.scalar(f"sweep/{name}", value, number)
            show(number + 1, f"cut-off {cutoff:.3g} Hz: {found[-1]['noisy']:.3g}")
    return found


def _as_swept(config: Any, checkpoint: Path) -> Any:
    """The recipe with the cut-off that a checkpoint's sweep found."""
    if config.sweep == "none":
        return config
    try:
        facts = json.loads(read(checkpoint)["checkpoint"])
        return replace(config, cutoff=facts["config"]["cutoff"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{checkpoint} is not a checkpoint of this trainer: {error}") from None


def _log(log: Log, run: Run) -> None:
    name = {"T": "T", "T*": "T_star"}.get(run.stage, "T_star")
    log.scalar(f"loss/{name}", run.fit.loss, run.fit.iteration)
    log.scalar(f"loss/{name}_held_out", run.latest, run.fit.iteration)


def _check(system: System, record: Record) -> None:
    if system.measured_input:
        raise ValueError(
            f"{type(system).__name__} has a measured input; a KKL observer is trained on simulated "
            "episodes and needs u(t) to be known beforehand"
        )
    if record.num_samples < MIN_SAMPLES:
        raise ValueError(
            f"the record has {record.num_samples} samples; a KKL observer needs {MIN_SAMPLES}"
        )
