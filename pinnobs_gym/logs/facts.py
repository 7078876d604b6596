"""The lines that a judgement of a log always shows."""

from __future__ import annotations

import numpy as np

from pinnobs_gym.logs.innovation_tests import CONFIDENCE, Size
from pinnobs_gym.logs.meanings import NAMED
from pinnobs_gym.logs.normalised import Normalised
from pinnobs_gym.logs.times import instant
from pinnobs_gym.logs.unseen import Seen
from pinnobs_gym.logs.verdicts import OutputTests
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import Setup, System

FEWEST = 20
"""Least number of samples of an output after the start of a log that is judged."""


def innovation_facts(
    found: Normalised, tests: list[OutputTests], together: Size | None
) -> list[str]:
    """Return the lines of sizes and correlations."""
    if not tests:
        return [f"too few samples to judge innovations; expected {FEWEST} of an output"]
    worst = sorted(tests, key=lambda each: each.badness, reverse=True)[:NAMED]
    shown = [each for each in tests if each in worst]
    more = f", and {len(tests) - NAMED} outputs more" if len(tests) > NAMED else ""
    sizes = [(each.name, each.size) for each in shown]
    sizes += [] if together is None else [("together", together)]
    what = ("innovations", "NIS") if found.of_filter else ("residuals", "squares over the noise")
    band = ", ".join(f"{name} {s.median:.3g} ({s.low:.2f} to {s.high:.2f})" for name, s in sizes)
    correlations = ", ".join(
        f"{each.name} {each.correlation.value:.2f} (±{each.correlation.band:.2f})" for each in shown
    )
    return [
        f"{what[0]} after the first {found.start} samples: {what[1]}, 1 expected, with a band of "
        f"{100 * CONFIDENCE:g} %: {band}{more}",
        f"correlation of one with the next, 0 expected: {correlations}{more}",
    ]


def common_facts(system: System, setup: Setup, record: Record) -> tuple[str, ...]:
    """Return the lines of steps and of missing outputs."""
    unit, steps = system.time_unit, np.diff(record.t)
    lines = []
    if len(steps):
        k = int(np.argmax(steps))
        lines.append(
            f"steps of t: median {np.median(steps):.4g} {unit}, smallest {steps.min():.4g}, "
            f"largest {steps[k]:.4g} after t = {instant(record.t[k], record.t)}; the setup has "
            f"{setup.dt:g} {unit}"
        )
    share = np.isnan(record.y[0]).mean(axis=0)
    named = zip(system.output_names, share, strict=True)
    parts = [f"{name} {100 * each:.3g} %" for name, each in named if each > 0]
    line = f"outputs missing: {', '.join(parts[:NAMED]) or 'none'}"
    still = (record.u[0] == record.u[0, 0]).all(axis=0)
    names = zip(system.input_names, record.u[0, 0], still, strict=True)
    if system.measured_input and (held := [f"{n} = {value:g}" for n, value, h in names if h]):
        line += f"; inputs that never change: {', '.join(held[:NAMED])}"
    lines.append(line)
    return tuple(lines)


def state_fact(system: System, told: Seen) -> str:
    """Return the line of states that the outputs tell."""
    names = [name for name, each in zip(system.state_names, told.unseen, strict=True) if each]
    if names:
        return f"states that the outputs tell nothing of: {', '.join(names)}"
    if not np.isfinite(told.left).any():
        return "outputs tell something of all states"
    i = int(np.nanargmax(told.left))
    return (
        f"outputs tell something of all states; the least of {system.state_names[i]}, whose "
        f"standard deviation came to {100 * told.left[i]:.3g} % of the prior's"
    )
