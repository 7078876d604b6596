"""A battery cell whose current is measured with noise: its charge, and its unknown constants."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from benchmarks import Figure, at_least, at_most
from pinnobs_gym.estimation.estimator import Estimates
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.simulation.augmented import Unknown, augmented
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Array, Setup, System, independent, stack
from pinnobs_gym.simulation.table import table

CHARGE = tuple(np.linspace(0.0, 1.0, 11).tolist())
VOLTAGE = (3.00, 3.40, 3.50, 3.57, 3.62, 3.68, 3.76, 3.86, 3.96, 4.07, 4.19)
CAPACITY, RESISTANCE = 2.9, 0.02
TIME_CONSTANT, CAPACITANCE = 30.0, 1500.0
"""Those of the resistor and the capacitor in parallel, in s and F."""
DURATION, DT = 4872.0, 1.0
"""Length of a drive, whose mean current takes the charge from 0.9 to 0.2, and of a sample, in s."""
CURRENT_NOISE, VOLTAGE_NOISE = 0.02, 5e-3
"""Standard deviations of the sensors in A and V."""
RUNS = 20
SETTLED = 300
"""Index of the first sample whose error counts in the root mean square."""
UNKNOWN = {"R0": Unknown(0.03, 0.01), "capacity": Unknown(3.2, 0.3)}


@dataclass(frozen=True)
class Battery(System):
    """A lithium-ion cell with one RC pair (Plett 2004), whose current is held and measured.

    The error n of the current sensor, with standard deviation σ, is constant over a sample of
    length δ, and new in the next. The model moves by the measured current, so -n/(3600 C) and
    n/C₁ are forces on charge and V₁. White noise with the same effect over a sample is the column
    σ√δ (-1/(3600 C), 1/C₁) of L. The voltage's noise has the variance of its own sensor and that
    of R₀n. The correlation of R₀n with the process noise is left out: 0.4 mV beside 5 mV.
    """

    R0: float = RESISTANCE
    """Resistance in series (Ω)."""
    capacity: float = CAPACITY
    """Capacity (A·h)."""

    state_names = ("SoC", "V1")
    output_names = ("V",)
    input_names = ("i",)
    units: ClassVar = {"V1": "V", "V": "V", "i": "A", "R0": "Ω", "capacity": "A·h"}
    scale = (0.3, 0.05)
    setups: ClassVar = {
        "benchmark": Setup(
            x0_low=(0.9, 0.0),
            x0_high=(0.9, 0.0),
            xhat0=(0.7, 0.0),
            P0=independent(0.2, 0.01),
            duration=DURATION,
            dt=DT,
            noise_std=float(np.hypot(VOLTAGE_NOISE, RESISTANCE * CURRENT_NOISE)),
            process_noise=(
                (-CURRENT_NOISE * DT**0.5 / (3600 * CAPACITY),),
                (CURRENT_NOISE * DT**0.5 / CAPACITANCE,),
            ),
        )
    }

    def f(self, t: Array, x: Array, u: Array) -> Array:
        i = u[..., 0]
        rate = -i / (3600 * self.capacity)
        return stack(x, rate, i / CAPACITANCE - x[..., 1] / TIME_CONSTANT)

    def h(self, t: Array, x: Array, u: Array) -> Array:
        open_circuit = table(x[..., 0], CHARGE, VOLTAGE, "monotone")
        return stack(x, open_circuit - x[..., 1] - self.R0 * u[..., 0])

    def draw_input(self, rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
        """A drive of random steps from -3 to 6 A, each of 10 to 60 s."""
        ends = np.cumsum(rng.uniform(10.0, 60.0, 1 + int(times[-1] / 10.0)))
        i = rng.uniform(-3.0, 6.0, len(ends))[np.searchsorted(ends, times)]
        # The same charge is taken from the cell in every drive.
        return np.clip(i - i.mean() + 0.7 * 3600 * CAPACITY / DURATION, -3.0, 6.0)[:, None]


def drives(runs: int) -> tuple[np.ndarray, Record]:
    """Return true states (runs, num_samples, 2), from the exact solution between samples, and the
    record of noisy voltages and currents."""
    system, rng = Battery(), np.random.default_rng(0)
    setup = system.setups["benchmark"]
    t = setup.times
    i = np.stack([system.draw_input(rng, t) for _ in range(runs)])
    x = np.empty((runs, len(t), 2))
    x[:, 0] = (0.9, 0.0)
    left = np.exp(-DT / TIME_CONSTANT)
    for k in range(len(t) - 1):
        x[:, k + 1, 0] = x[:, k, 0] - i[:, k, 0] * DT / (3600 * CAPACITY)
        at_rest = i[:, k, 0] * TIME_CONSTANT / CAPACITANCE
        x[:, k + 1, 1] = at_rest + left * (x[:, k, 1] - at_rest)
    y = system.h(t, x, i) + VOLTAGE_NOISE * rng.standard_normal((runs, len(t), 1))
    measured = i + CURRENT_NOISE * rng.standard_normal(i.shape)
    return x, Record(t, y, measured, Prior.of(system, setup, runs))


def found(name: str, system: System, record: Record) -> Estimates:
    """Return the estimates of an estimator, whose prior is that of the system."""
    setup = system.setups["benchmark"]
    own = Record(record.t, record.y, record.u, Prior.of(system, setup, record.batch))
    return ESTIMATORS.resolve(name).for_setup(system, setup).run(own)


def figures(repeats: int) -> Iterator[Figure]:
    """Errors of the charge with known and with unknown constants, and those of the constants."""
    x, record = drives(RUNS)
    known = Battery(measured_input=True)
    for name in ("ekf", "ukf"):
        for said, system in (
            ("", known),
            (", R0 and capacity unknown", augmented(known, parameters=UNKNOWN)),
        ):
            what, own = f"battery, {name}{said}", found(name, system, record)
            assert own.P is not None
            std = np.sqrt(np.einsum("bkii->bki", own.P))
            error = own.xhat[..., 0] - x[..., 0]
            inside = float(np.mean(abs(error) <= 3 * std[..., 0]))
            yield at_least(f"{what}: SoC within 3σ, of the time", 100 * inside, "%", 99.0)
            rms = float(np.sqrt((error[:, SETTLED:] ** 2).mean(axis=1)).max())
            yield at_most(f"{what}: SoC after {SETTLED} s, worst rms", 100 * rms, "%", 1.0)
            if said:
                for j, (constant, true) in enumerate(
                    (("R0", RESISTANCE), ("capacity", CAPACITY)), start=2
                ):
                    off = abs(own.xhat[:, -1, j] - true)
                    worst = float((off / std[:, -1, j]).max())
                    yield at_most(f"{what}: {constant}, largest of {RUNS}", worst, "σ", 3.0)
                    share = 100 * float(off.max() / true)
                    yield Figure(f"{what}: {constant}, largest error", share, "%", "", None)
