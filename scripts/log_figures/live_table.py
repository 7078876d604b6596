"""The table of what a sample takes in a live filter and in other libraries."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pinnobs_gym.leaderboard.grid import markdown_table
from pinnobs_gym.systems import SYSTEMS

COLUMNS = {
    "`Live`": "live ekf, {name}: one sample",
    "filterpy, compiled model": "ekf, {name}: one sample, filterpy's, compiled model",
    "JAX, jitted step": "ekf, {name}: one sample, a jitted step of JAX",
    "CasADi, with arrays": "ekf, {name}: one sample, a function of CasADi called with arrays",
    "CasADi, compiled, by buffers": "ekf, {name}: one sample, CasADi's compiled code by buffers",
}
"""The figures of the columns."""
INTRO = (
    "**Live filters.** One sample of the EKF of one episode, called from Python, in µs (median). "
    "`Live` checks the sample and keeps those of the past; the others are steps of the same filter "
    "without that. CasADi's compiled code reads and writes arrays in place."
)


def live_table(lines: Sequence[dict[str, Any]]) -> str:
    """Return the table of figures that were measured, a dash for each that was not."""
    values = {line["figure"]: f"{line['value']:.3g}" for line in lines}
    rows = [
        (name, *(values.get(figure.format(name=name), "-") for figure in COLUMNS.values()))
        for name in SYSTEMS.sources
    ]
    return "\n\n".join([INTRO, markdown_table(("system", *COLUMNS), rows)])
