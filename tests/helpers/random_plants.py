"""Plants whose equations are drawn at random, and records of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from array_api_compat import array_namespace

from pinnobs_gym import table
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, initial_states, stack

TURN = 2 * np.pi
ONE = (
    *(lambda xp, a: xp.sin(a), lambda xp, a: xp.cos(a), lambda xp, a: xp.tanh(a)),
    *(lambda xp, a: xp.exp(-(a**2)), lambda xp, a: xp.abs(a), lambda xp, a: xp.sign(a)),
    *(lambda xp, a: xp.sqrt(a * a + 0.1), lambda xp, a: xp.log(1 + a * a)),
    *(lambda xp, a: xp.abs(a) ** 1.5, lambda xp, a: (1 + a * a) ** -0.5, lambda xp, a: a**3),
    *(lambda xp, a: xp.sqrt(xp.where(a > 0, a, 0.0 * a)), lambda xp, a: xp.atan(a)),
    *(lambda xp, a: xp.asinh(a), lambda xp, a: a / (1 + a * a), lambda xp, a: -a),
    *(lambda xp, a: table(a, (-1.0, 0.0, 0.4, 2.0), (-0.5, 0.1, 0.7, 0.2)),),
    *(
        lambda xp, a: xp.minimum(xp.maximum(a, -0.5), 0.8),
        lambda xp, a: 0.25 * xp.cosh(xp.tanh(a)) ** 2,
    ),
)
TWO = (
    *(lambda xp, a, b: a + b, lambda xp, a, b: a - b, lambda xp, a, b: a * b),
    *(lambda xp, a, b: xp.maximum(a, b), lambda xp, a, b: xp.minimum(a, b)),
    *(lambda xp, a, b: xp.where(a > b, a, 0.5 * b), lambda xp, a, b: xp.atan2(a, 2 + b * b)),
    *(lambda xp, a, b: a / (1 + b * b), lambda xp, a, b: xp.where((a > 0) & (b <= 0.3), a * b, b)),
)
"""Functions of one and of two arguments, all finite."""


def drawn(rng: np.random.Generator, depth: int, leaves: list[Any]) -> Any:
    """A random function of the namespace, the plant, the time, the states and the inputs."""
    kind = rng.uniform()
    if depth == 0 or kind < 0.15:
        return leaves[rng.integers(len(leaves))]
    if kind < 0.5:
        inner, apply = drawn(rng, depth - 1, leaves), ONE[rng.integers(len(ONE))]
        return lambda *given: apply(given[0], inner(*given))
    first, second = drawn(rng, depth - 1, leaves), drawn(rng, depth - 1, leaves)
    join = TWO[rng.integers(len(TWO))]
    return lambda *given: join(given[0], first(*given), second(*given))


def state(i):
    return lambda xp, plant, t, x, u: x[..., i]


def leaves_of(rng, nx, nu, jump):
    """What the equations consist of."""
    number = float(rng.choice([0.5, 2.0, -1.0, 1e-3, -0.0, 3.0]))
    leaves = [state(i) for i in range(nx)] * 3
    leaves += [lambda xp, plant, t, x, u, i=i: u[..., i] for i in range(nu)]
    leaves += [
        lambda xp, plant, t, x, u: plant.t + 0.0 * x[..., 0],
        lambda xp, plant, t, x, u: plant.x0 * x[..., 0],
        lambda xp, plant, t, x, u: xp.sin(3 * t) + 0.0 * x[..., 0],
        lambda xp, plant, t, x, u: number + 0.0 * x[..., 0],
    ]
    if jump is not None:
        leaves.append(lambda xp, plant, t, x, u: 1.0 * (t >= jump) + 0.0 * x[..., 0])
    return leaves


@dataclass(frozen=True)
class Drawn(System):
    """The equations are attributes of a subclass. Parameters have names that compiled code uses for
    other things."""

    t: float = 0.7
    x0: float = -0.4

    rates: ClassVar[Any] = None
    outputs: ClassVar[Any] = None
    input_names = ()
    jumps: ClassVar[tuple[float, ...]] = ()
    begin: ClassVar[float] = 0.0

    def f(self, t, x, u):
        xp, own = array_namespace(x), type(self).rates
        parts = [rate(xp, self, t, x, u) for rate in own]
        if self.discrete:
            return stack(x, *(0.8 * xp.tanh(part) for part in parts))
        return stack(x, *(3 * xp.tanh(part) - 0.5 * x[..., i] for i, part in enumerate(parts)))

    def h(self, t, x, u):
        xp = array_namespace(x)
        return stack(x, *(output(xp, self, t, x, u) for output in type(self).outputs))

    def input(self, t):
        xp = array_namespace(t)
        waves = [xp.cos((2 + i) * t) * self.x0 for i in range(self.nu)]
        return xp.stack(waves, axis=-1) if waves else super().input(t)

    def breakpoints(self):
        return self.jumps


def matrix_or_level(rng: np.random.Generator, n: int) -> Any:
    """A noise level: zero, one for all, one for each, or a matrix."""
    kind = rng.integers(4)
    if kind == 0:
        return 0.05
    if kind == 1:
        return tuple(rng.uniform(0.02, 0.2, n))
    columns = int(rng.integers(1, n + 1)) if kind == 2 else n
    full = rng.uniform(-0.1, 0.1, (n, columns))
    full[: len(full.T)] += 0.1 * np.eye(columns)
    return tuple(map(tuple, full))


def random_plant(seed: int, largest: int = 6) -> type[Drawn]:
    """A class of plants with at most some number of states."""
    rng = np.random.default_rng(seed)
    nx, ny, nu = int(rng.integers(1, largest + 1)), int(rng.integers(1, 4)), int(rng.integers(0, 3))
    discrete = rng.uniform() < 0.2
    start = float(rng.choice([0.0, 0.0, 1000.0]))
    jump = start + 0.37 if rng.uniform() < 0.4 else None
    leaves = leaves_of(rng, nx, nu, jump)
    rates = [drawn(rng, int(rng.integers(1, 4)), leaves) for _ in range(nx)]
    outputs = [drawn(rng, int(rng.integers(0, 4)), leaves) for _ in range(ny)]
    if rng.uniform() < 0.7:
        outputs[0] = state(0)
    if rng.uniform() < 0.1:
        rates = [lambda xp, plant, t, x, u: 0.0 * x[..., 0]] * nx
    level = matrix_or_level(rng, ny)
    if np.ndim(level) == 2 and len(level[0]) < ny:
        level = 0.1
    attributes: dict[str, Any] = {
        "state_names": ("t", "x", "W", "int", "l", "times")[:nx],
        "output_names": ("double", "now", "y")[:ny],
        "input_names": ("p", "u")[:nu],
        "scale": tuple(rng.uniform(0.5, 2.0, nx)),
        "rates": rates,
        "outputs": outputs,
        "discrete": discrete,
        "model_step": 0.03,
        "input_hold": str(rng.choice(["previous", "linear"])),
        "jumps": () if jump is None or discrete else (jump,),
        "begin": start,
        "setups": {
            "benchmark": Setup(
                (-1.0,) * nx,
                (1.0,) * nx,
                duration=100 if discrete else 1.0,
                dt=1 if discrete else 0.02,
                noise_std=level,
                process_noise=0.0 if rng.uniform() < 0.3 else matrix_or_level(rng, nx),
            )
        },
    }
    if rng.uniform() < 0.3:
        attributes["state_period"] = (TURN, *(None,) * (nx - 1))
    elif rng.uniform() < 0.3:
        attributes["state_low"] = (-1.0, *(-np.inf,) * (nx - 1))
    if rng.uniform() < 0.3:
        attributes["output_period"] = (*(None,) * (ny - 1), TURN)
    attributes["__module__"] = __name__
    return type(f"Drawn{seed}", (Drawn,), attributes)


def random_case(seed: int, batch: int, samples: int = 60, largest: int = 6) -> tuple[Drawn, Record]:
    """A plant and a record of it, whose outputs are drawn around those of its initial states. At
    most nine rows, and the first ones are the same in any batch."""
    cls, rng = random_plant(seed, largest), np.random.default_rng(seed + 1)
    measured = bool(cls.input_names) and rng.uniform() < 0.5
    system = cls(measured_input=measured)
    if rng.uniform() < 0.4:
        system = replace(system, t=rng.uniform(0.2, 1.0, 9)[:batch], x0=0.3)
    gaps = rng.integers(1, 4, samples - 1) if cls.discrete else rng.uniform(2e-3, 0.06, samples - 1)
    t = (0.0 if cls.discrete else cls.begin) + np.append(0.0, np.cumsum(gaps))
    x = initial_states(system, cls.setups["benchmark"], batch)
    u = np.broadcast_to(np.asarray(cls().input(t)), (batch, samples, system.nu)).copy()
    if isinstance(system.x0, float) and system.x0 != cls().x0:
        u = np.broadcast_to(np.asarray(replace(cls(), x0=system.x0).input(t)), u.shape).copy()
    if measured:
        u += 0.3 * np.random.default_rng(seed + 2).standard_normal((9, *u.shape[1:]))[:batch]
    y = np.empty((batch, samples, system.ny))
    for k, now in enumerate(t):
        y[:, k] = system.h(now, x, u[:, k])
    y += 0.1 * np.random.default_rng(seed + 3).standard_normal((9, *y.shape[1:]))[:batch]
    y[np.random.default_rng(seed + 4).uniform(size=(9, *y.shape[1:]))[:batch] < 0.15] = np.nan
    return system, Record(t, y, u, Prior.of(system, cls.setups["benchmark"], batch))
