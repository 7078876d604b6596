"""Print measured figures, one JSON line each: group, figure, value, unit, asked, holds, date.

    python scripts/benchmark.py [core ...] [--repeats 5] > docs/figures/core.jsonl

`scripts/readme.py` makes tables from such files, one of each group.

Speeds are ratios to a named peer, measured alternately in one run: one thread, CPU time, the median
of the repeats. Figures that miss their bound are printed like the others; this is not a test. A
group is a module of the folder ``benchmarks``.
"""

from __future__ import annotations

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"))

import importlib
import json
import pkgutil
import sys
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Annotated

import benchmarks
import tyro

GROUPS = sorted(module.name for module in pkgutil.iter_modules(benchmarks.__path__))


def main(groups: Annotated[tuple[str, ...], tyro.conf.Positional] = (), repeats: int = 5) -> int:
    """Print the figures of some groups.

    Args:
        groups: names of the groups; all if none is named.
        repeats: number of measurements of each ratio.
    """
    for name in groups:
        if name not in GROUPS:
            print(f"unknown group {name!r}; known are {', '.join(GROUPS)}", file=sys.stderr)
            return 2
    for name in groups or GROUPS:
        for figure in importlib.import_module(f"benchmarks.{name}").figures(repeats):
            value = float(f"{figure.value:.4g}")
            date = datetime.now(UTC).date().isoformat()
            shown = {"group": name, **asdict(figure), "value": value, "date": date}
            print(json.dumps(shown, ensure_ascii=False), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
