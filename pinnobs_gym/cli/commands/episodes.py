"""`episodes ...`: write records without truth, for estimators in other languages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro

from pinnobs_gym.cli.console import console, print_next, progress
from pinnobs_gym.cli.episode_texts import texts_of
from pinnobs_gym.cli.options import parse
from pinnobs_gym.envs.game import Game
from pinnobs_gym.scoring.episode_folder import is_there, write_folder
from pinnobs_gym.scoring.episode_table import Format
from pinnobs_gym.scoring.evaluation import seeds_of
from pinnobs_gym.scoring.issue import Issue
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.training.trainer import TRAINING_SEED


@dataclass(frozen=True)
class Episodes:
    """Write records of episodes as files, with the model as text, for estimators in any language.
    pinnobs score scores the estimates."""

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """New folder; of several systems, each has a folder of its name in it."""
    system: tuple[str, ...] = ()
    """Names or module:Class of the systems; all if none is named."""
    setup: str = "benchmark"
    """Setup to play."""
    condition: str = "nominal"
    """Condition, such as load_step, or noise5+dropout10."""
    episodes: int = 100
    """Number of episodes."""
    seed: int | None = None
    """Seed of the first episode; by default 0, and 1000000 for episodes with their truth."""
    with_truth: bool = False
    """Write the true states, too, of training episodes: of seeds from 1000000 on, which are never
    scored."""
    format: Format = "csv"
    """Format of the records; parquet needs the extra "parquet"."""

    def run(self) -> int:
        """Write the folders."""
        issues = self._issues()
        facts = {folder: issue.facts() for folder, issue in issues.items()}
        waiting = [folder for folder in issues if not is_there(folder, facts[folder])]
        texts = {folder: texts_of(issues[folder], facts[folder]) for folder in waiting}
        if waiting:
            with progress() as bar:
                total = sum(len(issues[folder].seeds) for folder in waiting)
                task = bar.add_task("episodes", total=total)
                for folder in waiting:
                    issue, count = issues[folder], partial(bar.advance, task)
                    write_folder(folder, issue, texts[folder], count)
        for folder, issue in issues.items():
            _report(folder, issue, facts[folder], folder in waiting)
        if not self.with_truth:
            first = next(iter(issues))
            brought = first / "estimates.csv"  # which the user's own program writes
            print_next("score", brought, "--name", "mine", "--track", "online")
        return 0

    def _issues(self) -> dict[Path, Issue]:
        """Return what each folder is to have."""
        names = list(dict.fromkeys(self.system or SYSTEMS.sources))
        first = (TRAINING_SEED if self.with_truth else 0) if self.seed is None else self.seed
        seeds = seeds_of(first, self.episodes)
        issues = {}
        for name in names:
            game = Game.of(name, self.setup, self.condition)
            own = seeds[:1] if game.source.deterministic else seeds
            if len(own) < len(seeds):
                console.print(
                    f"{name}: every episode of setup {self.setup!r} is the same: 1 is written",
                    soft_wrap=True,
                )
            system = type(game.source.system).__name__
            folder = self.out if len(names) == 1 else self.out / system
            if folder in issues:
                raise ValueError(f"system {name!r} is given twice; expected once")
            issues[folder] = Issue(game, own, self.format, self.with_truth)
        return issues


def _report(folder: Path, issue: Issue, facts: dict[str, Any], written: bool) -> None:
    """Print what a folder has."""
    files = " and ".join(issue.tables)
    text = f"{facts['episodes']} episodes of {facts['num_samples']} samples, {files}"
    there = "" if written else "; they were there already"
    console.print(f"{folder}: {text}{there}; README.md says more", soft_wrap=True, highlight=False)


def run(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    return parse(Episodes, "episodes", arguments).run()
