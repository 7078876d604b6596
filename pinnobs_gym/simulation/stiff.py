"""The motion of a stiff plant: linearly implicit steps whose error is controlled in each row."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from pinnobs_gym.simulation.bounds import absorbed
from pinnobs_gym.simulation.derivatives import central_differences
from pinnobs_gym.simulation.matrices import (
    cholesky,
    identity,
    mapped,
    product,
    sandwich,
)
from pinnobs_gym.simulation.motion import Interval, Motion
from pinnobs_gym.simulation.noise import Noise
from pinnobs_gym.simulation.rosenbrock import Rows, rosenbrock
from pinnobs_gym.simulation.step_control import Step, controlled_steps
from pinnobs_gym.simulation.system import vector

_TERMS = 10
"""Number of terms of the Taylor series for the process noise over a part of a step."""
_NORM = 0.125
"""Largest norm of ∂f/∂x times such a part, for which the remainder of the series is rounding."""
_TOGETHER = 2**14
"""About how many rows are stepped at once for the Jacobians of steps."""


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
        for _, _, after in controlled_steps(over, x):
            x = after
        return x

    def moments(
        self, over: Interval, noise: Noise | None, x: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        batch, nx = x.shape
        F: np.ndarray = identity(nx, batch)
        Q: np.ndarray = np.zeros((nx, nx, 1))
        group: list[Step] = []
        size = max(1, _TOGETHER // (2 * nx * batch))
        for rows, before, after in controlled_steps(over, x):
            x = after
            if rows.step.any():
                group.append((rows, before, after))
            if len(group) == size:
                F, Q = _carried(over, noise, group, F, Q)
                group = []
        if group:
            F, Q = _carried(over, noise, group, F, Q)
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
        return absorbed((end + moved).reshape(x.shape), over.system.state_box)


def _carried(
    over: Interval, noise: Noise | None, steps: Sequence[Step], F: np.ndarray, Q: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the Jacobian F (nx, nx, batch) and the covariance Q (nx, nx, batch or 1) of the
    process noise after further steps. What does not depend on the steps before is computed for all
    of them at once."""
    rows, before, after = zip(*steps, strict=True)
    t, step, last = (
        np.stack([np.broadcast_to(getattr(each, name), each.t.shape) for each in rows])
        for name in ("t", "step", "last")
    )
    joined = Rows(over, t, step, last)
    flows = _step_jacobians(joined, np.stack(before)).transpose(0, 2, 3, 1)
    for flow in np.ascontiguousarray(flows):
        F = product(flow, F)
    root = None if noise is None else noise.root(over.t0)
    if noise is None or root is None or root.L.shape[1] == 0:
        return F, Q
    both, u = joined.at(np.array([0.0, 1.0]), 2)
    A = over.system.f_jacobian(both, np.stack([np.stack(before), np.stack(after)]), u)
    A = np.asarray(A).mean(axis=0)
    (number, batch), nx = t.shape, A.shape[-1]
    A = np.ascontiguousarray(A.reshape(-1, nx, nx).transpose(1, 2, 0))
    density = root.density
    if not noise.constant:
        each = (noise.root(now).density for now in t + step / 2)
        density = np.stack([np.broadcast_to(D, (nx, nx, batch)) for D in each], axis=2)
        density = density.reshape(nx, nx, -1)
    parts = (part.reshape(nx, nx, number, batch) for part in accumulated(A, density, step.ravel()))
    for decay, added in zip(*(part.transpose(2, 0, 1, 3) for part in parts), strict=True):
        Q = sandwich(decay, Q) + added
    return F, Q


def _step_jacobians(rows: Rows, x: np.ndarray) -> np.ndarray:
    """Return the derivatives (number, batch, nx, nx) of steps from x (number, batch, nx), of given
    lengths."""
    with np.errstate(all="ignore"):
        system = rows.over.system
        scale = vector(system.scale, system.nx, "scale")
        jacobian = central_differences(
            lambda at: rosenbrock(rows, at)[0], x, scale, periods=system.state_period
        )
    # A row that stays has a step of length zero, whose Jacobian is the identity.
    return np.where((rows.step > 0)[..., None, None], jacobian, np.eye(x.shape[-1]))


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
