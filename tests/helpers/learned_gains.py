"""Learned gains without training."""

import numpy as np

from pinnobs_gym.estimation.learned.gain_network import shapes
from pinnobs_gym.estimation.learned.trained_file import identity
from pinnobs_gym.estimators.pinn_gain import PinnGain, TrainedGain
from pinnobs_gym.simulation.system import System


def gain_of(system: System, size=0.0, variant="kalman", noise_std=None, width=8) -> PinnGain:
    """A gain of random weights, those of the last layer times a size."""
    rng = np.random.default_rng(5)
    sizes = shapes(variant, system.nx, system.ny, width)
    layers = [[rng.standard_normal(s) / 2, rng.standard_normal(s[0]) / 2] for s in sizes]
    layers[-1] = [size * a for a in layers[-1]]
    benchmark = system.setups["benchmark"].noise_std
    told = noise_std
    if told is None and np.ndim(benchmark) < 2:
        told = tuple(np.broadcast_to(benchmark, system.ny).tolist())
    about = {n: identity(system)[n] for n in ("system", "parameters")}
    trained = TrainedGain(
        **about,
        trainer="pinn_gain",
        layers=tuple(map(tuple, layers)),
        variant=variant,
        noise_std=told or (1.0,) * system.ny,
        config={},
        seed=0,
        loss=1.0,
        iterations=0,
        seconds=0.0,
        ending="finished",
        condition="nominal",
    )
    return PinnGain(system, told, trained=trained)
