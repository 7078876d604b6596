"""The motion of a stiff plant: linearly implicit steps whose error is controlled in each row."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from pinnobs_gym.simulation.derivatives import central_differences
from pinnobs_gym.simulation.matrices import (
    cholesky,
    identity,
    mapped,
    outer,
    product,
    sandwich,
)
from pinnobs_gym.simulation.motion import Interval, Motion, check_steps
from pinnobs_gym.simulation.noise import Noise
from pinnobs_gym.simulation.rosenbrock import Rows, rosenbrock
from pinnobs_gym.simulation.system import vector

STIFF_TOLERANCE = 1e-8
"""Largest local error of a step, relative to the larger of a state and its scale."""

_ATTEMPTS = 10_000
"""Number of steps tried between two samples after which a row counts as diverged."""
_SHORTEST = 1e-14
"""Shortest step, relative to the interval; a row that needs a shorter one counts as diverged."""
_DIVERGED = 1e9
"""Size of a state, relative to its scale, at which a row counts as diverged."""
_TERMS = 10
"""Number of terms of the Taylor series for the process noise over a part of a step."""
_NORM = 0.125
"""Largest norm of ∂f/∂x times such a part, for which the remainder of the series is rounding."""


class Stiff(Motion):
    """RODAS (`pinnobs_gym.simulation.rosenbrock`) with steps of each row's own, so that a row has
    the same result in any batch. A row that cannot go on becomes NaN.

    The Jacobian of a step is that of the method itself, by central differences of the step with its
    length fixed; its relative error is about 1e-9. The process noise over a step is exact for
    constant A = ∂f/∂x, of which the mean of both ends is taken: ∫e^(As) L Lᵀ e^(Aᵀs) ds. Simpson's
    rule would overestimate it by far in directions that decay within a step. Noisy states are moved
    without noise, and then disturbed by noise of that covariance.
    """

    def step(self, over: Interval, x: np.ndarray) -> np.ndarray:
        for _, _, after in _steps(over, x):
            x = after
        return x

    def moments(
        self, over: Interval, noise: Noise | None, x: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        batch, nx = x.shape
        F, Q = identity(nx, batch), np.zeros((nx, nx, 1))
        for rows, before, after in _steps(over, x):
            x = after
            # A row that stays has a step of length zero, whose Jacobian is the identity.
            flow = np.ascontiguousarray(_step_jacobian(rows, before).transpose(1, 2, 0))
            F = product(flow, F)
            if noise is not None:
                L = noise.L(rows.t + rows.step / 2)
                if L.shape[1]:
                    A = (rows.jacobian(0.0, before) + rows.jacobian(1.0, after)) / 2
                    A = np.ascontiguousarray(A.transpose(1, 2, 0))
                    decay, added = accumulated(A, outer(L, L), rows.step)
                    Q = sandwich(decay, Q) + added
        return x, F, Q

    def noisy(
        self,
        over: Interval,
        noise: Noise,
        x: np.ndarray,
        normal: Callable[[int], np.ndarray],
    ) -> np.ndarray:
        if noise.L(over.t0).shape[1] == 0:
            return self.step(over, x)
        points, batch, nx = x.shape

        def flat(values: np.ndarray) -> np.ndarray:
            """Return one row for each point of each row of the batch."""
            return np.broadcast_to(values, (points, batch, values.shape[-1])).reshape(
                points * batch, -1
            )

        u0, u1 = (None if u is None else flat(u) for u in (over.u0, over.u1))
        end, _, Q = self.moments(replace(over, u0=u0, u1=u1), noise, flat(x))
        moved = mapped(cholesky(Q, semidefinite=True), flat(normal(nx)))
        return (end + moved).reshape(x.shape)


def _steps(over: Interval, x: np.ndarray) -> Iterator[tuple[Rows, np.ndarray, np.ndarray]]:
    """Yield each step from x (..., nx) to the end of an interval: the rows with their steps, zero
    in those that stay, and the states before and after it."""
    system, shape = over.system, x.shape[:-1]
    scale = vector(system.scale, system.nx, "scale")
    t = np.broadcast_to(np.asarray(over.t0, dtype=float), shape).copy()
    end = np.broadcast_to(np.asarray(over.t1, dtype=float), shape)
    whole = end - t
    if system.model_step is not None:
        count = float(whole.max(initial=0.0)) / system.model_step
        check_steps(system, t, end, count, system.model_step)
    step = np.minimum(whole, system.model_step or np.inf)
    for _ in range(_ATTEMPTS):
        with np.errstate(all="ignore"):  # a step may be too long for f to be finite
            tried, error = rosenbrock(Rows(over, t, step), x)
            size = np.maximum(np.maximum(abs(x), abs(tried)), scale)
            off = (abs(error) / size).max(axis=-1) / STIFF_TOLERANCE
        off = np.where(np.isfinite(tried).all(axis=-1) & np.isfinite(off), off, np.inf)
        # A row whose state is too large, or whose step would have to be too short, ends here.
        large = (off <= 1) & ~((abs(tried) / scale).max(axis=-1) < _DIVERGED)
        lost = (step > 0) & (large | ((off > 1) & (step <= _SHORTEST * whole)))
        taken = np.where((off <= 1) | lost, step, 0.0)
        after = np.where((off <= 1)[..., None], tried, x)
        after = np.where(lost[..., None], np.nan, after)
        yield Rows(over, t, taken), x, after
        x, left = after, np.where(lost, 0.0, end - t - taken)
        t = np.where(left <= _SHORTEST * whole, end, t + taken)
        left = end - t
        if not left.any():
            return
        # The error is of order 4 in the step, by the embedded method of order 3.
        factor = np.clip(0.9 * np.maximum(off, 1e-10) ** -0.25, 0.1, 5.0)
        step = np.minimum(np.minimum(step * factor, left), system.model_step or np.inf)
    x = np.where((t < end)[..., None], np.nan, x)
    yield Rows(over, t, np.zeros(shape)), x, x


def _step_jacobian(rows: Rows, x: np.ndarray) -> np.ndarray:
    """Return the derivative (batch, nx, nx) of a step from x (batch, nx), of given length."""
    with np.errstate(all="ignore"):
        system = rows.over.system
        scale = vector(system.scale, system.nx, "scale")
        jacobian = central_differences(
            lambda at: rosenbrock(rows, at)[0], x, scale, periods=system.state_period
        )
    return np.where((rows.step > 0)[:, None, None], jacobian, np.eye(x.shape[-1]))


def accumulated(
    A: np.ndarray, density: np.ndarray, length: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return e^(As) over a length s, and ∫e^(As) D e^(Aᵀs) ds, (n, n, batch) each, for A (n, n,
    batch), constant, the density D (n, n, batch or 1) of white noise, and the rows' own lengths
    (batch,).

    The length is halved until a Taylor series converges at once. Doubling it again costs two
    products: Q(2s) = Q(s) + e^(As) Q(s) e^(Aᵀs) (Moler & Van Loan 1978, method 3, for Φ).
    """
    norm = abs(A).sum(axis=0).max(axis=0) * length
    norm = np.where(np.isfinite(norm), norm, 0.0)
    doublings = np.ceil(np.log2(np.maximum(norm / _NORM, 1.0))).astype(int)
    s = length / 2.0**doublings
    part, power = s * density, identity(*A.shape[1:])
    Q, flow = part, power
    for k in range(1, _TERMS + 1):
        part = product(A, part)
        part = s / (k + 1) * (part + part.swapaxes(0, 1))
        power = s / k * product(A, power)
        Q, flow = Q + part, flow + power
    for i in range(int(doublings.max(initial=0))):
        going = i < doublings
        Q = np.where(going, Q + sandwich(flow, Q), Q)
        flow = np.where(going, product(flow, flow), flow)
    return flow, Q
