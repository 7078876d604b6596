"""The training loop of all trainers: progress bar, log, checkpoints, budget and Ctrl-C."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any, TypeVar

from pinnobs_gym.estimation.learned.trained import Trained
from pinnobs_gym.files import CannotWrite
from pinnobs_gym.simulation.notices import say_first
from pinnobs_gym.training.checkpoint import load_checkpoint, save_checkpoint
from pinnobs_gym.training.log import HPARAMS, SILENT, Log
from pinnobs_gym.training.progress import Show, shown_progress
from pinnobs_gym.training.trainer import Trainer

TrainedT = TypeVar("TrainedT", bound=Trained)


def train(
    trainer: Trainer[Any, TrainedT],
    *,
    log: Log = SILENT,
    checkpoint: Path | None = None,
    resume: bool = False,
    progress: bool = False,
) -> TrainedT:
    """Train until the end, and return the best trained object.

    The first Ctrl-C ends the training after the current iteration, a second one at once. In both
    cases the best weights so far are returned, with ``ending`` "interrupted". On a CPU the same
    seed gives the same weights, unless a budget or Ctrl-C ends the training.

    Args:
        trainer: the trainer, which may have made iterations already.
        log: destination of curves, figures and settings.
        checkpoint: file of the training's state, rewritten every ``checkpoint_every`` iterations
            and at the end; where that fails, a line is logged, and the training goes on.
        resume: resume from the checkpoint, exactly unless the trainer says otherwise.
        progress: show a progress bar in the terminal, or elsewhere a line now and then. It shows
            the fraction of the iterations or of the budget, whichever ends the training first.

    Raises:
        ValueError: in one line, if the checkpoint is missing, damaged, or of another training: of
            another system, record or config (some settings may differ, see
            `TrainingConfig.may_change`).
        FloatingPointError: in one line, if no loss was finite.
        KeyboardInterrupt: if Ctrl-C interrupts the first iteration.
    """
    if resume:
        if checkpoint is None:
            raise ValueError("resume=True without a checkpoint; name its file")
        load_checkpoint(trainer, checkpoint)
    config, shown = trainer.config, -1
    trainer.ending = "running"
    try:
        with (
            shown_progress() if progress else nullcontext() as show,
            deferred_interrupt() as interrupt,
        ):
            while not ended_now(trainer, interrupt):
                trainer.step()
                if trainer.iteration % config.log_every == 0:
                    _show(trainer, log, show)
                    shown = trainer.iteration
                if checkpoint is not None and trainer.iteration % config.checkpoint_every == 0:
                    _save(trainer, checkpoint)
            if trainer.iteration not in (0, shown):
                _show(trainer, log, show)
        if checkpoint is not None:
            _save(trainer, checkpoint)
    except KeyboardInterrupt:  # within an iteration: the last checkpoint stays valid
        if not trainer.iteration:
            raise
        trainer.ending = "interrupted"
    trained = trainer.result()
    if log.active:
        _log_end(trainer, trained, log)
    return trained


def _save(trainer: Trainer[Any, Any], checkpoint: Path) -> None:
    """Write a checkpoint. If it cannot be written, the training goes on, and the one before stays;
    a line is logged, once in each process."""
    try:
        save_checkpoint(trainer, checkpoint)
    except CannotWrite as error:
        kept = ", and the checkpoint before is kept" if checkpoint.exists() else ""
        say_first("checkpoint", f"{error}; the training goes on{kept}")


class Interrupt:
    """A flag that is set when Ctrl-C is pressed."""

    requested = False


_active: list[Interrupt] = []
"""The interrupt of the outermost `deferred_interrupt` of this process, if one is active."""


@contextmanager
def deferred_interrupt() -> Iterator[Interrupt]:
    """Defer the first Ctrl-C to the end of the iteration; a second one interrupts at once.

    A nested context yields the interrupt of the outer one. Nothing is deferred outside the main
    thread, or if a handler other than Python's default is installed for SIGINT.
    """
    if _active:
        yield _active[0]
        return
    interrupt = Interrupt()
    in_main = threading.current_thread() is threading.main_thread()
    if not in_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield interrupt
        return

    def handle(number: int, frame: object) -> None:
        if interrupt.requested:
            raise KeyboardInterrupt
        interrupt.requested = True
        with suppress(OSError, ValueError):  # a closed stream
            sys.stderr.write("\nstopping after this iteration; Ctrl-C again stops at once\n")

    signal.signal(signal.SIGINT, handle)
    _active.append(interrupt)
    try:
        yield interrupt
    finally:
        _active.clear()
        signal.signal(signal.SIGINT, signal.default_int_handler)


def ended_now(trainer: Trainer[Any, Any], interrupt: Interrupt) -> bool:
    """Set the trainer's ``ending``, and return whether the training is over.

    The budget and Ctrl-C take effect after the first iteration at the earliest.
    """
    started, budget = trainer.iteration > 0, trainer.config.budget
    spent = budget is not None and trainer.seconds >= budget
    if trainer.finished():
        # A schedule that fits the budget is finished when that is spent.
        trainer.ending = "budget" if spent and trainer.paced_by_budget else "finished"
    elif started and interrupt.requested:
        trainer.ending = "interrupted"
    elif started and spent and not trainer.paced_by_budget:
        trainer.ending = "budget"
    return trainer.ending != "running"


def _show(trainer: Trainer[Any, Any], log: Log, show: Show | None) -> None:
    """Log the curves, and update the progress bar."""
    if log.active:
        for tag, value in trainer.curves().items():
            log.scalar(tag, value, trainer.iteration)
    if show is not None:
        budget = trainer.config.budget
        part = trainer.progress()
        if budget is not None and not trainer.paced_by_budget:
            part = max(part, min(trainer.seconds / budget, 1.0))  # whichever ends it first
        show(part, f"{trainer.iteration} iterations, {trainer.status()}")


def _log_end(trainer: Trainer[Any, TrainedT], trained: TrainedT, log: Log) -> None:
    """Log the figures of the trained object, and its row of the HPARAMS table."""
    for name, figure in trainer.figures(trained).items():
        log.figure(f"trained/{name}", figure, trainer.iteration)
    settings = {HPARAMS["estimator"]: trainer.name, HPARAMS["system"]: trained.system}
    settings |= trained.config
    metrics = {"end/loss": trained.loss, "end/iterations": float(trained.iterations)}
    log.hparams(settings, metrics)
