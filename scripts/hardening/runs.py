"""A small run of the leaderboard, which faults befall, and the rows that it has to give."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from hardening import plug_ins
from hardening.material import SYSTEM, Material
from hardening.trial import Ended, ended
from pinnobs_gym.cli import main
from pinnobs_gym.scoring import rows

ESTIMATORS = ("open_loop", "luenberger")
_ASIDE = ("us_per_step", "date")
"""Fields that differ from run to run."""


class Run:
    """A run in a new folder.

    Args:
        material: where.
        number: of the run.
        estimators: what it plays.
        more: further options.
    """

    def __init__(
        self,
        material: Material,
        number: int,
        estimators: Sequence[str] = ESTIMATORS,
        more: Sequence[str] = (),
    ) -> None:
        plug_ins.write(material.folder)
        self.out = material.file(f"run{number}")
        self.arguments = ["leaderboard", "--systems", SYSTEM, "--episodes", "2", "--estimators"]
        self.arguments += [*estimators, *more, "--out", str(self.out)]
        self.path = self.out / "rows.jsonl"

    def here(self, *more: str) -> Ended:
        """Run it in this process."""
        return ended(lambda: main([*self.arguments, "--jobs", "1", *more]))

    @property
    def command(self) -> list[str]:
        """The command of a process of its own."""
        return [sys.executable, "-m", "pinnobs_gym.cli", *self.arguments]

    def facts(self, *estimators: str) -> list[str]:
        """Return what the rows say, in an order of its own, of some estimators."""
        found = []
        with suppress(FileNotFoundError):
            found = rows.read(self.path)
        shown = [
            {name: value for name, value in row.items() if name not in _ASIDE}
            for row in found
            if not estimators or row["estimator"] in estimators
        ]
        return sorted(json.dumps(row, sort_keys=True) for row in shown)

    def removed(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self.out, ignore_errors=True)


def undisturbed(material: Material, number: int, *estimators: str) -> list[str]:
    """Return the rows of a run that nothing befalls."""
    run = Run(material, number, estimators or ESTIMATORS)
    if run.here().status != 0:
        raise RuntimeError("the undisturbed run failed")
    found = run.facts()
    run.removed()
    return found


def difference(found: Sequence[Any], expected: Sequence[Any]) -> str:
    """Return in words how rows differ from those of an undisturbed run; nothing if they do not."""
    if found == expected:
        return ""
    return f"{len(found)} rows, {len(set(found) & set(expected))} of them as the {len(expected)}"


def leftovers(folder: Path) -> list[str]:
    """Return the temporary files in a folder; locks are none."""
    hidden = (path for path in folder.rglob(".*") if path.suffix != ".lock")
    return sorted(path.name for path in hidden)
