"""`score FILE ...`: score estimates that were made elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from pinnobs_gym.cli.console import console, print_next
from pinnobs_gym.cli.options import parse
from pinnobs_gym.cli.scored import report, rows_file, with_progress
from pinnobs_gym.files import check_writable
from pinnobs_gym.leaderboard.published.reading import published_floors
from pinnobs_gym.scoring.episode_folder import read_folder
from pinnobs_gym.scoring.evaluation import Results
from pinnobs_gym.scoring.submitted import (
    Claim,
    Submission,
    check_name,
    read_estimates,
    score_submission,
)


@dataclass(frozen=True)
class Score:
    """Score estimates of the records that pinnobs episodes wrote. The file has the columns episode,
    t, one per state by its name and, optionally, <state>_std."""

    file: Annotated[Path, tyro.conf.Positional]
    """The estimates, as CSV or, by the suffix, Parquet."""
    name: str
    """Name of the estimator in tables."""
    track: Claim
    """Whether an estimate was made of the outputs up to its own sample alone (online) or of the
    whole record (offline). This is not checked."""
    records: Path | None = None
    """Folder of the records; that of the file by default."""
    knows: tuple[str, ...] = ("model", "prior", "noise")
    """What the estimator was told beside the records, or was trained with."""
    system: str | None = None
    """module:Class of the system, if it is your own."""
    out: Path = Path("runs/evaluate")
    """Folder of rows and TensorBoard log."""

    def run(self) -> int:
        """Check all, score and print."""
        check_name(self.name)
        if not self.file.is_file():
            raise ValueError(f"there is no file {self.file}")
        game, seeds = read_folder(self.records or self.file.parent, self.system)
        estimates = read_estimates(self.file, game, seeds)
        submission = Submission(self.name, seeds, estimates, self.track, self.knows)
        shipped = published_floors([game.name])
        check_writable(self.out)
        score = partial(score_submission, game, submission, Results(rows_file(self.out)))
        evaluated = with_progress(len(seeds), score)
        report(game, evaluated, self.out, picture=len(seeds) > 1, shipped=shipped)
        console.print(
            f"track {submission.track!r}: whether the estimates are causal cannot be checked, so "
            "that they are ranked among submitted ones alone",
            soft_wrap=True,
            highlight=False,
        )
        print_next("tables", rows_file(self.out))
        return 0


def run(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    return parse(Score, "score", arguments).run()
