"""A KKL observer fitted to the equation of T alone (Peralez & Nadri, "Deep learning-based
Luenberger observer design for discrete-time nonlinear systems", CDC 2021).

T is fitted to T(x_{k+m}) = Φᵐ T(x_k) + what the outputs in between add, over m samples; then T*,
with T as it is, to T*(z) = x at the z that T says occur online. No z is simulated for x to be
paired with.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType

import numpy as np
import torch

from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System
from pinnobs_gym.training.loop import expect
from trainers.kkl import course
from trainers.kkl.config import DEFAULT, KKLConfig
from trainers.kkl.fitting import Equations, Objective, Term
from trainers.kkl.pictures import figures
from trainers.kkl.run import Method, Run

__all__ = ["Config", "figures", "train"]


@dataclass(frozen=True)
class Config(KKLConfig):
    """The recipe of an unsupervised KKL observer. ``faithful`` is Peralez & Nadri's: discrete time,
    one sample, z from 0, no noise, Adam."""

    horizon: float = 3.0
    """The time m samples take, over z's slowest time constant; one sample at least."""

    PRESETS = MappingProxyType(
        {
            "default": {**DEFAULT, "samples": 300, "share": 1.0},
            "faithful": {
                **DEFAULT,
                "mode": "discrete",
                "start": "zero",
                "transient": False,
                "samples": 300,
                "depth": 5,
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
        expect(self, "horizon", "a number of at least 0", lambda v: 0 <= v < np.inf)
        if self.preset == "faithful":
            object.__setattr__(self, "horizon", 0.0)


def gap(config: Config, system: System, record: Record) -> int:
    """m, the samples of the residual: at most half of those that there are."""
    slowest = config.dynamics(system).slowest
    samples = round(config.horizon / slowest / float(np.diff(record.t).mean()))
    return min(max(1, samples), record.num_samples // 2)


def residual(run: Run) -> Objective:
    """T(x_{k+m}) − Φᵐ T(x_k) − what the outputs between the two add to z."""
    data, scaling = run.data, run.z_scaling
    pairs = run.pairs()
    root = np.linalg.inv(scaling.root)
    flows, driven = [], []
    for a, b in pairs:
        flow = run.dynamics.flows(run.t[run.kept[a] : run.kept[b] + 1])[-1]
        forced = data.z[b] - data.z[a] @ flow.T
        flows.append(root @ flow @ scaling.root)
        driven.append(scaling.scaled(forced + flow @ scaling.mean))
    first, second = (torch.tensor(side, device=run.device) for side in pairs.T)
    flow, added = run.tensor(-np.array(flows)), run.tensor(np.array(driven))
    start = run.tensor(scaling.scaled(data.z[:1])) if run.driven else None

    def draw(generator: torch.Generator) -> Sequence[Equations]:
        _, i = run.draw(generator, run.dynamics.size)
        pair = torch.randint(len(first), (len(i),), generator=generator).to(run.device)
        before = Term(run.encoded(first[pair], i), flow[pair])
        after = Term(run.encoded(second[pair], i))
        found = [Equations([after, before], added[pair, i])]
        if start is not None:  # T(t, x) of a driven plant begins at the first sample
            zero = torch.zeros_like(i)
            found.append(Equations([Term(run.encoded(zero, i))], start[zero, i]))
        return found

    return draw


train = partial(course.train, Method("kkl_autoencoder", residual, labelled=False, gap=gap))
"""See `trainers.kkl.course.train`."""
