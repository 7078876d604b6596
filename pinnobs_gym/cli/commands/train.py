"""`train TRAINER ...`: train an estimator."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import tyro

from pinnobs_gym.cli.console import console, print_next, print_table
from pinnobs_gym.cli.options import LOG_OPTIONS, by_option, check_apart, parse
from pinnobs_gym.cli.output import write_figure
from pinnobs_gym.cli.own_model import ModelOptions
from pinnobs_gym.cli.training_task import Task, on_episodes, on_logs
from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.files import CannotWrite, check_writable
from pinnobs_gym.leaderboard.grid import Column, Grid
from pinnobs_gym.logs.reading import read_log
from pinnobs_gym.registry import TRAINERS, trainer_name
from pinnobs_gym.scoring import acceptance
from pinnobs_gym.scoring.playing import Played, play
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.training.by_name import load
from pinnobs_gym.training.log import Log
from pinnobs_gym.training.loop import train
from pinnobs_gym.training.trainer import Trainer

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pinnobs_gym.estimation.learned.trained import Trained

ConfigType = TypeVar("ConfigType")
_SIMULATED = ("--setup", "--condition", "--episode", "--episodes")
"""Options of simulated episodes."""


@dataclass(frozen=True)
class Train(Generic[ConfigType]):
    """Train an estimator on episodes of a system; the trainer's settings determine how many. Or,
    with --log, on sensor logs."""

    system: str
    """Name or module:Class of the system."""
    config: ConfigType
    """The trainer's settings."""
    preset: str
    """Preset that defines the settings not given."""
    setup: str = "benchmark"
    """Setup to play."""
    condition: str = "nominal"
    """Condition, such as load_step."""
    episode: int | None = None
    """Seed of the training episode, or of the first of several; by default those of each training
    seed are its own."""
    log: tuple[Path, ...] = ()
    """Sensor logs to learn from in place of simulated episodes: CSV files as for pinnobs estimate,
    several of them with the same sample times. For trainers that learn from outputs alone."""
    columns: tuple[str, ...] = ()
    """Columns of the logs under other names or in other units, such as t=millis*1e-3."""
    model: ModelOptions = field(default_factory=ModelOptions)
    """Of logs: what the model is told."""
    out: Path = Path("runs/train")
    """Folder of checkpoints, trained files, figures and TensorBoard log."""
    resume: bool = False
    """Continue from an existing checkpoint."""


def run(arguments: Sequence[str]) -> int:
    """Train with the trainer named first, and return the command's exit status."""
    if arguments and arguments[0] in ("-h", "--help"):
        print_table([[listing()]])
        console.print("pinnobs train TRAINER --help lists the settings of one.", soft_wrap=True)
        print_next("train", "kkl_pinn", "--system", "ReverseDuffing", "--budget", 45)
        return 0
    if not arguments or arguments[0].startswith("-"):
        raise ValueError(f"name a trainer first: pinnobs train {' | '.join(TRAINERS.sources)}")
    spec = arguments[0]
    cls = TRAINERS.resolve(spec)
    check_apart(arguments[1:], _SIMULATED, LOG_OPTIONS)
    chosen = _chosen_training(cls, spec, arguments[1:])
    estimators = _estimators_of(cls)
    check_writable(chosen.out)
    task = _task(cls, chosen)
    path, checkpoint = task.file(".pt"), task.file(".checkpoint.pt")
    for earlier in (checkpoint, path):
        if earlier.exists() and not chosen.resume:
            raise ValueError(
                f"{earlier} already exists; --resume continues it, --out names another folder"
            )
    console.print("preparing: simulated episodes, and what is computed once", highlight=False)
    trainer = task.make()
    with Log(chosen.out / "tensorboard" / task.stem.name) as log:
        result = train(trainer, log=log, checkpoint=checkpoint, resume=chosen.resume, progress=True)
    _save(result, path, checkpoint)
    by = {"budget": ", all of its budget", "interrupted": "; stopped by Ctrl-C"}
    console.print(
        f"loss {result.loss:.3g} after {result.iterations} iterations, {result.seconds:.1f} CPU s"
        + by.get(result.ending, "")
    )
    for kind, figure in trainer.figures(result).items():
        _write_picture(task.file(f"-{kind}.png"), figure)
    if task.game is not None:
        for label, kind in estimators.items():
            picture = task.file(f"-{label}.png")
            _replay(label, kind, path, task.game, task.episode, result.loss, picture)
    console.print(f"trained file: {path}", soft_wrap=True)
    if checkpoint.exists():
        console.print(f"checkpoint: {checkpoint} (--resume continues it)", soft_wrap=True)
    console.print(f"TensorBoard: {chosen.out / 'tensorboard'}", soft_wrap=True)
    if result.ending == "interrupted" and checkpoint.exists():
        print_next("train", *(each for each in arguments if each != "--resume"), "--resume")
        return 0
    online = [label for label, kind in estimators.items() if kind.track == "online"]
    if task.game is not None and online:
        setup, condition = task.game.name.setup, task.game.name.condition
        also = [] if setup == "benchmark" else ["--setup", setup]
        also += [] if condition == "nominal" else ["--condition", condition]
        chosen_one = ["--system", chosen.system, *also, "--estimator", online[0]]
        print_next("evaluate", *chosen_one, "--trained", path)
    return 0


def listing() -> Grid:
    """Return the table of trainers, with the estimators that need each."""
    columns = tuple(Column(each, numeric=False) for each in ("trainer", "trains", "what it does"))
    lines = []
    for name, cls in TRAINERS.classes().items():
        what = (inspect.getdoc(cls) or "").partition("\n\n")[0].replace("\n", " ").replace("`", "")
        trained = ", ".join(_estimators_of(cls))
        lines.append((name, trained, what))
    return Grid("usage: pinnobs train TRAINER --system NAME ...", columns, tuple(lines))


def _save(result: Trained, path: Path, checkpoint: Path) -> None:
    """Write the result of a training.

    Raises:
        CannotWrite: in one line, if it cannot be written; the line says what is left of it.
    """
    try:
        result.save(path)
    except CannotWrite as error:
        left = f"; {checkpoint} is kept, and --resume goes on from it"
        raise CannotWrite(f"{error}{left if checkpoint.exists() else ''}") from None


def _write_picture(path: Path, figure: Figure) -> None:
    """Write a picture of a training and print its path; or, if it cannot be written, why not."""
    try:
        write_figure(path, figure)
    except CannotWrite as error:
        console.print(f"warning: no picture: {error}", style="yellow", soft_wrap=True)
    else:
        console.print(f"picture: {path}", soft_wrap=True)


def _task(cls: type[Trainer[Any, Any]], chosen: Train[Any]) -> Task:
    """Return what is learned from."""
    if not chosen.log:
        game = Game.of(chosen.system, chosen.setup, chosen.condition)
        return on_episodes(cls, chosen.config, game, chosen.episode, chosen.out)
    system, setup = chosen.model.told(chosen.system)
    prior = Prior.of(system, setup, 1)
    logs = [read_log(path, system, prior, chosen.columns) for path in chosen.log]
    for note in (note for log in logs for note in log.notes):
        console.print(note, soft_wrap=True, highlight=False)
    return on_logs(cls, chosen.config, setup, logs, chosen.out)


def _estimators_of(trainer: type[Trainer[Any, Any]]) -> dict[str, type[BaseEstimator]]:
    """Return the estimators that need a trainer, by name: registered ones, and those beside it."""
    known = {**ESTIMATORS.classes(), **ESTIMATORS.beside(trainer)}
    return {name: cls for name, cls in known.items() if trainer_name(cls) == trainer.name}


def _chosen_training(
    cls: type[Trainer[Any, Any]], spec: str, arguments: Sequence[str]
) -> Train[Any]:
    """Parse the command line of a training, with the preset's values as defaults."""
    given = [v for option, values in by_option(arguments) if option == "--preset" for v in values]
    preset = given[0] if given else next(iter(cls.presets))
    config = cls.configured({"preset": preset})
    kind: Any = Train[type(config)]
    return parse(
        kind,
        f"train {spec}",
        arguments,
        default=Train(system=tyro.MISSING, config=config, preset=preset),
        description=f"{Train.__doc__} Presets: {', '.join(cls.presets)}.",
    )


def _replay(
    label: str,
    kind: type[BaseEstimator],
    path: Path,
    game: Game,
    episode: int,
    loss: float,
    picture: Path,
) -> None:
    """Print the scores of a trained estimator's replays, and draw that of its own record."""
    estimator = load(kind, path, game)
    own = _report_training(label, estimator, game, episode, loss)
    _write_picture(picture, own.figure(f"{label}: {game.name.file_stem}"))


def _report_training(
    label: str, estimator: BaseEstimator, game: Game, episode: int, loss: float
) -> Played:
    """Print the scores of a trained estimator's replays, and return that of its own record."""
    if estimator.track == "online":
        replays = acceptance.replays(estimator, game, episode)
    else:
        replays = [acceptance.Replay("own record", play(game, estimator, [episode]))]
    for replay in replays:
        row = replay.scores
        console.print(
            f"{label} on {replay.name}: RMSE {row['rmse']:.4g}, NRMSE {row['nrmse']:.4g}, "
            f"last 25 % {row['nrmse_tail']:.4g}",
            highlight=False,
        )
    if estimator.track == "online":
        if (found := acceptance.elsewhere(estimator, game)) is not None:
            console.print(f"{label} is {found.line}", highlight=False, soft_wrap=True)
        if message := acceptance.warning(loss, replays[0].scores):
            console.print(f"warning: {message}", style="yellow")
    return replays[0].played
