"""A KKL observer whose T also satisfies its partial differential equation (Niazi, Cao, Sun, Das &
Johansson, "Learning-based design of Luenberger observers for autonomous nonlinear systems", ACC
2023).

T is fitted to simulated pairs of x and z, and to (∂T/∂x) f = A_z T + B_z h (of a driven plant, with
∂T/∂t) at other states; T* to simulated z.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType

import numpy as np
import torch

from pinnobs_gym.training.loop import expect
from trainers.kkl import course
from trainers.kkl.config import DEFAULT, KKLConfig
from trainers.kkl.fitting import Equations, Objective, Term
from trainers.kkl.pictures import figures
from trainers.kkl.run import Method, Run

__all__ = ["Config", "figures", "train"]


@dataclass(frozen=True)
class Config(KKLConfig):
    """The recipe of a physics-informed KKL observer. ``faithful`` is Niazi et al.'s: poles −1, −2,
    ..., z from 0, no noise, Adam."""

    equation: float = 0.3
    """Weight of the equation's residual, taken over z's slowest time constant, beside the
    labels'."""

    PRESETS = MappingProxyType(
        {
            "default": {**DEFAULT, "share": 0.6},
            "faithful": {
                **DEFAULT,
                "design": "niazi",
                "start": "zero",
                "transient": False,
                "depth": 3,
                "width": 50,
                "activation": "relu",
                "method": "adam",
                "learning_rate": 1e-3,
                "batch": 256,
                "iterations": 12_000,
                "share": 1.0,
                "noise": False,
                "dtype": "float32",
            },
        }
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        expect(self, "equation", "a number of at least 0", lambda v: 0 <= v < np.inf)


def physics(run: Run) -> Objective:
    """T(x) = z at samples of simulated episodes, and the equation of T at others."""
    assert run.labels is not None
    known, config = run.labels, run.config
    assert isinstance(config, Config)
    scaling, dynamics = run.z_scaling, run.dynamics
    unit = config.equation**0.5 / dynamics.slowest
    root = np.linalg.inv(scaling.root)
    matrix = run.tensor(-unit * root @ dynamics.A @ scaling.root)
    target = run.tensor(unit * (run.outputs() @ dynamics.B.T + dynamics.A @ scaling.mean) @ root.T)
    rate = run.tensor(unit * run.rates())

    def draw(generator: torch.Generator) -> Sequence[Equations]:
        k, i = run.draw(generator, dynamics.size, 0.5)
        found = [Equations([Term(run.encoded(k, i))], known[k, i])]
        if config.equation:
            k, i = run.draw(generator, dynamics.size, 0.5)
            a = run.encoded(k, i)
            terms = [Term(a, along=rate[k, i]), Term(a, matrix)]
            found.append(Equations(terms, target[k, i]))
        return found

    return draw


train = partial(course.train, Method("kkl_pinn", physics))
"""See `trainers.kkl.course.train`."""
