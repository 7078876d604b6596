"""`train TRAINER ...`: train an estimator."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Generic, TypeVar

import tyro

from pinnobs_gym import registry
from pinnobs_gym.cli.console import console
from pinnobs_gym.cli.options import parse
from pinnobs_gym.cli.output import write_figure
from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.estimator import Estimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.files import check_writable
from pinnobs_gym.scoring import acceptance
from pinnobs_gym.scoring.playing import Played, play
from pinnobs_gym.training import by_name
from pinnobs_gym.training.log import Log

ConfigType = TypeVar("ConfigType")


@dataclass(frozen=True)
class Train(Generic[ConfigType]):
    """Train an estimator on episodes of a system, as many as its recipe says."""

    system: str
    """Name or module:Class of the system."""
    config: ConfigType
    """The trainer's choices."""
    setup: str = "benchmark"
    """Setup that is played."""
    condition: str = "nominal"
    """Condition, such as load_step."""
    episode: int = by_name.TRAINING_SEED
    """Seed of the episode that is learned from, or of the first of several."""
    out: Path = Path("runs/train")
    """Folder of checkpoints, trained files, pictures and TensorBoard log."""
    resume: bool = False
    """Go on from the checkpoint that is there."""


def run(arguments: Sequence[str]) -> int:
    """Train with the trainer named first; returns the command's exit status."""
    if not arguments or arguments[0].startswith("-"):
        raise ValueError(f"name a trainer first: pinnobs train {' | '.join(registry.trainers())}")
    name = arguments[0]
    module = registry.trainer(name)
    chosen = _chosen_training(name, module.Config, arguments[1:])
    check_writable(chosen.out)
    game = Game.of(chosen.system, chosen.setup, chosen.condition)
    title = game.name.file_stem
    stem = chosen.out / f"{title}-{name}-episode{chosen.episode}-seed{chosen.config.seed}"
    checkpoint = stem.with_name(stem.name + ".checkpoint.pt")
    path = stem.with_name(stem.name + ".pt")
    for earlier in (checkpoint, path):
        if earlier.exists() and not chosen.resume:
            raise ValueError(
                f"{earlier} is there already; --resume goes on with it, --out names another folder"
            )
    with Log(chosen.out / "tensorboard" / stem.name) as log:
        result = by_name.train(
            name,
            chosen.config,
            game,
            chosen.episode,
            log=log,
            checkpoint=checkpoint,
            resume=chosen.resume,
            progress=True,
        )
        result.save(path)
        pictures = {}
        if hasattr(module, "figures"):
            pictures = module.figures(game.source.system, result, game.record([chosen.episode]))
        for kind, figure in pictures.items():
            log.figure(f"trained/{kind}", figure, result.iterations)
            write_figure(stem.with_name(f"{stem.name}-{kind}.png"), figure)
    console.print(
        f"loss {result.loss:.3g} after {result.iterations} iterations, {result.seconds:.1f} CPU s"
    )
    for kind in pictures:
        console.print(f"picture: {stem.with_name(f'{stem.name}-{kind}.png')}", soft_wrap=True)
    for label, cls in ESTIMATORS.classes().items():
        if cls.needs_training == name:
            estimator = by_name.load(cls, path, game)
            own = _report_training(label, estimator, game, chosen.episode, result.loss)
            picture = stem.with_name(f"{stem.name}-{label}.png")
            write_figure(picture, own.figure(f"{label}: {title}"))
            console.print(f"picture: {picture}", soft_wrap=True)
    console.print(f"trained file: {path}", soft_wrap=True)
    if checkpoint.exists():
        console.print(f"checkpoint: {checkpoint} (go on with --resume)", soft_wrap=True)
    console.print(f"TensorBoard: {chosen.out / 'tensorboard'}", soft_wrap=True)
    return 0


def _chosen_training(name: str, config: type, arguments: Sequence[str]) -> Train[Any]:
    """The command line of a training; what a preset says is its default."""
    make: Callable[[], Any] = config
    for option, value in pairwise(arguments):
        if option == "--preset":
            make = partial(config, preset=value)
    default = Train(system=tyro.MISSING, config=make())
    kind: Any = Train[type(default.config)]
    return parse(
        kind, f"train {name}", arguments, default=default, config=(tyro.conf.OmitArgPrefixes,)
    )


def _report_training(
    label: str, estimator: Estimator, game: Game, episode: int, loss: float
) -> Played:
    """Print how a trained estimator does; returns what it makes of its own record."""
    if estimator.track == "online":
        found = acceptance.replays(estimator, game, episode)
    else:
        found = [acceptance.Replay("own record", play(game, estimator, [episode]))]
    for replay in found:
        row = replay.scores
        console.print(
            f"{label} on {replay.name}: RMSE {row['rmse']:.4g}, NRMSE {row['nrmse']:.4g}, "
            f"last 25 % {row['nrmse_tail']:.4g}",
            highlight=False,
        )
    if estimator.track == "online" and (told := acceptance.warning(loss, found[0].scores)):
        console.print(f"warning: {told}", style="yellow")
    return found[0].played
