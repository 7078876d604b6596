"""`kernels`: list the compiled code that is kept, or remove it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

from pinnobs_gym.cli.console import console, print_next, print_table
from pinnobs_gym.cli.options import parse
from pinnobs_gym.leaderboard.grid import Column, Grid
from pinnobs_gym.simulation.kernels.build import NO_COMPILER, usable_compilers
from pinnobs_gym.simulation.kernels.cache_folder import Kept, clear, kept_libraries, kernel_folder
from pinnobs_gym.simulation.kernels.compilers import processor


@dataclass(frozen=True)
class Kernels:
    """List the compiled code that is kept, or remove it."""

    clear: bool = False
    """Remove all compiled code; it is made again when it is needed."""

    def run(self) -> int:
        """Print the list, or remove what is kept."""
        try:
            folder = kernel_folder()
        except OSError as error:
            raise ValueError(f"no folder keeps compiled code: {error}") from None
        if self.clear:
            count = clear(folder)
            _say(f"{count} librar{'y' if count == 1 else 'ies'} removed from {folder}")
            return 0
        libraries = kept_libraries(folder)
        if libraries:
            print_table([[listing(libraries)]])
        total = sum(library.size for library in libraries)
        found = [compiler.name for compiler in usable_compilers()]
        _say(f"libraries: {len(libraries)}, {total / 1e6:.1f} MB, in {folder}")
        _say(f"compiler: {found[0] if found else NO_COMPILER}")
        _say(f"processor: {processor() or 'not known; code is not made for this one alone'}")
        if libraries:
            print_next("kernels", "--clear")
        return 0


def listing(libraries: Sequence[Kept]) -> Grid:
    """Return the table of libraries, those used last first."""
    columns = (
        Column("plant", numeric=False),
        Column("algorithm", numeric=False),
        Column("kB"),
        Column("last used", 1, numeric=False),
        Column("compiler", 2, numeric=False),
        Column("for this processor", 3, numeric=False),
    )
    lines = []
    for kept in libraries:
        used = time.strftime("%Y-%m-%d %H:%M", time.localtime(kept.used))
        about = [kept.about.get(name, "") for name in ("plant", "template", "compiler")]
        own = "yes" if kept.about.get("processor") == processor() else "no"
        lines.append((*about[:2], f"{kept.size / 1e3:.0f}", used, about[2], own))
    return Grid("", columns, tuple(lines))


def _say(line: str) -> None:
    console.print(line, soft_wrap=True, highlight=False)


def run(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    return parse(Kernels, "kernels", arguments).run()
