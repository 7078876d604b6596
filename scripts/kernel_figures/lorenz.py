"""Print the time per sample in ms and the memory in MB of an EKF on Lorenz-96.

The arguments are own or dynamax, nx, and the numbers of episodes, samples and repeats. Memory
is the peak of the process beyond what it held before, as Linux tells it. That of `resource` would
not do: it begins with the memory of the process that started this one.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from kernel_figures.timing import medians
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Array, Setup, System, independent

DT = 0.05


def lorenz(nx: int) -> type[System]:
    """Return Lorenz's system of 1996 with every second state measured."""

    @dataclass(frozen=True)
    class Lorenz(System):
        F: float = 8.0
        state_names = tuple(f"x{i}" for i in range(nx))
        output_names = tuple(f"y{i}" for i in range(0, nx, 2))
        scale = (4.0,) * nx
        state_bound = (20.0,) * nx
        setups = {
            "benchmark": Setup(
                x0_low=(7.0,) * nx,
                x0_high=(9.0,) * nx,
                xhat0=(8.0,) * nx,
                P0=independent(*(1.0,) * nx),
                duration=2.0,
                dt=DT,
                noise_std=0.5,
                truth_step=DT,
                transient=0.5,
            )
        }

        def f(self, t: Array, x: Array, u: Array) -> Array:
            ahead, back, further = (np.roll(x, k, -1) for k in (-1, 1, 2))
            return (ahead - further) * back - x + self.F

        def f_jacobian(self, t: Array, x: Array, u: Array) -> Array:
            i, back = np.arange(nx), np.roll(x, 1, -1)
            J = np.zeros((*x.shape, nx))
            J[..., i, (i + 1) % nx], J[..., i, (i - 2) % nx] = back, -back
            J[..., i, (i - 1) % nx] = np.roll(x, -1, -1) - np.roll(x, 2, -1)
            J[..., i, i] = -1
            return J

        def h(self, t: Array, x: Array, u: Array) -> Array:
            return x[..., ::2]

        def h_jacobian(self, t: Array, x: Array, u: Array) -> Array:
            return np.broadcast_to(np.eye(nx)[::2], (*x.shape[:-1], nx // 2, nx))

    return Lorenz


def dynamax(ekf: EKF, record: Record) -> Any:
    """Return the call of dynamax's EKF, whose model is not traced but written."""
    from kernel_figures import jax_peers
    from kernel_figures.jax_peers import jnp

    def f(t: Any, x: Any, u: Any) -> Any:
        return (jnp.roll(x, -1) - jnp.roll(x, 2)) * jnp.roll(x, 1) - x + 8.0

    written = {"f": f, "h": lambda t, x, u: x[::2], "input": lambda t, x, u: jnp.zeros(0)}
    jax_peers.function = lambda system, name: written[name]
    return jax_peers.dynamax_ekf(ekf, record)


def memory(what: str) -> float:
    """Return the memory of this process in MB: VmRSS, which it holds, or VmHWM, its peak."""
    lines = Path("/proc/self/status").read_text().splitlines()
    (line,) = (each for each in lines if each.startswith(what))
    return int(line.split()[1]) / 1024


def main(whose: str, nx: str, batch: str, samples: str, repeats: str) -> None:
    """Measure and print."""
    n, rows, rng = int(nx), int(batch), np.random.default_rng(0)
    ekf, t = EKF(lorenz(n)()), np.arange(int(samples)) * DT
    mean = 8 + 0.1 * rng.standard_normal((rows, n))
    y = 8 + rng.standard_normal((rows, len(t), n // 2))
    prior = Prior(mean, np.repeat(np.eye(n)[None], rows, 0))
    record = Record(t, y, np.zeros((rows, len(t), 0)), prior)
    if whose == "dynamax":
        import_module("kernel_figures.jax_peers")  # what it holds by itself does not count
    before = memory("VmRSS")
    call = dynamax(ekf, record) if whose == "dynamax" else lambda: ekf.run(record)
    seconds = float(medians([call], int(repeats))[0])
    print(json.dumps([seconds / len(t) * 1e3, memory("VmHWM") - before]))


if __name__ == "__main__":
    main(*sys.argv[1:])
