"""The motion of a plant that overrides `System.flow`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pinnobs_gym.simulation.bounds import absorbed
from pinnobs_gym.simulation.matrices import outer, product
from pinnobs_gym.simulation.motion import Interval, Motion
from pinnobs_gym.simulation.noise import Noise, weighted
from pinnobs_gym.simulation.system import Array

_WEIGHTS = (1 / 6, 4 / 6, 1 / 6)
"""Simpson's weights of the start, the middle and the end of an interval."""


class OwnFlow(Motion):
    """A plant's own propagation.

    Its process noise acts at the start, the middle and the end of the interval, with Simpson's
    weights: Q = δ/6 Σ wᵢ Φᵢ L Lᵀ Φᵢᵀ, Φᵢ the derivative of the flow from that time to the end.
    """

    def step(self, over: Interval, x: np.ndarray) -> np.ndarray:
        return over.system.flow(over.t0, over.t1, x, over.input(np.asarray(over.t0)))

    def moments(
        self, over: Interval, noise: Noise | None, x: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        system, u = over.system, over.input(np.asarray(over.t0))
        end = system.flow(over.t0, over.t1, x, u)
        F = _innermost(system.flow_jacobian(over.t0, over.t1, x, u))
        times = over.t0, over.t0 + (over.t1 - over.t0) / 2, over.t1
        L = [noise.L(now) for now in times] if noise is not None else []
        if not L or L[0].shape[1] == 0:
            return end, F, np.zeros((*F.shape[:2], 1))
        middle = system.flow(times[0], times[1], x, u)
        half = _innermost(system.flow_jacobian(times[1], times[2], middle, u))
        parts = product(F, L[0]), product(half, L[1]), L[2]
        length = over.t1 - over.t0
        return end, F, length * sum(w * outer(p, p) for w, p in zip(_WEIGHTS, parts, strict=True))

    def noisy(
        self,
        over: Interval,
        noise: Noise,
        x: np.ndarray,
        normal: Callable[[int], np.ndarray],
    ) -> np.ndarray:
        times = over.t0, over.t0 + (over.t1 - over.t0) / 2, over.t1
        L = [noise.L(float(now))[..., 0] for now in times]
        size, u = L[0].shape[1], over.input(np.asarray(over.t0))
        if not size:
            return over.system.flow(over.t0, over.t1, x, u)
        kicks = np.split(normal(3 * size), 3, axis=-1)
        # A kick of Simpson's weight at each of the three times, and the flow between them.
        for i, (M, w, kick) in enumerate(zip(L, _WEIGHTS, kicks, strict=True)):
            if i:
                x = over.system.flow(times[i - 1], times[i], x, u)
            kicked = x + np.sqrt(w * (over.t1 - over.t0)) * weighted(M, kick)
            x = absorbed(kicked, over.system.state_box)
        return x


def _innermost(jacobian: Array) -> np.ndarray:
    """Return a Jacobian (batch, nx, nx) with the batch last and innermost in memory."""
    return np.ascontiguousarray(np.asarray(jacobian).transpose(1, 2, 0))
