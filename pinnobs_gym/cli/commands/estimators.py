"""`estimators [NAME]`: list the estimators, or print the description of one."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from pinnobs_gym.cli.console import console, print_table
from pinnobs_gym.cli.options import parse
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.leaderboard.grid import Column, Grid


@dataclass(frozen=True)
class Estimators:
    """List the estimators, or print the description of one."""

    name: Annotated[str | None, tyro.conf.Positional] = None
    """Name or module:Class of an estimator."""

    def run(self) -> int:
        """Print the list or the description."""
        if self.name is not None:
            console.print(inspect.getdoc(ESTIMATORS.resolve(self.name)), markup=False)
            return 0
        print_table([[listing()]])
        return 0


def listing() -> Grid:
    """Return the table of estimators. In a terminal it is a record of each: what an estimator is
    takes a line."""
    names = ("name", "track", "knows", "what it is")
    columns = tuple(Column(name, numeric=False) for name in names)
    lines = []
    for name, cls in ESTIMATORS.classes().items():
        first = (inspect.getdoc(cls) or "").partition("\n\n")[0].replace("\n", " ")
        lines.append((name, cls.track, ", ".join(cls.knows), first))
    return Grid("", columns, tuple(lines))


def run(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    return parse(Estimators, "estimators", arguments).run()
