"""Try to break the package, and print how it ends: one JSON line a group, and a summary.

    python scripts/harden.py [rows logs ...] [--seconds 1800] [--seed 0]

A group is a module of the folder ``hardening``: bad inputs, which have to be refused in one line
that names the file, the field or the argument, or accepted where that is right; faults, after which
a run that is started again has to give the rows of an undisturbed one; and pages with hostile
names. The same seed makes the same trials. The status is 1 if any did not end as it should.
"""

from __future__ import annotations

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"))

import importlib
import json
import logging
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from random import Random
from typing import Annotated, Any

import tyro
from hardening.material import Material
from hardening.trial import RIGHT, Kind

INPUTS = ("arguments", "rows", "suites", "logs", "weights", "curves", "names", "checkpoints")
INPUTS += ("live_files", "references", "submissions", "unknowns")
"""The groups of bad inputs."""
GROUPS = (*INPUTS, "faults", "kills", "pages")
SHOWN = 30
"""Largest number of trials of a group that are shown because they did not end as they should."""
KINDS: dict[Kind, str] = {
    "refused": "refused in one line",
    "accepted": "accepted",
    "traceback": "traceback",
    "unnamed": "unnamed",
    "wrong": "wrong",
    "hung": "hung",
}


def tried(group: str, material: Material, seed: int, seconds: float, most: int) -> dict[str, Any]:
    """Run the trials of a group, and return its counts and what did not end as it should.

    Args:
        group: name of the group.
        material: valid inputs.
        seed: of the trials.
        seconds: after which no further one begins.
        most: largest number of them; the group's own limit holds, too.
    """
    module = importlib.import_module(f"hardening.{group}")
    begun, counts, shown = time.monotonic(), Counter[Kind](), []
    for i, trial in enumerate(module.trials(material, Random(f"{seed} {group}"))):
        if i >= min(most, module.MOST) or time.monotonic() - begun > seconds:
            break
        outcome = trial.run()
        counts[outcome.kind] += 1
        if outcome.kind not in RIGHT and len(shown) < SHOWN:
            shown.append(
                {"trial": ascii(trial.what)[1:-1], outcome.kind: ascii(outcome.told)[1:-1]}
            )
    return {
        "group": group,
        "seed": seed,
        "tried": counts.total(),
        **{words: counts[kind] for kind, words in KINDS.items()},
        "seconds": round(time.monotonic() - begun, 1),
        "shown": shown,
    }


@contextmanager
def apart() -> Iterator[Material]:
    """Yield material in a temporary folder, which is the working folder meanwhile. Warnings and the
    log are not shown, since messages have to say all."""
    before = os.getcwd()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        logging.disable(logging.WARNING)
        os.chdir(folder)
        try:
            yield Material(Path(folder))
        finally:
            os.chdir(before)
            logging.disable(logging.NOTSET)


def main(
    groups: Annotated[tuple[str, ...], tyro.conf.Positional] = (),
    seconds: float = 1800.0,
    seed: int = 0,
    most: int = 1000,
) -> int:
    """Run the trials of some groups.

    Args:
        groups: names of the groups; all if none is named.
        seconds: time for all of them; each group has an equal share of what is left.
        seed: of the trials.
        most: largest number of trials of a group.
    """
    for name in groups:
        if name not in GROUPS:
            print(f"unknown group {name!r}; known are {', '.join(GROUPS)}", file=sys.stderr)
            return 2
    found = list(_run(groups or GROUPS, seconds, seed, most))
    names = ("tried", *KINDS.values())
    summary = {name: sum(group[name] for group in found) for name in names}
    print(json.dumps({"summary": summary}))
    return 0 if all(summary[KINDS[kind]] == 0 for kind in KINDS if kind not in RIGHT) else 1


def _run(groups: Sequence[str], seconds: float, seed: int, most: int) -> Iterator[dict[str, Any]]:
    """Run groups, and print and yield the counts of each."""
    end = time.monotonic() + seconds
    with apart() as material:
        for i, name in enumerate(groups):
            share = max(end - time.monotonic(), 0.0) / (len(groups) - i)
            counts = tried(name, material, seed, share, most)
            print(json.dumps(counts), flush=True)
            yield counts


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
