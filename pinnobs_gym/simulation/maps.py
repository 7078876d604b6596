"""The motion of a map x⁺ = f(k, x, u), whose time is counted in steps."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from pinnobs_gym.simulation.bounds import absorbed
from pinnobs_gym.simulation.matrices import identity, outer, product, sandwich
from pinnobs_gym.simulation.motion import Interval, Motion, check_steps
from pinnobs_gym.simulation.noise import Noise, weighted
from pinnobs_gym.simulation.value_shape import of_shape


class Map(Motion):
    """A map, which is exact: no solver is involved.

    The process noise of a step is Lw with w standard normal, so that Q becomes AQAᵀ + LLᵀ at each
    step with A = ∂f/∂x (Anderson & Moore 1979, "Optimal Filtering", section 3.1).
    """

    def step(self, over: Interval, x: np.ndarray) -> np.ndarray:
        for k, u, going in _steps(over):
            x = _chosen(going, of_shape(over.system, "f", over.system.f(k, x, u), x.shape), x)
        return x

    def moments(
        self, over: Interval, noise: Noise | None, x: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        system, (batch, nx) = over.system, x.shape
        F, Q = identity(nx, batch), np.zeros((nx, nx, 1))
        for k, u, going in _steps(over):
            A = np.ascontiguousarray(system.f_jacobian(k, x, u).transpose(1, 2, 0))
            x = _chosen(going, of_shape(system, "f", system.f(k, x, u), x.shape), x)
            row = going if going is None else going[:, 0]
            F = _chosen(row, product(A, F), F)  # chain rule over the steps
            if noise is not None:
                L = noise.L(k if k.ndim else float(k))
                if Q.any() or L.shape[1]:
                    Q = _chosen(row, (sandwich(A, Q) if Q.any() else Q) + outer(L, L), Q)
        return x, F, Q

    def noisy(
        self,
        over: Interval,
        noise: Noise,
        x: np.ndarray,
        normal: Callable[[int], np.ndarray],
    ) -> np.ndarray:
        box = over.system.state_box
        for k, u, _ in _steps(over):
            L = noise.L(float(k))[..., 0]
            x = of_shape(over.system, "f", over.system.f(k, x, u), x.shape)
            if L.shape[1]:
                x = absorbed(x + weighted(L, normal(L.shape[1])), box)
        return x


def _steps(over: Interval) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray | None]]:
    """Yield the number k of each step of an interval, the inputs at it, and which rows take it,
    (batch, 1); None if all do.

    Raises:
        ValueError: in one line, if a time is not a whole number, or the steps are too many.
    """
    t0, t1 = np.asarray(over.t0, dtype=float), np.asarray(over.t1, dtype=float)
    for t in (t0, t1):
        if (t != np.round(t)).any():
            raise ValueError(
                f"t={t[t != np.round(t)].flat[0]:g} of {type(over.system).__name__}, a map; "
                "expected a whole number of steps"
            )
    check_steps(over.system, t0, t1, float((t1 - t0).max(initial=0.0)), 1.0)
    count = (t1 - t0).astype(int)
    for j in range(int(count.max(initial=0))):
        k = np.asarray(t0 + j)
        yield k, over.input(k), None if count.min() > j else (count > j)[:, None]


def _chosen(going: np.ndarray | None, after: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Return what follows in the rows that go on, and what was before in the others."""
    return after if going is None else np.where(going, after, before)
