"""`train TRAINER ...`: train an estimator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import tyro

from pinnobs_gym.cli.console import console
from pinnobs_gym.cli.options import by_option, parse
from pinnobs_gym.cli.output import write_figure
from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.files import check_writable, file_name
from pinnobs_gym.registry import TRAINERS, trainer_name
from pinnobs_gym.scoring import acceptance
from pinnobs_gym.scoring.playing import Played, play
from pinnobs_gym.training.by_name import load, trainer_of
from pinnobs_gym.training.log import Log
from pinnobs_gym.training.loop import train
from pinnobs_gym.training.trainer import Trainer, first_episode

ConfigType = TypeVar("ConfigType")


@dataclass(frozen=True)
class Train(Generic[ConfigType]):
    """Train an estimator on episodes of a system; the trainer's settings determine how many."""

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
    out: Path = Path("runs/train")
    """Folder of checkpoints, trained files, figures and TensorBoard log."""
    resume: bool = False
    """Continue from an existing checkpoint."""


def run(arguments: Sequence[str]) -> int:
    """Train with the trainer named first, and return the command's exit status."""
    if not arguments or arguments[0].startswith("-"):
        raise ValueError(f"name a trainer first: pinnobs train {' | '.join(TRAINERS.sources)}")
    spec = arguments[0]
    cls = TRAINERS.resolve(spec)
    chosen = _chosen_training(cls, spec, arguments[1:])
    estimators = _estimators_of(cls)
    check_writable(chosen.out)
    game = Game.of(chosen.system, chosen.setup, chosen.condition)
    title = game.name.file_stem
    seed = chosen.config.seed
    episode = first_episode(seed) if chosen.episode is None else chosen.episode
    stem = chosen.out / f"{title}-{file_name(cls.name)}-episode{episode}-seed{seed}"
    checkpoint = stem.with_name(stem.name + ".checkpoint.pt")
    path = stem.with_name(stem.name + ".pt")
    for earlier in (checkpoint, path):
        if earlier.exists() and not chosen.resume:
            raise ValueError(
                f"{earlier} already exists; --resume continues it, --out names another folder"
            )
    trainer = trainer_of(cls, chosen.config, game, episode)
    with Log(chosen.out / "tensorboard" / stem.name) as log:
        result = train(trainer, log=log, checkpoint=checkpoint, resume=chosen.resume, progress=True)
    result.save(path)
    pictures = trainer.figures(result)
    for kind, figure in pictures.items():
        write_figure(stem.with_name(f"{stem.name}-{kind}.png"), figure)
    by = {"budget": ", all of its budget", "interrupted": "; stopped by Ctrl-C"}
    console.print(
        f"loss {result.loss:.3g} after {result.iterations} iterations, {result.seconds:.1f} CPU s"
        + by.get(result.ending, "")
    )
    for kind in pictures:
        console.print(f"picture: {stem.with_name(f'{stem.name}-{kind}.png')}", soft_wrap=True)
    for label, kind_of in estimators.items():
        estimator = load(kind_of, path, game)
        own = _report_training(label, estimator, game, episode, result.loss)
        picture = stem.with_name(f"{stem.name}-{label}.png")
        write_figure(picture, own.figure(f"{label}: {title}"))
        console.print(f"picture: {picture}", soft_wrap=True)
    console.print(f"trained file: {path}", soft_wrap=True)
    if checkpoint.exists():
        console.print(f"checkpoint: {checkpoint} (--resume continues it)", soft_wrap=True)
    console.print(f"TensorBoard: {chosen.out / 'tensorboard'}", soft_wrap=True)
    return 0


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
        config=(tyro.conf.OmitArgPrefixes,),
        description=f"{Train.__doc__} Presets: {', '.join(cls.presets)}.",
    )


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
    if estimator.track == "online" and (message := acceptance.warning(loss, replays[0].scores)):
        console.print(f"warning: {message}", style="yellow")
    return replays[0].played
