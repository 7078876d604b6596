"""Jacobians of systems that write none: traced, by differences, in torch, and those by hand."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from benchmarks import Figure, at_least, cpu_seconds
from pinnobs_gym.simulation.derivatives import central_differences
from pinnobs_gym.simulation.system import System, initial_states
from pinnobs_gym.systems import SYSTEMS

_BATCHES = (1, 16, 256)
_CALLS = 300
"""Number of calls of which one measurement is the mean."""
_FIRST = """
import time
import numpy as np
from pinnobs_gym.simulation.system import System
from pinnobs_gym.systems import SYSTEMS
cls = SYSTEMS.resolve({name!r})
plain = type("Plain", (cls,), {{"f_jacobian": System.f_jacobian}})()
x, t = np.ones((1, plain.nx)), np.zeros(1)
u = np.asarray(plain.input(t))
start = time.process_time()
{call}
print(time.process_time() - start)
"""
_WAYS = {
    "traced": "plain.f_jacobian(t, x, u)",
    "torch": "import torch; plain.f_jacobian(*map(torch.tensor, (t, x, u))).numpy()",
    "differences": (
        "from pinnobs_gym.simulation.derivatives import central_differences; "
        "central_differences(lambda x: plain.f(t, x, u), x, plain.scale)"
    ),
}


def figures(repeats: int) -> Iterator[Figure]:
    """Measure the Jacobian of f of each system: the first call in a new process, with the imports
    that it needs, and later ones."""
    for name in SYSTEMS.classes():
        for way, call in _WAYS.items():
            code = _FIRST.format(name=name, call=call)
            seconds = float(np.median([_printed(code) for _ in range(repeats)]))
            yield Figure(f"first Jacobian of {name}, {way}", 1e3 * seconds, "ms", "", None)
        for batch in _BATCHES:
            yield from later_calls(name, batch, repeats)


def _printed(code: str) -> float:
    """Return the number that code prints in a new process."""
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
    return float(done.stdout)


def later_calls(name: str, batch: int, repeats: int) -> Iterator[Figure]:
    """Measure the four ways in turn, so that they share what else the machine does."""
    import torch

    cls = SYSTEMS.resolve(name)
    by_hand: System = cls()
    plain: System = type(cls.__name__, (cls,), {"f_jacobian": System.f_jacobian})()
    x = initial_states(by_hand, by_hand.setups["benchmark"], batch)
    t = np.linspace(0.0, 1.0, batch)
    u = np.asarray(by_hand.input(t))
    tensors = [torch.tensor(part) for part in (t, x, u)]
    ways: dict[str, Callable[[], Any]] = {
        "by hand": lambda: by_hand.f_jacobian(t, x, u),
        "traced": lambda: plain.f_jacobian(t, x, u),
        "differences": lambda: central_differences(lambda x: by_hand.f(t, x, u), x, by_hand.scale),
        "torch": lambda: plain.f_jacobian(*tensors).numpy(),
    }
    for call in ways.values():
        call()
    times = [[_mean(call) for call in ways.values()] for _ in range(repeats)]
    medians = dict(zip(ways, np.median(times, axis=0), strict=True))
    for way, seconds in medians.items():
        what = f"Jacobian of {name}, batch {batch}, {way}"
        yield Figure(what, 1e6 * float(seconds), "us", "", None)
    ratio = float(medians["torch"] / medians["traced"])
    yield at_least(f"Jacobian of {name}, batch {batch}, torch / traced", ratio, "x", 2.5)


def _mean(call: Callable[[], Any]) -> float:
    """Return the mean CPU time of a call in s."""

    def several() -> None:
        for _ in range(_CALLS):
            call()

    return cpu_seconds(several) / _CALLS
