"""`estimators [NAME]`: list the estimators, or print the description of one."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro
from rich.table import Table

from pinnobs_gym.cli.console import console
from pinnobs_gym.cli.options import parse
from pinnobs_gym.estimators import ESTIMATORS


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
        table = Table("name", "track", "knows", "what it is")
        for name, cls in ESTIMATORS.classes().items():
            first = (inspect.getdoc(cls) or "").partition("\n\n")[0].replace("\n", " ")
            table.add_row(name, cls.track, ", ".join(cls.knows), first)
        console.print(table)
        return 0


def run(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    return parse(Estimators, "estimators", arguments).run()
