"""The motion of a stiff plant: linearly implicit steps whose error is controlled in each row."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

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


_TOGETHER = 2**14
"""About how many rows are stepped at once for the Jacobians of steps."""

_Step: TypeAlias = tuple[Rows, np.ndarray, np.ndarray]


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
        group: list[_Step] = []
        size = max(1, _TOGETHER // (2 * nx * batch))
        for rows, before, after in _steps(over, x):
            x = after
            if rows.step.any():
                group.append((rows, before, after))
            if len(group) == size:
                F, Q = _carried(over, noise, group, F, Q)
                group = []
        return x, *(_carried(over, noise, group, F, Q) if group else (F, Q))

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


def _steps(over: Interval, x: np.ndarray) -> Iterator[_Step]:
    """Yield each step tried from x (..., nx) to the end of an interval: the rows with their steps,
    zero in those that stay, and the states before and after it. No step crosses a time at which f
    or the input jumps."""
    system, shape = over.system, x.shape[:-1]
    scale = vector(system.scale, system.nx, "scale")
    longest = system.model_step or np.inf
    t = np.broadcast_to(np.asarray(over.t0, dtype=float), shape).copy()
    end = np.broadcast_to(np.asarray(over.t1, dtype=float), shape)
    breaks = np.sort(np.asarray(system.breakpoints(), dtype=float))
    whole = end - t
    wanted = np.minimum(whole, longest)
    for _ in range(_ATTEMPTS):
        stop, last = _piece(breaks, t, end)
        step = np.minimum(wanted, stop - t)
        with np.errstate(all="ignore"):  # a step may be too long for f to be finite
            tried, error = rosenbrock(Rows(over, t, step, last), x)
            size = abs(tried)
            largest = (size / scale).max(axis=-1)
            size = np.maximum(np.maximum(abs(x), size), scale)
            off = (abs(error) / size).max(axis=-1) / STIFF_TOLERANCE
        off = np.where(np.isfinite(largest) & np.isfinite(off), off, np.inf)
        good = off <= 1
        # A row whose state is too large, or whose step would have to be too short, ends here.
        lost = (step > 0) & np.where(good, largest >= _DIVERGED, step <= _SHORTEST * whole)
        taken = np.where(good | lost, step, 0.0)
        after = np.where(good[..., None], tried, x)
        after = np.where(lost[..., None], np.nan, after)
        yield Rows(over, t, taken, last), x, after
        x, ahead = after, t + taken
        ahead = np.where(stop - t - taken <= _SHORTEST * whole, stop, ahead)
        t = np.where(lost, end, ahead)
        if not (t < end).any():
            return
        # The error is of order 4 in the step, by the embedded method of order 3.
        factor = 0.9 * np.maximum(off, 1e-10) ** -0.25
        longer = step * np.minimum(np.maximum(factor, 0.1), 5.0)
        # A step that a jump has shortened says nothing against a longer one after it.
        wanted = np.where(good & (step < wanted), np.maximum(longer, wanted), longer)
        wanted = np.minimum(wanted, longest)
    x = np.where((t < end)[..., None], np.nan, x)
    yield Rows(over, t, np.zeros(shape)), x, x


def _piece(
    breaks: np.ndarray, t: np.ndarray, end: np.ndarray
) -> tuple[np.ndarray, np.ndarray | float]:
    """Return up to which time in s steps from times t (...) may go, at most to ``end`` (...), and
    the latest time at which f is evaluated; see `Rows.last`."""
    if not breaks.size:
        return end, np.inf
    ahead = np.append(breaks, np.inf)[np.searchsorted(breaks, t, side="right")]
    # At its end, a step has the left limit of what jumps there.
    return np.minimum(ahead, end), np.where(ahead <= end, np.nextafter(ahead, -np.inf), np.inf)


def _carried(
    over: Interval, noise: Noise | None, steps: Sequence[_Step], F: np.ndarray, Q: np.ndarray
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
    if noise is None or noise.root(over.t0).L.shape[1] == 0:
        return F, Q
    both, u = joined.at(np.array([0.0, 1.0]), 2)
    A = over.system.f_jacobian(both, np.stack([np.stack(before), np.stack(after)]), u)
    A = np.asarray(A).mean(axis=0)
    (number, batch), nx = t.shape, A.shape[-1]
    A = np.ascontiguousarray(A.reshape(-1, nx, nx).transpose(1, 2, 0))
    density = noise.root(over.t0).density
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
