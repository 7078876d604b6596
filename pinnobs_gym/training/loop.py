"""The training loop: progress, log, checkpoints, resumption, budget and Ctrl-C of every trainer."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from pinnobs_gym.estimation.learned.trained import Trained
from pinnobs_gym.training.checkpoint import load_checkpoint, save_checkpoint
from pinnobs_gym.training.log import SILENT, Log
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
    """Run a training to its end, and return the best of what was trained.

    The first Ctrl-C ends it after the iteration, a second one amid it; what is best so far is kept
    in both cases, and the trained object says so in ``ending``. On a CPU the same seed gives the
    same weights, unless a budget ends the training.

    Args:
        trainer: the training, which may have begun.
        log: where curves, figures and settings go.
        checkpoint: a file that the training's state is kept in, written again as it goes on.
        resume: go on from that file, exactly.
        progress: show a bar in the terminal.

    Raises:
        ValueError: in one line, if the checkpoint is missing, damaged, or of another training: of
            another system, record or config (settings that only decide when training ends may
            differ, see `TrainingConfig.may_change`).
        FloatingPointError: in one line, if no loss was finite.
    """
    if resume:
        if checkpoint is None:
            raise ValueError("resume=True without a checkpoint; name its file")
        load_checkpoint(trainer, checkpoint)
    config = trainer.config
    try:
        with _bar(progress) as show, deferred_interrupt() as interrupt:
            while not ended_now(trainer, interrupt):
                trainer.step()
                if trainer.iteration % config.log_every == 0 or trainer.finished():
                    _show(trainer, log, show if progress else None)
                if checkpoint is not None and trainer.iteration % config.checkpoint_every == 0:
                    save_checkpoint(trainer, checkpoint)
        if checkpoint is not None:
            save_checkpoint(trainer, checkpoint)
    except KeyboardInterrupt:  # amid an iteration: the last checkpoint stays as it is
        if not trainer.iteration:
            raise
        trainer.ending = "interrupted"
    trained = trainer.result()
    if log.active:
        _log_end(trainer, trained, log)
    return trained


class Interrupt:
    """Whether Ctrl-C was pressed."""

    requested = False


_active: list[Interrupt] = []
"""The interrupt that the outermost `deferred_interrupt` of this process waits for."""


@contextmanager
def deferred_interrupt() -> Iterator[Interrupt]:
    """Defer the first Ctrl-C to the end of the iteration; a second one interrupts at once.

    Within another such context the outer one's interrupt is returned. In other threads than the
    main one, and where Ctrl-C has another handler than Python's, nothing is deferred.
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

    signal.signal(signal.SIGINT, handle)
    _active.append(interrupt)
    try:
        yield interrupt
    finally:
        _active.clear()
        signal.signal(signal.SIGINT, signal.default_int_handler)


def ended_now(trainer: Trainer[Any, Any], interrupt: Interrupt) -> bool:
    """Whether a training ends now, which its ``ending`` then says. At least one iteration is
    made."""
    config, begun = trainer.config, trainer.iteration > 0
    if trainer.finished():
        trainer.ending = "finished"
    elif begun and interrupt.requested:
        trainer.ending = "interrupted"
    elif begun and not trainer.paced_by_budget and config.budget is not None:
        trainer.ending = "budget" if trainer.seconds >= config.budget else "running"
    return trainer.ending != "running"


Show = Callable[[float, int, str], None]


def _show(trainer: Trainer[Any, Any], log: Log, show: Show | None) -> None:
    """Log the curves, and move the bar."""
    if log.active:
        for tag, value in trainer.curves().items():
            log.scalar(tag, value, trainer.iteration)
    if show is not None:
        show(trainer.progress(), trainer.iteration, trainer.status())


def _log_end(trainer: Trainer[Any, TrainedT], trained: TrainedT, log: Log) -> None:
    """Log the pictures of what was trained, and a line of the HPARAMS table."""
    for name, figure in trainer.figures(trained).items():
        log.figure(f"trained/{name}", figure, trainer.iteration)
    settings = {"system": trained.system, **trained.config}
    metrics = {"end/loss": trained.loss, "end/iterations": float(trained.iterations)}
    log.hparams(settings, metrics)


@contextmanager
def _bar(shown: bool) -> Iterator[Show]:
    """A progress bar in the terminal, as a function of the part that is done, the iterations and a
    description; one that does nothing if it is not to be shown."""
    if not shown:
        yield lambda part, iteration, description: None
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.fields[iteration]} iterations"),
        BarColumn(bar_width=20),
        TextColumn("{task.description}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns) as progress:
        task = progress.add_task("", total=1.0, iteration=0)
        yield lambda part, iteration, description: progress.update(
            task, completed=part, iteration=iteration, description=description
        )
