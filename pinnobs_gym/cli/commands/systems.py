"""`systems [NAME]`: list the systems, or print the page of one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro
from rich.markdown import Markdown
from rich.table import Table

from pinnobs_gym.cli.console import console
from pinnobs_gym.cli.options import parse
from pinnobs_gym.cli.system_page import page
from pinnobs_gym.envs.registration import env_id
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
                console.print(Markdown(text))
            else:
                print(text)
            return 0
        table = Table("env id", "states", "measured", "inputs", "setups")
        for cls in SYSTEMS.classes().values():
            system = cls()
            states, outputs = ", ".join(cls.state_names), ", ".join(system.output_names)
            inputs = ", ".join(cls.input_names)
            table.add_row(env_id(cls), states, outputs, inputs, ", ".join(cls.setups))
        console.print(table)
        return 0


def run(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    return parse(Systems, "systems", arguments).run()
