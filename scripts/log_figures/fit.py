"""Parameters and noise found from logs: how close to the truth, with what standard errors, and in
how much time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
from array_api_compat import array_namespace
from benchmarks import Figure, at_least, at_most, cpu_seconds

from pinnobs_gym.logs.fit import Fit, fit
from pinnobs_gym.logs.reading import Log, read_log
from pinnobs_gym.logs.unknown import unknown_parameters
from pinnobs_gym.simulation.model import noisy_model_step
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Array, Setup, System, independent, stack

SWINGS = Path(__file__).parents[3] / "shared" / "data" / "pendulum"
"""Folder of the recorded pendulum; its figures are left out where it is not there."""
Inputs: TypeAlias = Callable[[np.random.Generator, int], np.ndarray] | None
LOGS = 10
OFF = 1.3
"""Factor by which the search begins off the true parameters."""
OMEGA2 = 64.22
"""What the authors of the recorded pendulum's data found."""


@dataclass(frozen=True)
class Pendulum(System):
    """A pendulum swinging freely, whose angle is measured."""

    omega2: float = OMEGA2
    damping: float = 0.0672

    state_names = ("theta", "omega")
    output_names = ("y1",)
    scale = (1.0, 8.0)
    setups = {
        "benchmark": Setup(
            xhat0=(0.0, 0.0),
            P0=independent(1.0, 3.0),
            dt=0.01,
            noise_std=0.003,
        )
    }

    def f(self, t: Array, x: Array, u: Array) -> Array:
        pull = self.omega2 * array_namespace(x).sin(x[..., 0])
        return stack(x, x[..., 1], -pull - self.damping * x[..., 1])

    def h(self, t: Array, x: Array, u: Array) -> Array:
        return x[..., :1]


@dataclass(frozen=True)
class Reactor(System):
    """A stirred tank with a reaction whose rate grows with the temperature; both are measured."""

    rate: float = 0.5
    heat: float = 20.0
    cooling: float = 0.8

    state_names = ("concentration", "temperature")
    output_names = ("concentration", "temperature")
    input_names = ("coolant",)
    scale = (1.0, 10.0)
    setups = {
        "benchmark": Setup(
            xhat0=(0.8, 10.0),
            P0=independent(0.1, 2.0),
            dt=0.1,
            noise_std=(0.02, 0.3),
        )
    }

    def f(self, t: Array, x: Array, u: Array) -> Array:
        c, T = x[..., 0], x[..., 1]
        burnt = self.rate * c * array_namespace(x).exp(0.05 * T)
        return stack(x, 0.6 * (1 - c) - burnt, self.heat * burnt - self.cooling * (T - u[..., 0]))

    def h(self, t: Array, x: Array, u: Array) -> Array:
        return x


@dataclass(frozen=True)
class Logistic(System):
    """A map: a stock that grows and is caught from, of which the logarithm is measured."""

    growth: float = 0.6
    capacity: float = 10.0

    state_names = ("stock",)
    output_names = ("log_stock",)
    input_names = ("catch",)
    discrete = True
    scale = (5.0,)
    setups = {
        "benchmark": Setup(xhat0=(3.0,), P0=independent(0.5), dt=1.0, noise_std=0.05),
    }

    def f(self, t: Array, x: Array, u: Array) -> Array:
        growth = self.growth * x[..., 0] * (1 - x[..., 0] / self.capacity)
        return stack(x, x[..., 0] + growth - u[..., 0])

    def h(self, t: Array, x: Array, u: Array) -> Array:
        return array_namespace(x).log(x)


@dataclass(frozen=True)
class Oscillator(System):
    """A damped oscillator that noise keeps moving, whose deflection is measured."""

    k: float = 4.0
    c: float = 0.3

    state_names = ("x", "v")
    output_names = ("y1",)
    scale = (1.0, 2.0)
    setups = {
        "benchmark": Setup(
            xhat0=(0.0, 0.0),
            P0=independent(1.0, 1.0),
            dt=0.05,
            noise_std=0.1,
            process_noise=(0.0, 0.5),
        )
    }

    def f(self, t: Array, x: Array, u: Array) -> Array:
        return stack(x, x[..., 1], -self.k * x[..., 0] - self.c * x[..., 1])

    def h(self, t: Array, x: Array, u: Array) -> Array:
        return x[..., :1]


def coolant(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return an input that is changed every 20 samples, (n, 1)."""
    return np.repeat(rng.uniform(0.0, 15.0, n // 20 + 1), 20)[:n, None]


def catch(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return an input that is changed every 10 samples, (n, 1)."""
    return np.repeat(rng.uniform(0.0, 1.0, n // 10 + 1), 10)[:n, None]


PLANTS = (
    (Pendulum, 1000, None, ("omega2", "damping")),
    (Reactor, 600, coolant, ("rate", "heat", "cooling")),
    (Logistic, 200, catch, ("growth", "capacity")),
    (Oscillator, 4000, None, ("k", "c")),
)
"""Plants, numbers of samples, inputs, and the unknown parameters."""
NOISE = (
    (Oscillator, 20_000, None, (0.0, 0.5)),
    (Pendulum, 20_000, None, (0.0, 1.0)),
    (Reactor, 20_000, coolant, (0.02, 0.5)),
)
"""Plants, numbers of samples, inputs and the process noise: lengths at which the standard errors of
all noise are at most 3 %."""


def simulated(system: System, setup: Setup, n: int, seed: int, u: np.ndarray | None = None) -> Log:
    """Return a log of n samples from an initial state of the setup's prior."""
    rng, noise = np.random.default_rng(seed), system.noise(setup.noise_std, setup.process_noise)
    t, prior = setup.dt * np.arange(n), Prior.of(system, setup, 1)
    u = np.zeros((n, system.nu)) if u is None else u
    x = np.empty((n, 1, 1, system.nx))
    x[0] = prior.mean + np.linalg.cholesky(prior.cov[0]) @ rng.standard_normal(system.nx)

    def normal(m: int) -> np.ndarray:
        return rng.standard_normal((1, 1, m))

    for k in range(1, n):
        times, inputs = (t[k - 1], t[k]), (u[None, k - 1], u[None, k])
        x[k] = noisy_model_step(system, noise, *times, x[k - 1], *inputs, normal)
    y = np.asarray(system.h(t[:, None], x[:, 0], u[:, None]))
    y = y + noise.outputs(t, rng.standard_normal((n, 1, system.ny)))
    return Log(Path("log.csv"), system, Record(t, y.swapaxes(0, 1), u[None], prior), np.arange(n))


def figures(repeats: int) -> Iterator[Figure]:
    """Measure fits."""
    for plant, n, inputs, names in PLANTS:
        yield from parameters(plant, n, inputs, names)
    for plant, n, inputs, process_noise in NOISE:
        yield from noise(plant, n, inputs, process_noise)
    if SWINGS.exists():
        yield from recorded()


def logs_of(plant: type[System], setup: Setup, n: int, inputs: Inputs) -> list[Log]:
    """Return ten logs of a plant."""
    system = replace(plant(), measured_input=inputs is not None)
    made = []
    for seed in range(LOGS):
        u = None if inputs is None else inputs(np.random.default_rng(100 + seed), n)
        made.append(simulated(system, setup, n, seed, u))
    return made


def parameters(
    plant: type[System], n: int, inputs: Inputs, names: Sequence[str]
) -> Iterator[Figure]:
    """Measure in how many logs the truth is within three standard errors of what is found."""
    setup, truth, within, seconds = plant.setups["benchmark"], plant(), np.zeros(len(names)), []
    worst = 0.0
    for seed, log in enumerate(logs_of(plant, setup, n, inputs)):
        off = OFF if seed % 2 else 1 / OFF
        asked = [f"{name}={getattr(truth, name) * off}" for name in names]
        fits: list[Fit] = []
        run = cpu_seconds(
            lambda log=log, asked=asked, fits=fits: fits.append(
                fit([log], setup, unknown_parameters(log.system, asked))
            )
        )
        seconds.append(run)
        for i, each in enumerate(fits[0].found):
            true = getattr(truth, each.name)
            within[i] += abs(each.value - true) <= 3 * each.std
            worst = max(worst, each.std / abs(true))
    what = f"{plant.__name__}, {n} samples"
    for name, count in zip(names, within, strict=True):
        yield at_least(f"{what}: {name} within 3 standard errors, of {LOGS}", count, "logs", 9)
    yield Figure(f"{what}: largest standard error", 100 * worst, "%", "", None)
    yield Figure(f"{what}: fit", float(np.median(seconds)), "CPU-s", "", None)


def noise(
    plant: type[System], n: int, inputs: Inputs, process_noise: tuple[float, ...]
) -> Iterator[Figure]:
    """Measure how far the noise that is found is off, from told noise that is three times as large
    as it is, and process noise a third."""
    true = replace(plant.setups["benchmark"], process_noise=process_noise)
    R, L = (np.asarray(level, dtype=float) for level in (true.noise_std, true.process_noise))
    told = replace(
        true,
        noise_std=tuple(np.atleast_1d(3 * R).tolist()),
        process_noise=tuple((L / 3).tolist()),
    )
    off: dict[str, list[float]] = {"output noise": [], "process noise": []}
    errors, seconds = [0.0], []
    for log in logs_of(plant, true, n, inputs):
        fits: list[Fit] = []
        none = unknown_parameters(log.system, ())
        seconds.append(
            cpu_seconds(
                lambda log=log, fits=fits, none=none: fits.append(
                    fit([log], told, none, noise=True)
                )
            )
        )
        made = fits[0].noise
        assert made is not None
        off["output noise"].append(float(abs(made.noise_std / R - 1).max()))
        found = np.diag(made.process_noise)
        off["process noise"].append(float(abs(found[L > 0] / L[L > 0] - 1).max()))
        errors += [each.std / each.value for each in fits[0].found]
    what = f"{plant.__name__}, {n} samples"
    for name, values in off.items():
        yield at_most(f"{what}: {name} off, worst of {LOGS}", 100 * max(values), "%", 10.0)
    yield Figure(f"{what}: largest standard error of noise", 100 * max(errors), "%", "", None)
    yield Figure(f"{what}: fit of noise", float(np.median(seconds)), "CPU-s", "", None)


def recorded() -> Iterator[Figure]:
    """Measure the frequency of the recorded pendulum, from starts 30 % off on both sides."""
    system, setup = Pendulum.configured()
    prior = Prior.of(system, setup, 1)
    logs = [read_log(SWINGS / f"swing-{i}.csv", system, prior) for i in (1, 2)]
    for name, chosen in (("swing 1", logs[:1]), ("swing 2", logs[1:]), ("both swings", logs)):
        off, seconds = [], []
        for start in (OMEGA2 / OFF, OMEGA2 * OFF):
            asked = unknown_parameters(system, [f"omega2={start}", "damping=0.1"])
            fits: list[Fit] = []
            seconds.append(
                cpu_seconds(
                    lambda chosen=chosen, fits=fits, asked=asked: fits.append(
                        fit(chosen, setup, asked)
                    )
                )
            )
            off.append(abs(fits[0].found[0].value / OMEGA2 - 1))
        yield at_most(f"recorded pendulum, {name}: omega2 off", 100 * max(off), "%", 0.5)
        yield Figure(f"recorded pendulum, {name}: fit", max(seconds), "CPU-s", "", None)


if __name__ == "__main__":
    for figure in figures(1):
        told = "" if figure.holds is None else f"  asked {figure.asked}: {figure.holds}"
        print(f"{figure.figure}: {figure.value:.4g} {figure.unit}{told}", flush=True)
