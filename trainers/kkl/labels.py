"""States of simulated episodes and the corresponding z and T(x)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.stats import qmc

from pinnobs_gym.estimation.learned.kkl_dynamics import Dynamics, Start, at_rest
from pinnobs_gym.simulation.runge_kutta import runge_kutta
from pinnobs_gym.simulation.system import Array, System, vector
from pinnobs_gym.simulation.truth import truth

SETTLED = 16.0
"""Duration of the backward integration of x, over z's slowest time constant. It leaves e⁻¹⁶ of the
initial error of z; the papers' 10 would leave the largest error of a good fit."""
MOST_ESCAPED = 0.1
"""Largest fraction of the initial states that may be dropped. If more escape backward, T is fitted
to states that all of them reach forward."""
FAR = 1e3
"""Size of a state, over its scale, above which it counts as escaped."""
_TIMES = 9
"""Number of times of an episode at which the equations are compared."""
_DRAWS = 100
"""Largest number of Latin hypercubes that are drawn for enough admissible states."""


@dataclass(frozen=True)
class _Reversed(System):
    """A plant in reversed time."""

    plant: System = field(kw_only=True)

    @property
    def state_names(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.plant.state_names

    @property
    def output_names(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.plant.output_names

    @property
    def scale(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.plant.scale

    @property
    def setups(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.plant.setups

    def f(self, t: Array, x: Array, u: Array) -> Array:
        return -self.plant.f(-t, x, u)

    def h(self, t: Array, x: Array, u: Array) -> Array:
        return self.plant.h(-t, x, u)


@dataclass(frozen=True)
class _Joint(System):
    """A plant and the z driven by its output, as one system with state (x, z)."""

    plant: System = field(kw_only=True)
    dynamics: Dynamics = field(kw_only=True)

    @property
    def state_names(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        return (*self.plant.state_names, *map(str, range(self.dynamics.size)))

    @property
    def output_names(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.plant.output_names

    @property
    def scale(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        return (*self.plant.scale, *np.ones(self.dynamics.size))

    @property
    def setups(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.plant.setups

    def f(self, t: Array, x: Array, u: Array) -> Array:
        nx = self.plant.nx
        state, z = x[..., :nx], x[..., nx:]
        rate = z @ self.dynamics.A.T + self.plant.h(t, state, u) @ self.dynamics.B.T
        return np.concatenate([self.plant.f(t, state, u), rate], axis=-1)

    def h(self, t: Array, x: Array, u: Array) -> Array:
        return self.plant.h(t, x[..., : self.plant.nx], u)


def driven(system: System) -> bool:
    """Return whether T depends on time: the plant has inputs, or its equations vary over a
    benchmark episode."""
    if system.nu:
        return True
    setup, u = system.setups["benchmark"], np.empty(0)
    x = initial_states(system, None, None, 20, seed=0)
    times = np.linspace(0.0, setup.duration, _TIMES)
    first, *others = ((system.f(t, x, u), system.h(t, x, u)) for t in times)
    return not all(
        np.array_equal(a, b) for pair in others for a, b in zip(first, pair, strict=True)
    )


def drives(system: System) -> int:
    """Return by how many signals z is driven: the outputs and, if they are drawn, the inputs."""
    return system.ny + (system.nu if system.draws_input else 0)


def inputs_of(system: System, t: np.ndarray, batch: int, rng: np.random.Generator) -> np.ndarray:
    """Return the inputs of episodes at sample times t (num_samples,) in s, shape (num_samples,
    batch, nu) if they are drawn, else (num_samples, 1, nu)."""
    if system.draws_input:
        return np.stack([system.draw_input(rng, t) for _ in range(batch)], axis=1).astype(float)
    return np.asarray(system.input(t))[:, None]


def steady(
    system: System, dynamics: Dynamics, x: np.ndarray, h: float
) -> tuple[np.ndarray, np.ndarray]:
    """Compute T(x) of an autonomous plant.

    x is integrated backward for `SETTLED` of z's slowest time constants, then (x, z) jointly
    forward from z = 0.

    Args:
        system: the plant.
        dynamics: dynamics of z; in discrete time z is driven by samples of the output.
        x: states, shape (batch, nx).
        h: time between samples in s.

    Returns:
        z (batch, nz), NaN where x escapes; and a mask (batch,) of the states that do not escape.
    """
    # Drop the states that diverge when integrated backward.
    duration = float(np.ceil(SETTLED / dynamics.slowest / h) * h)
    stays = ~_escapes(system, x, -duration)
    z = np.full((len(x), dynamics.size), np.nan)
    if not stays.any():
        return z, stays
    step = system.setups["benchmark"].truth_step
    backward = _Reversed(plant=system)
    if dynamics.mode == "discrete":  # filter the samples of the output along the path
        t = np.arange(round(duration / h) + 1) * h
        path = truth(backward, x[stays], t, step)[::-1]
        y = system.h(t[:, None] - duration, path, np.empty((len(t), 1, 0)))
        z[stays] = dynamics.filtered(t, y)[-1]
        return z, stays
    # Backward integration of x, then forward integration of (x, z) until z has settled to T(x).
    start = truth(backward, x[stays], np.array([0.0, duration]), step)[-1]
    begin = np.concatenate([start, np.zeros((len(start), dynamics.size))], axis=1)
    joint = _Joint(plant=system, dynamics=dynamics)
    z[stays] = truth(joint, begin, np.array([-duration, 0.0]), step)[-1, :, system.nx :]
    return z, stays


def reached(
    system: System, dynamics: Dynamics, x: np.ndarray, h: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return states (batch, nx) that an autonomous plant reaches from x (batch, nx), and T of them.

    They are `SETTLED` of z's slowest time constants later, so that z, which is 0 at x, is T(x). On
    an attractor, of which hardly any state comes from far away, these states have a past, while
    those around it have none.

    Args:
        system: the plant.
        dynamics: dynamics of z; in discrete time z is driven by samples of the output.
        x: states that do not escape, shape (batch, nx).
        h: time between samples in s.

    Returns:
        the states (batch, nx), and their z (batch, nz).
    """
    step = system.setups["benchmark"].truth_step
    steps = int(np.ceil(SETTLED / dynamics.slowest / h))
    if dynamics.mode == "discrete":
        t = np.arange(steps + 1) * h
        path = truth(system, x, t, step)
        y = system.h(t[:, None], path, np.empty((len(t), 1, 0)))
        return path[-1], dynamics.filtered(t, y)[-1]
    begin = np.concatenate([x, np.zeros((len(x), dynamics.size))], axis=1)
    joint = _Joint(plant=system, dynamics=dynamics)
    end = truth(joint, begin, np.array([0.0, steps * h]), step)[-1]
    return end[:, : system.nx], end[:, system.nx :]


def _escapes(system: System, x: np.ndarray, duration: float) -> np.ndarray:
    """Return which states (batch, nx) diverge over a duration in s, in the past if it is negative.
    Steps are half as long as usual."""
    setup = system.setups["benchmark"]
    step = setup.truth_step or min(abs(duration) / 100, setup.dt)
    steps = int(np.ceil(2 * abs(duration) / step))
    h, u = duration / steps, np.zeros(system.nu)
    t, now = np.zeros(()), np.asarray(x, dtype=float)
    scale = vector(system.scale, system.nx, "scale")
    away = np.zeros(len(x), dtype=bool)
    with np.errstate(all="ignore"):
        for _ in range(steps):
            now = runge_kutta(lambda stage, x: system.f(t, x, u), now, h)
            away |= ~(abs(now) < FAR * scale).all(axis=-1)
            now = np.where(away[:, None], x, now)
    return away


def frequency(system: System) -> float:
    """Return the mean frequency of the outputs of benchmark episodes, in Hz.

    It is the root mean square of their rate over that of their deviations from the mean, over 2π.
    """
    setup = system.setups["benchmark"]
    x0 = initial_states(system, None, None, 20, seed=0)
    t, x = setup.times, truth(system, x0, setup.times, setup.truth_step)
    y = system.h(t[:, None], x, np.asarray(system.input(t))[:, None])
    rate = (np.diff(y, axis=0) ** 2).mean() / setup.dt**2
    spread = ((y - y.mean(axis=(0, 1))) ** 2).mean()
    return float(np.sqrt(rate / spread) / (2 * np.pi)) if spread > 0 else 0.0


def initial_states(
    system: System,
    low: Sequence[float] | None,
    high: Sequence[float] | None,
    count: int,
    seed: int,
) -> np.ndarray:
    """Draw states (count, nx) from Latin hypercubes over a box.

    Without a box it is that of the benchmark's law (`StartLaw.corners`), of which only the
    admissible states are taken.

    Raises:
        ValueError: in one line, if the corners are not those of a box, or hardly any states of the
            benchmark's box are admissible.
    """
    own_low, own_high = system.setups["benchmark"].start(system.nx).corners
    own = low is None or high is None
    lower = vector(own_low if low is None else low, system.nx, "low")
    upper = vector(own_high if high is None else high, system.nx, "high")
    if not (np.isfinite([lower, upper]).all() and (lower <= upper).all()):
        raise ValueError(f"low={low}, high={high}; expected finite corners, low at most high")
    cube = qmc.LatinHypercube(system.nx, rng=np.random.default_rng(seed))
    states = np.empty((0, system.nx))
    for _ in range(_DRAWS):
        x0 = lower + (upper - lower) * cube.random(count)
        states = np.concatenate([states, x0[system.admissible(x0)] if own else x0])
        if len(states) >= count:
            return states[:count]
    raise ValueError(
        f"{type(system).__name__}: of {_DRAWS * count} states of the box {len(states)} are "
        f"admissible; expected {count}"
    )


@dataclass(frozen=True, eq=False)
class SampledEpisodes:
    """Simulated episodes at the kept samples."""

    t: np.ndarray
    """Time since the first sample, in s, shape (kept,)."""
    u: np.ndarray
    """Inputs, shape (kept, batch, nu) if they are drawn, else (kept, 1, nu)."""
    x: np.ndarray
    """States, shape (kept, batch, nx)."""
    z: np.ndarray
    """z as it occurs online, driven by noise-free samples of y; shape (kept, batch, nz)."""
    x0: np.ndarray
    """Initial states, shape (batch, nx)."""
    flow: np.ndarray
    """Φ from the first sample to each, shape (kept, nz, nz)."""
    T: np.ndarray | None
    """T(x) along the episodes, the z that begins at T(x₀); shape (kept, batch, nz). None if T
    depends on time; NaN in episodes whose T is unknown, since states escape backward."""
    dropped: int
    """Number of initial states that escaped backward, or forward with `reached` ones."""
    drawn: int
    """Number of initial states drawn."""
    reached: int = 0
    """Number of further episodes, at the end, from states that are `reached` forward, since too
    many escape backward."""


def simulated(
    system: System,
    dynamics: Dynamics,
    t: np.ndarray,
    x0: np.ndarray,
    kept: np.ndarray,
    start: Start = "zero",
    xhat0: np.ndarray | None = None,
    rng: np.random.Generator | None = None,
) -> SampledEpisodes:
    """Simulate episodes, and keep some of their samples.

    The T of a `driven` plant depends on time: T(t, x) is the z that begins at the first sample with
    its initial value (Bernard & Andrieu 2019), and nothing is integrated backward.

    Args:
        system: the plant.
        dynamics: dynamics of z.
        t: sample times in s, shape (num_samples,).
        x0: initial states, shape (batch, nx).
        kept: indices of the samples to keep, shape (kept,).
        start: initial value of z.
        xhat0: prior mean, shape (1, nx); needed for ``start="prior"`` unless the plant is driven.
        rng: random generator of inputs that are drawn; one of seed 0 if None.

    Raises:
        ValueError: in one line, if over `MOST_ESCAPED` of the initial states escape, or x̂₀ does and
            z begins at T(x̂₀).
    """
    varying, drawn = driven(system), len(x0)
    T0, h, further = None, float(np.diff(t).mean()), 0
    u = inputs_of(system, t, drawn, np.random.default_rng(0) if rng is None else rng)
    if not varying:  # labels T(x₀), without the states that escape backward
        T0, stays = steady(system, dynamics, x0, h)
        if (~stays).sum() > MOST_ESCAPED * drawn:
            x0, T0, further = _forward(system, dynamics, x0, t, int((~stays).sum()))
        else:
            x0, T0 = x0[stays], T0[stays]
    # Initial z of the online observer.
    first = _driving(system, system.h(t[0], x0, u[0]), u[0])
    z0 = first @ at_rest(dynamics, start).T
    if start == "prior" and not varying:
        assert xhat0 is not None
        at_prior, stays = steady(system, dynamics, xhat0, h)
        if not stays.all():
            raise ValueError(
                f"start='prior', but x̂₀ of {type(system).__name__} escapes when integrated "
                "backward; expected output or zero"
            )
        z0 = z0 + at_prior
    setup = system.setups["benchmark"]
    x = np.empty((len(kept), len(x0), system.nx))
    z = np.empty((len(kept), len(x0), dynamics.size))
    T = None if T0 is None else np.empty_like(z)
    for first in range(0, len(x0), _AT_ONCE):  # blocks, to limit memory
        rows = slice(first, first + _AT_ONCE)
        own = u[:, rows] if system.draws_input else u
        path = truth(
            system, x0[rows], t, setup.truth_step, inputs=own if system.draws_input else None
        )
        y = _driving(system, system.h(t[:, None], path, own), own)
        ends = y
        if system.draws_input and system.input_hold == "previous":
            ends = y.copy()
            ends[1:, :, system.ny :] = own[:-1]
        x[:, rows], z[:, rows] = path[kept], dynamics.filtered(t, y, z0[rows], ends)[kept]
        if T is not None and T0 is not None:  # T(x) along a path is the z that begins at T(x₀)
            T[:, rows] = dynamics.filtered(t, y, T0[rows])[kept]
    flow = dynamics.flows(t)[kept]
    dropped = drawn - (len(x0) - further)
    return SampledEpisodes(t[kept] - t[0], u[kept], x, z, x0, flow, T, dropped, drawn, further)


def _driving(system: System, y: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return what drives z: outputs (..., ny), followed by inputs (..., nu) that are drawn."""
    return np.concatenate([y, u], axis=-1) if system.draws_input else y


def _forward(
    system: System, dynamics: Dynamics, x0: np.ndarray, t: np.ndarray, escaped: int
) -> tuple[np.ndarray, np.ndarray, int]:
    """Return initial states followed by states that are `reached` from them, and T of them.

    Args:
        system: the plant.
        dynamics: dynamics of z.
        x0: initial states, shape (drawn, nx).
        t: sample times of an episode in s, shape (num_samples,).
        escaped: number of initial states that escape backward.

    Returns:
        states (batch, nx); T of them (batch, nz), NaN for the initial states; and the number of
        those at the end that are reached.

    Raises:
        ValueError: in one line, if over `MOST_ESCAPED` of them escape forward, too.
    """
    warm_up = SETTLED / dynamics.slowest
    stays = ~_escapes(system, x0, warm_up + float(t[-1] - t[0]))
    lost = int((~stays).sum())
    if lost > MOST_ESCAPED * len(x0):
        raise ValueError(
            f"{escaped} of {len(x0)} initial states of {type(system).__name__} escape when "
            f"integrated backward for {warm_up:.3g} s, and {lost} forward; expected at most "
            f"{MOST_ESCAPED:.0%}: take faster poles, or a smaller box"
        )
    x0 = x0[stays]
    x, z = reached(system, dynamics, x0, float(np.diff(t).mean()))
    unknown = np.full((len(x0), dynamics.size), np.nan)
    return np.concatenate([x0, x]), np.concatenate([unknown, z]), len(x)


_AT_ONCE = 256
"""Number of episodes whose whole paths are in memory at a time."""


def noise_in_z(
    dynamics: Dynamics,
    t: np.ndarray,
    std: np.ndarray,
    kept: np.ndarray,
    count: int,
    rng: np.random.Generator,
    rest: np.ndarray,
) -> np.ndarray:
    """Draw the effect (kept, count, nz) on z of white noise in the samples of y.

    z is linear in y, so a draw can be added to the z of any episode.

    Args:
        dynamics: dynamics of z.
        t: sample times in s, shape (num_samples,).
        std: standard deviations of the output noise, shape (ny,).
        kept: indices of the samples to keep, shape (kept,).
        count: number of draws.
        rng: random generator.
        rest: initial z per unit of y₀, shape (nz, ny).
    """
    out = np.empty((len(kept), count, dynamics.size))
    for start in range(0, count, _AT_ONCE):
        rows = min(_AT_ONCE, count - start)
        noise = rng.standard_normal((len(t), rows, len(std))) * std
        out[:, start : start + rows] = dynamics.filtered(t, noise, noise[0] @ rest.T)[kept]
    return out
