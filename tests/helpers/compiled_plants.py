"""Plants with which compiled code is compared with NumPy, and both of a call's results."""

import os
from dataclasses import dataclass
from unittest import mock

from array_api_compat import array_namespace

from pinnobs_gym.simulation.kernels import asked
from pinnobs_gym.simulation.system import Setup, System, stack

JUMP = 0.73


@dataclass(frozen=True)
class Pushed(System):
    """A damped pendulum with an input that joins two samples, and a load that jumps."""

    damping: float = 0.3
    load: float = 0.8

    state_names = ("angle", "rate")
    output_names = ("y",)
    input_names = ("force",)
    scale = (1.0, 2.0)
    model_step = 0.03
    input_hold = "linear"
    setups = {"benchmark": Setup((-1, -1), (1, 1), duration=2, dt=0.05, noise_std=0.01)}

    def f(self, t, x, u):
        xp = array_namespace(x)
        pull = self.load * (t >= JUMP) + u[..., 0] - self.damping * x[..., 1]
        return stack(x, x[..., 1], pull - 4 * xp.sin(x[..., 0]))

    def h(self, t, x, u):
        return x[..., :1]

    def input(self, t):
        return array_namespace(t).cos(3 * t)[..., None]

    def breakpoints(self):
        return (JUMP,)


@dataclass(frozen=True)
class Held(Pushed):
    """The same with an input that is held."""

    input_hold = "previous"


@dataclass(frozen=True)
class Predator(System):
    """A map with an input: a Nicholson-Bailey host and its parasitoid (Proceedings of the
    Zoological Society of London, 1935)."""

    growth: float = 1.2

    state_names = ("host", "parasitoid")
    output_names = ("y",)
    input_names = ("added",)
    scale = (1.0, 1.0)
    discrete = True
    setups = {"benchmark": Setup((0.5, 0.5), (1, 1), duration=8, dt=1, noise_std=0.01)}

    def f(self, t, x, u):
        found = array_namespace(x).exp(-x[..., 1])
        host = x[..., 0]
        return stack(x, self.growth * host * found + u[..., 0], host * (1 - found))

    def h(self, t, x, u):
        return x[..., :1]

    def input(self, t):
        return (0.1 * t)[..., None]


@dataclass(frozen=True)
class Kepler(System):
    """A planar orbit, which keeps energy and angular momentum."""

    state_names = ("x", "y", "vx", "vy")
    output_names = ("y1",)
    scale = (1.0, 1.0, 1.0, 1.0)
    setups = {"benchmark": Setup((0.9, -0.1, -0.1, 0.9), (1.1, 0.1, 0.1, 1.1), duration=10, dt=0.1)}

    def f(self, t, x, u):
        cube = (x[..., 0] ** 2 + x[..., 1] ** 2) ** 1.5
        return stack(x, x[..., 2], x[..., 3], -x[..., 0] / cube, -x[..., 1] / cube)

    def h(self, t, x, u):
        return x[..., :1]

    def invariants(self, x):
        r = (x[..., :1] ** 2 + x[..., 1:2] ** 2) ** 0.5
        energy = (x[..., 2:3] ** 2 + x[..., 3:] ** 2) / 2 - 1 / r
        momentum = x[..., :1] * x[..., 3:] - x[..., 1:2] * x[..., 2:3]
        return array_namespace(x).concat([energy, momentum], axis=-1)


def by_numpy(call):
    """The result of a call in NumPy."""
    with mock.patch.dict(os.environ, PINNOBS_KERNELS="0"):
        return call()


def compiled(template, system, call):
    """The result of a call in compiled code."""
    with mock.patch.object(asked, "_asked", set()):
        found = asked.ask(system, template)
        assert not isinstance(found, str), found
        return call()
