"""A KKL observer fitted to simulated states (Ramos, Di Meglio, Morgenthaler, Figueira da Silva &
Bernard, "Numerical design of Luenberger observers for nonlinear systems", CDC 2020).

The initial states of simulated episodes are integrated backward until the initial value of z no
longer matters, then forward jointly with z. T is fitted to these pairs, and T* to the z that occur
online along the episodes, with the effect of output noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from trainers.kkl.config import KKLConfig, as_published
from trainers.kkl.fitting import Equations, Objective, Term
from trainers.kkl.samples import Samples
from trainers.kkl.trainer import KKLTrainer


@dataclass(frozen=True)
class KKLSupervisedConfig(KKLConfig):
    """Settings of the supervised KKL observer."""


def faithful() -> KKLSupervisedConfig:
    """Ramos et al.'s recipe: Bessel poles, SiLU networks of five layers of 50, z from 0, no
    noise, Adam."""
    return as_published(KKLSupervisedConfig(), depth=5, activation="silu", share=0.5)


class KKLSupervisedTrainer(KKLTrainer[KKLSupervisedConfig]):
    """Fit T to simulated pairs of x and z."""

    name = "kkl_supervised"
    presets = {"default": KKLSupervisedConfig, "faithful": faithful}
    takes_drawn_inputs = True

    def gap(self) -> int:
        return 0

    def encoding(self, samples: Samples) -> Objective:
        """Return the equations T(x) = z at samples of simulated episodes."""
        assert samples.labels is not None
        labels = samples.labels

        def draw(generator: torch.Generator) -> Sequence[Equations]:
            k, i = samples.draw(generator, samples.dynamics.size, known=True)
            return [Equations([Term(samples.encoded(k, i))], labels[k, i])]

        return draw
