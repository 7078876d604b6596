"""Unknown parameters and constants that cannot be."""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

from hardening.material import Material
from hardening.mutations import NUMBERS
from hardening.trial import Trial, call
from pinnobs_gym.cli.own_model import ModelOptions
from pinnobs_gym.logs.unknown import unknown_parameters
from pinnobs_gym.systems import SYSTEMS

MOST = 200
NAMES = ("a1", "a2", "a9", "", " a1", "x1", "y1", "bias_y1", "bias_", "disturbance_x1", "A1", "ａ1")
NAMES += (
    "rate_x1",
    "__class__",
    "a1.x",
    "\x1b[2J",
    "a1\n",
    "\u202ea1",
    "nx",
    "scale",
    "x" * 3000,
    "a1=a1",
)


def trials(material: Material, rng: Random) -> Iterator[Trial]:
    """Yield unknowns of `pinnobs fit` (``--parameters``) and `pinnobs estimate` (``--also``)."""
    system = SYSTEMS.resolve("Satellite")()
    while True:
        name, count = rng.choice(NAMES), rng.choice((0, 0, 1, 2, 3, 4))
        numbers = [rng.choice((*NUMBERS, "0.5", "1", "inf", "-inf")) for _ in range(count)]
        text = name + ("=" + ",".join(numbers) if numbers else "")
        named = [text[:20], repr(text)[1:20], name[:20] or "''", repr(name)[:20], "parameters"]
        if rng.random() < 0.5:

            def read(text: str = text) -> None:
                unknown_parameters(system, [text])

            option = "--parameters"
        else:

            def read(text: str = text) -> None:
                ModelOptions(also=(text,)).told("Satellite")

            option = "--also"
        yield call(f"{option} {text[:60]!r}", read, [*named, *filter(None, numbers)])
