"""Plants that between them have all that a filter's compiled code has to reproduce, and records of
them."""

from dataclasses import dataclass, replace

import numpy as np
from array_api_compat import array_namespace
from benchmarks.plants.reactor import Reactor

from pinnobs_gym import Unknown, augmented, table
from pinnobs_gym.simulation.model import model_step
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, initial_states, stack

TURN = 2 * np.pi
JUMPS = (0.33, 0.71)


def times(num_samples=25, dt=0.05, seed=5):
    """Irregular times in s; the first step over a jump ends at it."""
    steps = dt * np.random.default_rng(seed).uniform(0.4, 1.6, num_samples - 1)
    t = np.append(0.0, np.cumsum(steps))
    t[np.searchsorted(t, JUMPS[0])] = JUMPS[0]
    return t


@dataclass(frozen=True)
class Cart(System):
    """A cart with a heading, seen by a range and a bearing, whose motor has a curve, and whose
    ground changes twice."""

    drag: float = 0.3
    gain: float = 0.8

    state_names = ("east", "north", "heading")
    output_names = ("range", "bearing")
    input_names = ("speed", "turn")
    scale = (1.0, 1.0, 1.0)
    state_period = (None, None, TURN)
    output_period = (None, TURN)
    model_step = 0.03
    setups = {
        "benchmark": Setup(
            (-2.0, 0.3, 2.8),
            (-1.0, 0.6, 3.4),
            duration=1.25,
            dt=0.05,
            noise_std=((0.02, 0.0), (0.01, 0.03)),
            process_noise=((0.05, 0.0), (0.02, 0.03), (0.0, 0.1)),
        )
    }

    def f(self, t, x, u):
        xp = array_namespace(x)
        heading, ground = x[..., 2], 1.0 * (t >= JUMPS[0]) - 0.6 * (t >= JUMPS[1])
        speed = table(u[..., 0], (-1.0, 0.0, 0.5, 2.0), (-0.5, 0.0, 0.7, 1.1))
        east = self.gain * speed * xp.cos(heading) - self.drag * x[..., 0] * ground
        north = self.gain * speed * xp.sin(heading) - self.drag * x[..., 1]
        return stack(x, east, north, u[..., 1] + 0.4 * ground + 0.0 * heading)

    def h(self, t, x, u):
        xp = array_namespace(x)
        east, north = x[..., 0], x[..., 1]
        return stack(x, xp.sqrt(east * east + north * north + 0.1), xp.atan2(north, east))

    def input(self, t):
        xp = array_namespace(t)
        return xp.stack([1.0 + 0.5 * xp.sin(3 * t), xp.cos(2 * t)], axis=-1)

    def breakpoints(self):
        return JUMPS


@dataclass(frozen=True)
class JoinedCart(Cart):
    """The same with measured inputs on straight lines."""

    input_hold = "linear"


@dataclass(frozen=True)
class Henon(System):
    """The Hénon map, with an input."""

    a: float = 1.2

    state_names = ("x1", "x2")
    output_names = ("y",)
    input_names = ("u",)
    scale = (1.0, 1.0)
    discrete = True
    setups = {
        "benchmark": Setup(
            (-0.2, -0.1), (0.3, 0.2), duration=40, dt=2, noise_std=0.05, process_noise=0.01
        )
    }

    def f(self, t, x, u):
        first = 1 - self.a * x[..., 0] ** 2 + x[..., 1] + 0.1 * u[..., 0]
        return stack(x, first, 0.3 * x[..., 0])

    def h(self, t, x, u):
        return x[..., :1]

    def input(self, t):
        return array_namespace(t).sin(0.3 * t)[..., None]


@dataclass(frozen=True)
class Escape(System):
    """It escapes to infinity within the record, if it begins above a threshold."""

    state_names = ("x1", "x2")
    output_names = ("y1", "y2")
    scale = (1.0, 1.0)
    model_step = 0.05
    setups = {
        "benchmark": Setup(
            (-0.5, -0.5), (0.5, 0.5), duration=1.25, dt=0.05, noise_std=0.5, process_noise=0.05
        )
    }

    def f(self, t, x, u):
        return stack(x, 3.0 * x[..., 0] ** 3 - x[..., 0] + x[..., 1], -x[..., 1])

    def h(self, t, x, u):
        return stack(x, 0.001 * x[..., 0], x[..., 1])


@dataclass(frozen=True)
class Well(System):
    """Its output is defined above ground only, and its states are not bounded."""

    state_names = ("level", "rate")
    output_names = ("y",)
    scale = (1.0, 1.0)
    model_step = 0.05
    setups = {"benchmark": Setup((0.2, -0.3), (1.5, 0.3), duration=1.25, dt=0.05, noise_std=0.1)}

    def f(self, t, x, u):
        return stack(x, x[..., 1], -0.5 * x[..., 0])

    def h(self, t, x, u):
        return array_namespace(x).sqrt(x[..., :1])


def simulated(system, t, batch=60, missing=0.2, seed=0, noise=0.05):
    """Records of a plant from its initial set at the given times, with random measured inputs and
    missing outputs."""
    rng, setup = np.random.default_rng(seed), system.setups["benchmark"]
    x = initial_states(system, setup, batch)
    u = np.broadcast_to(system.input(t), (batch, len(t), system.nu)).copy()
    if system.measured_input:
        u += 0.3 * rng.standard_normal(u.shape)
    y = np.empty((batch, len(t), system.ny))
    with np.errstate(all="ignore"):
        for k, now in enumerate(t):
            if k:
                x = model_step(system, t[k - 1], now, x, u[:, k - 1], u[:, k])
            y[:, k] = system.h(now, x, u[:, k]) + noise * rng.standard_normal((batch, system.ny))
    y[~np.isfinite(y)] = np.nan
    y[rng.uniform(size=y.shape) < missing] = np.nan
    return Record(t, y, u, Prior.of(system, setup, batch))


def cart(batch=60):
    return Cart(), simulated(Cart(), times(), batch)


def cart_with_measured_input(batch=60):
    system = Cart(measured_input=True)
    return system, simulated(system, times(), batch)


def cart_with_joined_input(batch=60):
    system = JoinedCart(measured_input=True)
    return system, simulated(system, times(), batch)


def cart_of_each_row(batch=60):
    """Array parameters, one number for each row."""
    system = Cart(drag=np.linspace(0.1, 0.6, batch), gain=np.linspace(1.0, 0.5, batch))
    return system, simulated(system, times(), batch)


def cart_with_noise_by_sample(batch=60):
    system, record = cart(batch)
    std = np.random.default_rng(3).uniform(0.01, 0.2, record.y.shape)
    std[:, ::4] = np.nan
    return system, replace(record, noise_std=std)


def cart_with_wide_priors(batch=60):
    """A few rows have priors so wide that they are carried by roots."""
    system, record = cart(batch)
    cov = record.prior.cov.copy()
    cov[1::5] *= 1e14
    return system, replace(record, prior=replace(record.prior, cov=cov))


def henon(batch=60):
    t = np.cumsum([0, 1, 2, 1, 3, 1, 1, 2, 5, 1, 1, 1, 2, 2, 1]).astype(float)
    return Henon(), simulated(Henon(), t, batch)


def henon_with_measured_input(batch=60):
    return Henon(measured_input=True), simulated(Henon(measured_input=True), np.arange(15.0), batch)


def bounded_reactor(batch=60):
    """Estimates and sigma points meet the bounds of the states."""
    system = Reactor()
    record = simulated(system, 0.1 * np.arange(25), batch, missing=0.1)
    mean = np.tile([0.1, 4.5], (batch, 1))
    cov = np.tile(36.0 * np.eye(2), (batch, 1, 1))
    return system, replace(record, prior=Prior(mean, cov))


def escape(batch=60):
    """Some rows diverge."""
    record = simulated(Escape(), times(), batch)
    mean = np.tile([0.0, 0.1], (batch, 1))
    mean[::3, 0] = np.linspace(0.8, 1.6, len(mean[::3]))
    return Escape(), replace(record, prior=replace(record.prior, mean=mean))


def well(batch=60):
    """The output is not defined at some sigma points of some rows."""
    return Well(), simulated(Well(), times(), batch, missing=0.0, noise=0.02)


def augmented_cart(batch=60):
    system = augmented(Cart(), {"gain": Unknown(mean=0.8, std=0.1)})
    return system, simulated(system, times(), batch)


PLANTS = (
    *(cart, cart_with_measured_input, cart_with_joined_input, cart_of_each_row),
    *(cart_with_noise_by_sample, cart_with_wide_priors, henon, henon_with_measured_input),
    *(bounded_reactor, escape, well, augmented_cart),
)
"""Functions that return a plant and a record of it with a given number of rows."""
