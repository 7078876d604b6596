"""A KKL observer fitted to simulated states (Ramos, Di Meglio, Morgenthaler, Figueira da Silva &
Bernard, "Numerical design of Luenberger observers for nonlinear systems", CDC 2020).

The states of simulated episodes are integrated backward until z has forgotten its beginning, then
jointly with z forward. T is fitted to these pairs, and T* to the z that occur online along the
episodes, with the noise that the outputs have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType

import torch

from trainers.kkl import course
from trainers.kkl.config import DEFAULT, KKLConfig
from trainers.kkl.fitting import Equations, Objective, Term
from trainers.kkl.pictures import figures
from trainers.kkl.run import Method, Run

__all__ = ["Config", "figures", "train"]


@dataclass(frozen=True)
class Config(KKLConfig):
    """The recipe of a supervised KKL observer. ``faithful`` is Ramos et al.'s: Bessel poles, SiLU
    networks of five layers of 50, z from 0, no noise, Adam."""

    PRESETS = MappingProxyType(
        {
            "default": DEFAULT,
            "faithful": {
                **DEFAULT,
                "start": "zero",
                "transient": False,
                "depth": 5,
                "width": 50,
                "activation": "silu",
                "method": "adam",
                "learning_rate": 1e-3,
                "batch": 256,
                "iterations": 12_000,
                "share": 0.5,
                "noise": False,
                "dtype": "float32",
            },
        }
    )


def labels(run: Run) -> Objective:
    """T(x) = z at samples of simulated episodes."""
    assert run.labels is not None
    known = run.labels

    def draw(generator: torch.Generator) -> Sequence[Equations]:
        k, i = run.draw(generator, run.dynamics.size)
        return [Equations([Term(run.encoded(k, i))], known[k, i])]

    return draw


train = partial(course.train, Method("kkl_supervised", labels))
"""See `trainers.kkl.course.train`."""
