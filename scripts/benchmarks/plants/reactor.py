"""Bounds of states: a reactor, and the box-constrained step."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import lsq_linear

from benchmarks import Figure, at_least, at_most, median_ratio
from pinnobs_gym.estimation.projection import nearest
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.mhe import MHE
from pinnobs_gym.simulation.bounds import StateBox
from pinnobs_gym.simulation.model import model_step, noisy_model_step
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Array, Setup, System, independent, matrix, stack

RUNS, SAMPLES, DT, NOISE = 20, 101, 0.1, 0.1
NAMES = ("ekf", "ukf", "ckf", "enkf", "particle", "mhe", "rts_smoother")
CERTAIN = "batch_least_squares"
"""An estimator that takes no process noise, and is told none."""
TENTH = 9
"""Index of the first sample that counts."""


@dataclass(frozen=True)
class Reactor(System):
    """2A ⇌ B of two gases, whose total pressure is measured (Haseltine & Rawlings 2005)."""

    state_names = ("pA", "pB")
    output_names = ("p",)
    scale = (1.0, 1.0)
    state_low = (0.0, 0.0)
    setups = {
        "benchmark": Setup(
            x0_low=(3.0, 1.0),
            x0_high=(3.0, 1.0),
            duration=10.0,
            dt=DT,
            noise_std=NOISE,
            process_noise=1e-3 / np.sqrt(DT),
            xhat0=(0.1, 4.5),
            P0=independent(6.0, 6.0),
        )
    }

    def f(self, t: Array, x: Array, u: Array) -> Array:
        rate = 0.16 * x[..., 0] ** 2 - 0.0064 * x[..., 1]
        return stack(x, -2 * rate, rate)

    def h(self, t: Array, x: Array, u: Array) -> Array:
        return (x[..., 0] + x[..., 1])[..., None]

    def f_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        by_a, by_b = 0.32 * x[..., 0], -0.0064
        return matrix(x, [[-2 * by_a, -2 * by_b], [by_a, by_b]])

    def h_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        return matrix(x, [[1.0, 1.0]])


@dataclass(frozen=True)
class Unbounded(Reactor):
    """The reactor without bounds."""

    state_low = None


@dataclass(frozen=True)
class QuietReactor(Reactor):
    """The reactor without process noise."""

    setups = {"benchmark": replace(Reactor.setups["benchmark"], process_noise=0.0)}


def reactor_record(system: System, batch: int, seed: int = 0) -> tuple[np.ndarray, Record]:
    """Return true states (batch, SAMPLES, 2) of a reactor, and their record."""
    rng, t = np.random.default_rng(seed), np.arange(SAMPLES) * DT
    noise, x = system.noise(), np.empty((SAMPLES, batch, 2))
    x[0] = (3.0, 1.0)
    for k in range(1, SAMPLES):
        x[k] = noisy_model_step(
            system,
            noise,
            t[k - 1],
            t[k],
            x[k - 1][None],
            None,
            None,
            lambda m: rng.standard_normal((1, batch, m)),
        )[0]
    y = x.sum(axis=-1, keepdims=True) + NOISE * rng.standard_normal((SAMPLES, batch, 1))
    prior = Prior.of(system, system.setups["benchmark"], batch)
    return x.swapaxes(0, 1), Record(t, y.swapaxes(0, 1), np.zeros((batch, SAMPLES, 0)), prior)


def figures(repeats: int) -> Iterator[Figure]:
    """Measure estimates of the reactor, and the time of the parts that bounds need."""
    x, record = reactor_record(Reactor(), RUNS)
    lowest = np.inf
    for name in (*NAMES, CERTAIN):
        cls, told = ESTIMATORS.resolve(name), 0.0 if name == CERTAIN else None
        plants = Reactor(), Unbounded()
        found, free = (cls(each, process_noise=told).run(record).xhat for each in plants)
        lowest = min(lowest, float(found.min()))
        error, other = (float(np.sqrt(np.mean((e - x)[:, TENTH:] ** 2))) for e in (found, free))
        yield at_most(f"2A=B reactor, {name}, rms error from the tenth sample", error, "", 0.15)
        yield at_least(f"2A=B reactor, {name}, the same without bounds", other, "", None)
    yield at_least("2A=B reactor, lowest pressure of any estimator", lowest, "", 0.0)
    yield from moving_horizon(x, record)
    mhe, quiet, ekf = MHE(Reactor()), MHE(QuietReactor()), EKF(Reactor())
    ratio = median_ratio(lambda: quiet.run(record), lambda: mhe.run(record), repeats)
    yield at_least("MHE, speed with process noise over without, 20 rows", ratio, "x", None)
    free = EKF(Unbounded())
    near = replace(record, prior=Prior(x[:, 0], 1e-2 * np.eye(2)[None].repeat(RUNS, axis=0)))
    ratio = median_ratio(lambda: free.run(near), lambda: ekf.run(near), repeats)
    yield at_least("EKF, speed with bounds that are not met over without", ratio, "x", 0.8)
    yield from box_step(repeats)


def moving_horizon(x: np.ndarray, record: Record) -> Iterator[Figure]:
    """Measure how near moving horizons are from the tenth sample on."""
    found = MHE(Reactor()).run(record)
    assert found.P is not None
    error, std = abs(found.xhat - x), np.sqrt(np.einsum("bkii->bki", found.P))
    inside = float(np.mean((error <= 3 * std)[:, TENTH:]))
    near = float(np.mean((error <= 0.1 * x)[:, TENTH:]))
    at_tenth = float(np.mean((error <= 0.1 * x)[:, TENTH]))
    name = "2A=B reactor, mhe"
    yield at_least(f"{name}, share within 3 deviations from the tenth sample", inside, "", 0.99)
    yield at_least(f"{name}, share within 10 % of the truth from the tenth sample", near, "", 0.97)
    yield at_least(f"{name}, share within 10 % at the tenth sample", at_tenth, "", None)
    mean, std = tenth_on_grid(record)
    exact = float(np.mean(abs(mean - x[:, TENTH]) <= 0.1 * x[:, TENTH]))
    name = "2A=B reactor, mean of the posterior on a grid"
    yield at_least(f"{name}, share within 10 % at the tenth sample", exact, "", None)
    spread = np.mean(std / x[:, TENTH], axis=0)
    for state, share in zip(Reactor.state_names, spread, strict=True):
        yield at_least(f"{name}, deviation of {state} there over truth", float(share), "", None)


def tenth_on_grid(record: Record, number: int = 481) -> tuple[np.ndarray, np.ndarray]:
    """Return the means and standard deviations (batch, 2) of the states at the tenth sample, given
    all outputs until then, from a grid of initial states from 0 to 12. Process noise, 1e-3 per
    sample, is left out."""
    system, axis = Reactor(), np.linspace(0, 12, number)
    path = [np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)]
    u = np.zeros((number**2, 0))
    for k in range(TENTH):
        path.append(model_step(system, k * DT, (k + 1) * DT, path[-1], u, u))
    outputs, last, found = np.stack([x.sum(axis=-1) for x in path]), path[-1], []
    from_prior = (np.square((path[0] - record.prior.mean[0]) / 6.0)).sum(axis=-1)
    for y in record.y[:, : TENTH + 1]:
        cost = from_prior + np.square((y - outputs) / NOISE).sum(axis=0)
        p = np.exp((cost.min() - cost) / 2)
        p /= p.sum()
        mean = p @ last
        found.append((mean, np.sqrt(p @ np.square(last - mean))))
    means, deviations = zip(*found, strict=True)
    return np.stack(means), np.stack(deviations)


def box_step(repeats: int) -> Iterator[Figure]:
    """Compare the nearest point of a box with that of scipy.optimize.lsq_linear."""
    rng, n, batch = np.random.default_rng(0), 5, 100
    A, x = rng.standard_normal((batch, n, n)), 3 * rng.standard_normal((batch, n))
    P, box = A @ A.swapaxes(1, 2) + 1e-3 * np.eye(n), StateBox(-np.ones(n), np.full(n, 0.5))
    roots = np.linalg.inv(np.linalg.cholesky(P))

    def peer() -> np.ndarray:
        bounds = (box.low, box.high)
        rows = zip(roots, x, strict=True)
        return np.array([lsq_linear(W, W @ row, bounds, "bvls", tol=1e-14).x for W, row in rows])

    off = abs(nearest(x, P, box) - peer()).max()
    yield at_most("nearest point of a box of 5, distance from lsq_linear's", float(off), "", 1e-9)
    ratio = median_ratio(peer, lambda: nearest(x, P, box), repeats)
    yield at_least("nearest points of 100 boxes of 5, speed over lsq_linear", ratio, "x", 5.0)
