"""`systems [NAME]`: list the systems, or print the page of one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro
from rich.markdown import Markdown

from pinnobs_gym.cli.console import console, print_next, print_table
from pinnobs_gym.cli.options import parse
from pinnobs_gym.cli.system_page import page
from pinnobs_gym.envs.registration import env_id
from pinnobs_gym.leaderboard.display import printable_lines
from pinnobs_gym.leaderboard.grid import Column, Grid
from pinnobs_gym.systems import SYSTEMS


@dataclass(frozen=True)
class Systems:
    """List the systems, or print the page of one."""

    name: Annotated[str | None, tyro.conf.Positional] = None
    """Name or module:Class of a system."""

    def run(self) -> int:
        """Print the list or the page."""
        if self.name is not None:
            name = env_id(self.name)
            text = page(SYSTEMS.resolve(self.name), name)
            if console.is_terminal:
                console.print(Markdown(printable_lines(text), hyperlinks=False))
            else:
                console.out(text, highlight=False)
            print_next("evaluate", "--system", self.name)
            return 0
        print_table([[listing()]], "pinnobs systems NAME says more")
        print_next("systems", "ReverseDuffing")
        return 0


def listing() -> Grid:
    """Return the table of systems."""
    names = {"env id": 0, "measured": 1, "states": 2, "inputs": 3, "setups": 4}
    columns = tuple(Column(name, priority, numeric=False) for name, priority in names.items())
    lines = []
    for cls in SYSTEMS.classes().values():
        measured = cls().output_names
        parts = (measured, cls.state_names, cls.input_names, cls.setups)
        lines.append((env_id(cls), *map(", ".join, parts)))
    return Grid("", columns, tuple(lines))


def run(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    return parse(Systems, "systems", arguments).run()
