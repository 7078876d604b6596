"""A KKL observer whose T also satisfies its partial differential equation (Niazi, Cao, Sun, Das &
Johansson, "Learning-based design of Luenberger observers for autonomous nonlinear systems", ACC
2023).

T is fitted to simulated pairs of x and z, and at other samples to (∂T/∂x) f = A_z T + B_z h, for a
driven plant with ∂T/∂t on the left. T* is fitted to simulated z.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from pinnobs_gym.training.settings import check_setting
from trainers.kkl.config import KKLConfig, as_published
from trainers.kkl.fitting import Equations, Objective, Term
from trainers.kkl.samples import Samples
from trainers.kkl.trainer import KKLTrainer


@dataclass(frozen=True)
class KKLPinnConfig(KKLConfig):
    """Settings of the physics-informed KKL observer."""

    equation: float = 0.3
    """Weight of the squared residual of the partial differential equation, times z's slowest time
    constant, relative to that of the labels."""
    share: float = 0.6
    """Steps for T over steps for T*, and CPU time likewise if there is a budget."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_setting(self, "equation", "a number of at least 0", lambda v: 0 <= v < np.inf)


def faithful() -> KKLPinnConfig:
    """Niazi et al.'s recipe: poles −1, −2, ..., z from 0, no noise, Adam."""
    return as_published(KKLPinnConfig(), design="niazi", depth=3, activation="relu", share=1.0)


class KKLPinnTrainer(KKLTrainer[KKLPinnConfig]):
    """Fit T to simulated pairs of x and z and to its partial differential equation."""

    name = "kkl_pinn"
    presets = {"default": KKLPinnConfig, "faithful": faithful}

    def gap(self) -> int:
        return 0

    def encoding(self, samples: Samples) -> Objective:
        """Return T(x) = z at samples of simulated episodes, and T's equation at other samples."""
        assert samples.labels is not None
        labels, weight = samples.labels, self.config.equation
        scaling, dynamics = samples.z_scaling, samples.dynamics
        # (∂T/∂x) f − A_z T = B_z h in scaled z, times √w over z's slowest rate.
        unit = weight**0.5 / dynamics.slowest
        root = np.linalg.inv(scaling.root)
        matrix = samples.tensor(-unit * root @ dynamics.A @ scaling.root)
        driving = samples.outputs() @ dynamics.B.T + dynamics.A @ scaling.mean
        target = samples.tensor(unit * driving @ root.T)
        rate = samples.tensor(unit * samples.rates())

        def draw(generator: torch.Generator) -> Sequence[Equations]:
            k, i = samples.draw(generator, dynamics.size, 0.5, known=True)
            equations = [Equations([Term(samples.encoded(k, i))], labels[k, i])]
            if weight:
                k, i = samples.draw(generator, dynamics.size, 0.5)
                a = samples.encoded(k, i)
                terms = [Term(a, along=rate[k, i]), Term(a, matrix)]
                equations.append(Equations(terms, target[k, i]))
            return equations

        return draw
