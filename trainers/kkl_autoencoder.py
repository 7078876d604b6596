"""A KKL observer fitted to the equation of T alone (Peralez & Nadri, "Deep learning-based
Luenberger observer design for discrete-time nonlinear systems", CDC 2021).

T is fitted to T(x_{k+m}) = Φᵐ T(x_k) + w, where w is the response of z to the outputs over the m
samples. Then T* is fitted to T*(z) = x at the z computed from the trained T. No pairs of x and
simulated z are used.
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
class KKLAutoencoderConfig(KKLConfig):
    """Settings of the unsupervised KKL observer."""

    horizon: float = 3.0
    """Duration of the m samples over z's slowest time constant; m is at least 1."""
    samples: int = 300
    """Number of samples kept of each episode."""
    share: float = 1.0
    """Steps for T over steps for T*, and CPU time likewise if there is a budget."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_setting(self, "horizon", "a number of at least 0", lambda v: 0 <= v < np.inf)


def faithful() -> KKLAutoencoderConfig:
    """Peralez & Nadri's recipe: discrete time, one sample, z from 0, no noise, Adam. An error of T
    counts only by what z forgets of it in a sample, so that T takes more steps than by labels."""
    config = KKLAutoencoderConfig(mode="discrete", horizon=0.0)
    return as_published(config, depth=5, activation="relu", iterations=36_000)


class KKLAutoencoderTrainer(KKLTrainer[KKLAutoencoderConfig]):
    """Fit T to its own equation over several samples, and T* to the trained T."""

    name = "kkl_autoencoder"
    presets = {"default": KKLAutoencoderConfig, "faithful": faithful}
    labelled = False

    def gap(self) -> int:
        """Return m, the number of samples of the equation; at most half of an episode's."""
        slowest = self.config.dynamics(self.system).slowest
        interval = float(np.diff(self.record.t).mean())
        count = round(self.config.horizon / slowest / interval)
        return min(max(1, count), self.record.num_samples // 2)

    def encoding(self, samples: Samples) -> Objective:
        """Return the equations T(x_{k+m}) − Φᵐ T(x_k) = w at random pairs of samples."""
        data, scaling = samples.data, samples.z_scaling
        pairs = samples.pairs()
        root = np.linalg.inv(scaling.root)
        flows, driven = [], []
        for a, b in pairs:  # Φᵐ and w of each pair, in scaled z
            flow = samples.dynamics.flows(samples.t[samples.kept[a] : samples.kept[b] + 1])[-1]
            forced = data.z[b] - data.z[a] @ flow.T
            flows.append(root @ flow @ scaling.root)
            driven.append(scaling.scaled(forced + flow @ scaling.mean))
        first, second = (torch.tensor(side, device=samples.device) for side in pairs.T)
        flow, added = samples.tensor(-np.array(flows)), samples.tensor(np.array(driven))
        start = samples.tensor(scaling.scaled(data.z[:1])) if samples.driven else None

        def draw(generator: torch.Generator) -> Sequence[Equations]:
            _, i = samples.draw(generator, samples.dynamics.size)
            pair = torch.randint(len(first), (len(i),), generator=generator).to(samples.device)
            before = Term(samples.encoded(first[pair], i), flow[pair])
            after = Term(samples.encoded(second[pair], i))
            equations = [Equations([after, before], added[pair, i])]
            if start is not None:  # initial condition of T(t, x) of a driven plant
                zero = torch.zeros_like(i)
                equations.append(Equations([Term(samples.encoded(zero, i))], start[zero, i]))
            return equations

        return draw
