"""Sensor logs: three recorded ones, what is refused, how long a long one takes, scores against
references, fits of parameters and noise, the judgement of right and wrong logs, and filters live.

Simulated logs have fixed seeds. Recorded ones that are not here are named and left out.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

from log_figures import fit, judgement, live, reading, recorded, scored
from log_figures.live_table import live_table

from benchmarks import Figure

readme_table = live_table


def figures(repeats: int) -> Iterator[Figure]:
    """Measure all of them."""
    if recorded.LOGS.exists():
        yield from recorded.figures(repeats)
    else:
        print("the recorded logs are not here; left out", file=sys.stderr)
    for part in (reading, scored, fit, judgement, live):
        yield from part.figures(repeats)
