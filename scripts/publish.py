"""Play the published leaderboard and pack its results into the package.

Every training is done for five seeds. A run that is stopped goes on where it ended, and a run of
which everything is stored only packs.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from pinnobs_gym.cli import guarded
from pinnobs_gym.cli.commands.leaderboard import Leaderboard
from pinnobs_gym.cli.console import console
from pinnobs_gym.cli.options import parse
from pinnobs_gym.files import check_writable
from pinnobs_gym.leaderboard.published import manifest
from pinnobs_gym.leaderboard.published.packing import pack
from pinnobs_gym.scoring import rows


@dataclass(frozen=True)
class Publish:
    """Play a suite with all training seeds, and pack its rows and trained files."""

    suite: str = "leaderboard"
    """Suite to play."""
    training_seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds of each training; the trained files of the first are published."""
    jobs: int | None = None
    """Number of processes; 2 if not given."""
    out: Path = Path("runs/publish")
    """Folder of the leaderboard."""
    to: Path = manifest.FOLDER
    """Folder of the published results."""

    def run(self) -> int:
        """Play what is missing, and pack."""
        check_writable(self.to)
        leaderboard = Leaderboard(
            suite=self.suite,
            training_seeds=self.training_seeds,
            jobs=self.jobs,
            retrain=True,
            out=self.out,
        )
        status = leaderboard.run()
        if status:
            console.print("nothing is published: not all jobs are done", style="red")
            return status
        stored = rows.load(self.out / "rows.jsonl")
        packed = pack(leaderboard.planned(), stored, self.to, self.training_seeds)
        size = sum(file.size for file in (*packed.rows, *packed.trained))
        console.print(
            f"published: {sum(entry.rows for entry in packed.rows)} rows of {len(packed.rows)} "
            f"games and {len(packed.trained)} trained files, {size / 1e6:.2f} MB, in {self.to}",
            soft_wrap=True,
            highlight=False,
        )
        return 0


if __name__ == "__main__":
    sys.exit(guarded(lambda: parse(Publish, "publish", sys.argv[1:]).run()))
