"""The discrete-time step of the model, shared by model-based estimators, and its Jacobian."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from pinnobs_gym.simulation.arrays import array_namespace
from pinnobs_gym.simulation.bounds import absorbed
from pinnobs_gym.simulation.derivatives import central_differences
from pinnobs_gym.simulation.kernels.asked import is_asked
from pinnobs_gym.simulation.maps import Map
from pinnobs_gym.simulation.matrices import BLAS, identity, outer, product, sandwich
from pinnobs_gym.simulation.motion import Interval, Motion, check_steps, inputs_at
from pinnobs_gym.simulation.noise import Noise, Root
from pinnobs_gym.simulation.own_flow import OwnFlow
from pinnobs_gym.simulation.runge_kutta import longest_step, runge_kutta
from pinnobs_gym.simulation.stiff import Stiff
from pinnobs_gym.simulation.system import Array, System, vector
from pinnobs_gym.simulation.value_shape import of_shape

if TYPE_CHECKING:
    from pinnobs_gym.simulation.kernels.model_kernel import ModelKernel

_STAGES = np.array([0, 1, 1, 2])
"""Index into (start, middle, end) of the step for each of the four Runge-Kutta stages."""

_PARTS = np.array([0.0, 0.5, 1.0])
"""A step's start, middle and end, in steps."""

_ROOT3 = math.sqrt(3)

_MAP, _STIFF, _OWN_FLOW = Map(), Stiff(), OwnFlow()


def _motion(system: System) -> Motion | None:
    """Return how the model moves, None if by Runge-Kutta steps."""
    if type(system).flow is not System.flow:
        return _OWN_FLOW
    if system.discrete:
        return _MAP
    return _STIFF if system.stiff else None


def _compiled(system: System) -> ModelKernel | None:
    """Return the compiled steps of a plant, None unless its library has been asked for."""
    if not is_asked(system, "model"):
        return None
    from pinnobs_gym.simulation.kernels.model_kernel import model_kernel

    return model_kernel(system)


def described(system: System, dt: float) -> str:
    """Return in a few words how a model moves from one sample to the next, dt later."""
    motion = _motion(system)
    if motion is None:
        count = max(1, math.ceil(dt / longest_step(system) - 1e-6))
        return f"{count} Runge-Kutta step{'s' * (count > 1)} per sample"
    texts: dict[Motion, str] = {
        _OWN_FLOW: "by its own flow",
        _MAP: f"a map, {dt:g} step{'s' * (dt > 1)} per sample",
        _STIFF: "stiff: linearly implicit steps of controlled error",
    }
    return texts[motion]


def model_step(
    system: System, t0: Array, t1: Array, x: Array, u0: Array | None = None, u1: Array | None = None
) -> Array:
    """Propagate the model's state x (..., nx) from t0 to t1 (s).

    A map takes its steps, a stiff plant linearly implicit ones (`pinnobs_gym.simulation.stiff`),
    and one that overrides `System.flow` moves by that. Any other moves by the classical
    Runge-Kutta method, in equal steps of at most `longest_step`. Rows (batch, nx) of x may have
    their own times, t0 and t1 of shape (batch,); all rows take the same number of Runge-Kutta
    steps.

    ``u0`` and ``u1`` (..., nu) are the inputs sampled at t0 and t1. They are used only if the
    system's input is measured, between the samples as `System.input_hold` says.

    This and the functions below run in compiled code where the plant's library has been asked for
    (`pinnobs_gym.simulation.kernels.asked`), which agrees with NumPy to rounding.
    """
    compiled = _compiled(system)
    if compiled is not None:
        end = compiled.step(t0, t1, x, u0, u1)
        if end is not None:
            return end
    motion = _motion(system)
    if motion is not None:
        return motion.step(Interval(system, t0, t1, u0, u1), x)
    for t, step, u in substeps(system, t0, t1, x, u0, u1):
        x = runge_kutta(partial(_rate, system, t, u), x, step)
    return x


def noisy_model_step(
    system: System,
    noise: Noise,
    t0: float,
    t1: float,
    x: np.ndarray,
    u0: np.ndarray | None,
    u1: np.ndarray | None,
    normal: Callable[[int], np.ndarray],
) -> np.ndarray:
    """Propagate states x (num_points, batch, nx) as `model_step` does, with process noise.

    Within a substep of length δ the white noise ẇ is replaced by its projection on linear functions
    of time, (z + √3(2s − 1)z')/√δ for s from 0 to 1. Both ∫ẇ dt and ∫∫ẇ dt² have their exact
    covariances, and f is evaluated no more often than without noise. States that noise moves beyond
    a bound are then at that bound (`pinnobs_gym.simulation.bounds.absorbed`).

    Args:
        system: the model.
        noise: its noise.
        t0: the time of x in s.
        t1: the time of the result in s.
        x: states, shape (num_points, batch, nx).
        u0: inputs at t0, shape (batch, nu); see `model_step`.
        u1: inputs at t1, shape (batch, nu).
        normal: returns standard normal numbers (num_points, 1, m) for a given m.

    Maps, stiff plants and those with a flow of their own have noise as
    `pinnobs_gym.simulation.maps`, ``stiff`` and ``own_flow`` say.
    """
    compiled = _compiled(system)
    if compiled is not None:
        end = compiled.noisy(noise, t0, t1, x, u0, u1, normal)
        if end is not None:
            return end
    motion = _motion(system)
    if motion is not None:
        return motion.noisy(Interval(system, t0, t1, u0, u1), noise, x, normal)
    box = system.state_box
    for t, step, u in substeps(system, t0, t1, x, u0, u1):
        roots = _roots(noise, t)
        rate = partial(_rate, system, t, u)
        if size := roots[0].L.shape[1]:
            forces = _forces(roots, float(step), normal(2 * size))
            rate = partial(_forced, rate, forces)
        x = runge_kutta(rate, x, step)
        if size:
            x = absorbed(x, box)
    return x


def _roots(noise: Noise, t: np.ndarray) -> Sequence[Root]:
    """Return L of the process noise at each of the times t (3,) or (3, batch) in s."""
    if noise.constant:
        return (noise.root(0.0),) * 3
    return [noise.root(now) for now in (t if t.ndim == 2 else t.tolist())]


def _forces(roots: Sequence[Root], step: float, drawn: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return Lẇ (num_points, 1, nx) at the four stages of a step (s), given L at its start, middle
    and end, and standard normal numbers (num_points, 1, 2m)."""
    start, middle, end = roots
    drawn = drawn / math.sqrt(step)
    size = drawn.shape[-1] // 2
    even, odd = drawn[..., :size], _ROOT3 * drawn[..., size:]
    halfway = middle.times(even)
    return start.times(even - odd), halfway, halfway, end.times(even + odd)


def _forced(
    rate: Callable[[int, np.ndarray], np.ndarray],
    forces: Sequence[np.ndarray],
    stage: int,
    x: np.ndarray,
) -> np.ndarray:
    """Return the rate of change at a stage with the force at that stage."""
    return rate(stage, x) + forces[stage]


def _rate(system: System, t: Array, u: Array, stage: int, x: Array) -> Array:
    """Return f at a stage of a step with times t (3, ...) and inputs u (3, ..., nu)."""
    k = _STAGES[stage]
    return of_shape(system, "f", system.f(t[k], x, u[k]), x.shape)


def model_step_jacobian(
    system: System,
    t0: float | np.ndarray,
    t1: float | np.ndarray,
    x: np.ndarray,
    u0: np.ndarray | None = None,
    u1: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return `model_step` of x (batch, nx), and its exact Jacobian ∂x(t1)/∂x(t0), shape (batch, nx,
    nx), with the batch innermost in memory."""
    compiled = _compiled(system)
    if compiled is not None:
        moved = compiled.moments(None, t0, t1, x, u0, u1)
        if moved is not None:
            return moved[0], moved[1].transpose(2, 0, 1)
    motion = _motion(system)
    if motion is not None:
        x, F, _ = motion.moments(Interval(system, t0, t1, u0, u1), None, x)
        return x, F.transpose(2, 0, 1)
    F = None
    for end, flow, _, _ in _linearised_steps(system, t0, t1, x, u0, u1):
        x, F = end, flow if F is None else product(flow, F)  # chain rule over the substeps
    assert F is not None  # there is at least one substep
    return x, F.transpose(2, 0, 1)


def model_step_moments(
    system: System,
    noise: Noise,
    t0: float | np.ndarray,
    t1: float | np.ndarray,
    x: np.ndarray,
    u0: np.ndarray | None = None,
    u1: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return `model_step` of x, its Jacobian F (nx, nx, batch), and the covariance Q of the process
    noise over the step, (nx, nx, batch or 1), to first order about the trajectory.

    Q = ∫Ψ L Lᵀ Ψᵀ ds, where Ψ(s) = ∂x(t1)/∂x(s), by Simpson's rule over each substep (Van Loan 1978
    for constant A). Ψ at the middle is the cubic Hermite polynomial through its values and slopes
    −ΨA at the ends, which costs no evaluation of f. Neither the number of substeps nor samples
    between without any output change Q beyond the error of the rule, of fourth order. See
    `noisy_model_step` for other motions.

    States x are (batch, nx), or (num_points, batch, nx); of several points, F and Q belong to the
    first.
    """
    compiled = _compiled(system)
    if compiled is not None:
        moved = compiled.moments(noise, t0, t1, x, u0, u1)
        if moved is not None:
            return moved
    motion = _motion(system)
    if motion is not None:
        over = Interval(system, t0, t1, u0, u1)
        if x.ndim == 2:
            return motion.moments(over, noise, x)
        first, F, Q = motion.moments(over, noise, x[0])
        return np.concatenate([first[None], motion.step(over, x[1:])]), F, Q
    F, Q = None, None
    for end, flow, A, (t, h) in _linearised_steps(system, t0, t1, x, u0, u1):
        x, F = end, flow if F is None else product(flow, F)  # chain rule over the substeps
        roots = _roots(noise, t)
        if roots[0].L.shape[1]:
            added = _accumulated(roots, flow, A, h)
            Q = added if Q is None else sandwich(flow, Q) + added
    assert F is not None  # there is at least one substep
    return x, F, np.zeros((len(F), len(F), 1)) if Q is None else Q


def _accumulated(roots: Sequence[Root], flow: np.ndarray, A: np.ndarray, h: Array) -> np.ndarray:
    """Return the covariance (nx, nx, batch) of the process noise over one substep.

    Args:
        roots: L at the start, the middle and the end of the substep.
        flow: the Jacobian of the substep, shape (nx, nx, batch).
        A: those of f at its four stages, shape (4, nx, nx, batch).
        h: its length in s, a number or one for each row (batch,).
    """
    start, middle, end = roots
    # Simpson's weights are 1/6, 4/6 and 1/6; this is twice Ψ at the middle.
    twice = A[3] - product(flow, A[0])
    twice *= h / 4
    twice += flow
    twice += identity(*flow.shape[1:])
    parts = np.concatenate([start.mapped(flow), middle.mapped(twice)], axis=1)
    added = outer(parts, parts)
    added += end.density
    added *= h / 6
    return added


def flow_jacobian(
    system: System, t0: float | np.ndarray, t1: float | np.ndarray, x: np.ndarray, u: np.ndarray
) -> np.ndarray:
    """Return the derivative (batch, nx, nx) of `System.flow` at x (batch, nx): by central
    differences if the class overrides it, and that of `model_step` otherwise."""
    if system.own_flow:
        scale = vector(system.scale, system.nx, "scale")
        return central_differences(
            lambda at: system.flow(t0, t1, at, u), x, scale, periods=system.state_period
        )
    return model_step_jacobian(system, t0, t1, x, u, u)[1]


def _linearised_steps(
    system: System,
    t0: float | np.ndarray,
    t1: float | np.ndarray,
    x: np.ndarray,
    u0: np.ndarray | None,
    u1: np.ndarray | None,
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, tuple[np.ndarray, Array]]]:
    """Yield, for each substep of `model_step`, the states x at its end, the Jacobian (nx, nx,
    batch) of the substep, those of f at its four stages (4, nx, nx, batch), and the times of its
    start, middle and end, with its length. Jacobians are those along the first of several points.
    """
    batch, nx = x.shape[-2:]
    inside: Any = (1, 0) if x.ndim == 2 else (2, 0, 1)
    outside: Any = (1, 0) if x.ndim == 2 else (1, 2, 0)
    # The batch is last here; the system gets transposed views.
    x = np.ascontiguousarray(x.transpose(inside))
    start = identity(nx, batch)
    points = np.empty((4, *x.shape))
    shown = [each.transpose(outside) for each in points]
    linearised = (points if x.ndim == 2 else points[:, :, 0]).transpose(0, 2, 1)
    for t, step, u in substeps(system, t0, t1, x.transpose(outside), u0, u1):
        by_row = t.ndim == 2
        h = step[:, 0] if by_row else step
        times, inputs = t[_STAGES], u[_STAGES]

        def rate(
            stage: int, at: np.ndarray, times: np.ndarray = times, inputs: np.ndarray = inputs
        ) -> np.ndarray:
            points[stage] = at
            value, states = system.f(times[stage], shown[stage], inputs[stage]), shown[stage]
            return of_shape(system, "f", value, states.shape).transpose(inside)

        x = runge_kutta(rate, x, h)
        # Jacobians A of f at the four stages.
        A = system.f_jacobian(
            times if by_row else times[:, None],
            linearised,
            inputs[:, None] if u.ndim == 2 else inputs,
        )
        A = A.transpose(0, 2, 3, 1)  # (4, nx, nx, batch)
        if nx < BLAS:  # the products of others have the batch first in memory
            A = np.ascontiguousarray(A)
        # Integrate the variational equation Φ' = A(t)Φ by the same method at the same stages.
        flow = runge_kutta(partial(_variation, A), start, h)
        yield x.transpose(outside), flow, A, (t, h)


def _variation(A: np.ndarray, stage: int, flow: np.ndarray) -> np.ndarray:
    """Return Φ' = AΦ, (nx, nx, batch), given the flow Φ since the start of the step and A (4, nx,
    nx, batch)."""
    return A[stage] if stage == 0 else product(A[stage], flow)  # Φ = I at the start


def substeps(
    system: System,
    t0: Array,
    t1: Array,
    x: Array,
    u0: Array | None,
    u1: Array | None,
    longest: float = np.inf,
) -> Iterator[tuple[Array, Array, Array]]:
    """Yield the Runge-Kutta steps of `model_step` from t0 to t1, none longer than ``longest`` (s).

    Each item holds the three times (s) at which f is evaluated, the length of the step, and the
    inputs at these times, (3, ..., nu). The times are (3,) or, where t0 and t1 are arrays (batch,),
    (3, batch), and the length is (batch, 1).

    Raises:
        ValueError: in one line, if they would be too many, see
            `pinnobs_gym.simulation.motion.check_steps`.
    """
    xp = array_namespace(x)
    longest = min(longest, longest_step(system))
    by_row = getattr(t0, "ndim", 0) > 0
    breaks = system.breakpoints()
    if breaks:
        yield from _between_breaks(system, breaks, (t0, t1), (u0, u1), longest)
        return
    whole = t1 - t0
    count = max(1, math.ceil(float(whole.max() if by_row else whole) / longest - 1e-6))
    check_steps(system, t0, t1, count, longest)
    # All rows take the number of steps that the longest interval needs.
    step = whole[:, None] / count if by_row else float(whole) / count
    parts = _PARTS if xp is np else xp.asarray(_PARTS, dtype=x.dtype)
    for k in range(count):
        part = parts + k if k else parts
        after = part * step
        t = t0 + (after.T if by_row else after)
        yield t, step, inputs_at(system, t, part / count, u0, u1)


def _between_breaks(
    system: System,
    breaks: Sequence[float],
    times: tuple[Array, Array],
    inputs: tuple[Array | None, Array | None],
    longest: float,
) -> Iterator[tuple[Array, Array, Array]]:
    """Yield steps as `substeps` does, none of which crosses one of the times (s) at which f or the
    input jumps. Rows without such a time in a part have a step of length zero there."""
    t0, t1 = (np.asarray(t, dtype=float) for t in times)
    inside = [b for b in sorted(breaks) if (t0 < b).any() and (b < t1).any()]
    check_steps(system, t0, t1, len(inside) + float((t1 - t0).max()) / longest, longest)
    ends = [t0, *(np.clip(b, t0, t1) for b in inside), t1]
    whole = np.maximum(t1 - t0, np.finfo(float).tiny)
    for start, end in pairwise(ends):
        count = max(1, math.ceil(float((end - start).max()) / longest - 1e-6))
        step = (end - start) / count
        # At its end, a part has the left limit of what jumps there.
        last = np.where(np.isin(end, breaks) & (end > start), np.nextafter(end, start), end)
        for k in range(count):
            t = np.minimum(start + np.multiply.outer(_PARTS + k, step), last)
            part = (t - t0) / whole
            yield (
                t,
                step[:, None] if step.ndim else float(step),
                inputs_at(system, t, part, *inputs),
            )
