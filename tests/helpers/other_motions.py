"""The linear plant as one that moves in other ways: a map, and a plant with a flow of its own."""

from dataclasses import dataclass, replace

import numpy as np
from linear import Linear

from pinnobs_gym.simulation.system import stack


@dataclass(frozen=True)
class Counted(Linear):
    """A map."""

    discrete = True
    setups = {"benchmark": replace(Linear.setups["benchmark"], dt=1.0)}

    def f(self, t, x, u):
        return 0.5 * x


@dataclass(frozen=True)
class Exact(Linear):
    """Its own flow takes one call through any gap."""

    def flow(self, t0, t1, x, u):
        rest = np.exp(-np.asarray(t1 - t0))
        return stack(x, rest * x[..., 0], rest * x[..., 1])
