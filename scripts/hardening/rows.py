"""Damaged rows files."""

from __future__ import annotations

import json
from collections.abc import Iterator
from random import Random

from hardening.material import Material
from hardening.mutations import TEXT, mutated, other_value
from hardening.trial import Trial, command, written

MOST = 250


def trials(material: Material, rng: Random) -> Iterator[Trial]:
    """Yield tables of damaged rows: of changed text, and of one changed value."""
    good = material.rows_file.read_bytes()
    rows = [json.loads(line) for line in good.splitlines()]
    path = material.file("rows.jsonl")
    while True:
        if rng.random() < 0.5:
            what, data = mutated(rng, good, TEXT)
            if rng.random() < 0.1 and what == "End lines as Windows does":
                what, data = "Add empty lines", good.replace(b"\n", b"\n\n")
        else:
            i = rng.randrange(len(rows))
            what, row = other_value(rng, rows[i])
            lines = [json.dumps(each) for each in [*rows[:i], row, *rows[i + 1 :]]]
            data = "\n".join(lines).encode() + b"\n"
        trial = command(["tables", path], [str(path)])
        yield Trial(f"rows: {what}", lambda t=trial, d=data: (written(path, d), t.run())[1])
