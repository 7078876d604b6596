"""Design of constant observer gains, and the correction of an observer at a sample."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from pinnobs_gym.simulation.cached import cached_by_plant
from pinnobs_gym.simulation.model import model_step, model_step_jacobian
from pinnobs_gym.simulation.system import System, initial_states, output_scale, vector

TIME_CONSTANTS = 20.0
"""Duration of a benchmark episode over an observer's time constant, by default."""
_STATES = 16
"""Number of initial states for which gains are designed."""


def default_rate(system: System) -> float:
    """Return the default decay rate of errors in 1/s, by the same rule for all systems."""
    return TIME_CONSTANTS / system.setups["benchmark"].duration


def design_states(system: System) -> np.ndarray:
    """Return the initial states (16, nx) for which gains are designed: admissible states of the
    benchmark's initial set, the same at every call."""
    return initial_states(system, system.setups["benchmark"], _STATES)


def operating_points(system: System) -> tuple[float, np.ndarray]:
    """Return the time (s) and the states (num_points, nx) of linearisation.

    They are the model's states after a quarter of a benchmark episode from each of the
    `design_states`; those that are not finite are left out.

    Raises:
        ValueError: in one line, if none is finite.
    """
    x = design_states(system)
    times = system.setups["benchmark"].times
    times = times[: len(times) // 4 + 1]
    u = np.asarray(system.input(times))[:, None]
    with np.errstate(all="ignore"):
        for k in range(len(times) - 1):
            x = model_step(system, times[k], times[k + 1], x, u[k], u[k + 1])
    x = x[np.isfinite(x).all(axis=1)]
    if not len(x):
        raise ValueError(f"{type(system).__name__}: the model diverges from all design states")
    return float(times[-1]), x


def linearised_scaled(
    system: System, t: float, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A and H at a state (nx,), for states and outputs divided by their scales, and the
    scale of the states (nx,). With scaled outputs, designs do not depend on the outputs' units.

    Raises:
        ValueError: if (A, H) is not observable.
    """
    now, scale = np.asarray(t), vector(system.scale, system.nx, "scale")
    u = np.asarray(system.input(now))
    A = np.asarray(system.f_jacobian(now, x, u)) * scale / scale[:, None]
    H = np.asarray(system.h_jacobian(now, x, u)) * scale / output_scale(system)[:, None]
    # Rank of the observability matrix; A is normalised so that its powers stay of one size.
    powers = [np.linalg.matrix_power(A / max(abs(A).max(), 1e-300), i) for i in range(system.nx)]
    rows = np.concatenate([H @ power for power in powers])
    if np.linalg.matrix_rank(rows, tol=1e-9 * abs(H).max(initial=0.0)) < system.nx:
        raise ValueError(
            f"{type(system).__name__} linearised at x={np.round(x, 3).tolist()} is not observable, "
            "so its poles cannot be placed; give a gain"
        )
    return A, H, scale


def placed_gains(
    system: System, rate: float, poles: Sequence[complex] | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a gain for each of the `operating_points` at which the poles can be placed.

    With ``poles``, these are the poles of A − LH (Kautsky, Nichols & Van Dooren 1985). Without, all
    poles are placed to the left of −rate (1/s) by the Kalman gain for A + rate·I, which mirrors at
    −rate the poles to the right of it (Anderson & Moore 1971, "Linear Optimal Control", section
    4.1).

    Returns:
        The gains L (num_gains, nx, ny), and the Jacobians A (num_gains, nx, nx) and H (num_gains,
        ny, nx) of the points. Those are of states and outputs divided by their scales, L is not.

    Raises:
        ValueError: in one line, if (A, H) is observable at none of the points, or the number of
            poles is not nx.
    """
    if poles is not None and len(poles) != system.nx:
        raise ValueError(f"poles={tuple(poles)}; {type(system).__name__} has nx={system.nx}")
    t, points = operating_points(system)
    found, failed = [], None
    for x in points:
        try:
            A, H, scale = linearised_scaled(system, t, x)
            scaled = _scaled_gain(A, H, rate, poles)
            found.append((scale[:, None] * scaled / output_scale(system), A, H))
        except np.linalg.LinAlgError as error:  # of the Riccati equation, if the rate is too large
            name = type(system).__name__
            failed = ValueError(f"rate={rate:g}; {name} has no gain with such poles: {error}")
        except ValueError as error:
            failed = error
    if not found:
        raise ValueError(str(failed)) from failed
    L, A, H = (np.stack(arrays) for arrays in zip(*found, strict=True))
    return L, A, H


def _scaled_gain(
    A: np.ndarray, H: np.ndarray, rate: float, poles: Sequence[complex] | None
) -> np.ndarray:
    """Return the gain (nx, ny) that places the poles of A − LH; see `placed_gains`."""
    if poles is not None:
        from scipy.signal import place_poles  # takes long to import

        placed: Any = place_poles(A.T, H.T, poles)
        return placed.gain_matrix.T
    # Riccati equation of the shifted system; the small process noise keeps the gain small.
    from scipy.linalg import solve_continuous_are

    identity = np.eye(len(A))
    noise = (0.1 * rate) ** 2 * identity
    P = solve_continuous_are((A + rate * identity).T, H.T, noise, np.eye(len(H)))
    return P @ H.T


def placed_gain(system: System, rate: float, poles: Sequence[complex] | None = None) -> np.ndarray:
    """Return the gain L (nx, ny) of the `placed_gains` that is best in the worst case: its slowest
    pole over all their linearisations is the fastest.

    Raises:
        ValueError: as `placed_gains` does.
    """
    L, A, H = placed_gains(system, rate, poles)
    scale = vector(system.scale, system.nx, "scale")
    closed = A - (L * output_scale(system) / scale[:, None])[:, None] @ H
    slowest = np.linalg.eigvals(closed).real.max(axis=(1, 2))
    return L[np.argmin(slowest)]


@cached_by_plant
def settling_gain(system: System, rate: float, largest: float = 1.0) -> np.ndarray:
    """Return L (nx, ny) of the default design: one of the `placed_gains` times a factor of at most
    1.

    A gain that is stable at one operating point may amplify errors at others. The candidates are
    the placed gains times 1, 1/2, ..., 1/128, and zero. Each is judged by the error that it leaves
    at the end of a benchmark episode: the worst by the error dynamics linearised along the model's
    trajectories from the `design_states`. The least is taken. What is below exp(−rate·duration), as
    asked, counts as equal; of equals the smallest gain is taken, for it passes the least noise.

    Args:
        system: the model.
        rate: see `placed_gains`.
        largest: largest factor by which the observer multiplies its gain; the candidates are
            judged with it and with 1, and the worse counts.

    Raises:
        ValueError: in one line, if (A, H) is observable at none of the operating points.
    """
    scale = vector(system.scale, system.nx, "scale")
    placed, _, _ = placed_gains(system, rate)
    candidates = np.concatenate([part * placed for part in 0.5 ** np.arange(8)])
    candidates = np.concatenate([candidates, np.zeros((1, system.nx, system.ny))])
    remaining = _remaining_error(system, candidates)
    if largest != 1.0:
        remaining = np.maximum(remaining, _remaining_error(system, largest * candidates))
    asked = np.exp(-rate * system.setups["benchmark"].duration)
    remaining = np.maximum(remaining, asked)
    size = np.linalg.norm(candidates * output_scale(system) / scale[:, None], axis=(1, 2))
    gain = candidates[np.lexsort((size, remaining))[0]]
    gain.flags.writeable = False  # the cache returns the same array again
    return gain


def _remaining_error(system: System, gains: np.ndarray) -> np.ndarray:
    """Return, for each constant gain (num_gains, nx, ny), the largest scaled component of the error
    that is left at the end of a benchmark episode from a unit initial error: the worst over the
    model's trajectories from the `design_states`; infinite if it is not finite."""
    setup, x = system.setups["benchmark"], design_states(system)
    times, nx, ny = setup.times, system.nx, system.ny
    u = np.asarray(system.input(times))[:, None]
    # One row for each gain (slower) and trajectory (faster).
    L = np.repeat(gains, len(x), axis=0)
    flow = np.broadcast_to(np.eye(nx), (len(L), nx, nx))
    weight = np.ones((len(L), ny))
    with np.errstate(all="ignore"):
        for k in range(len(times) - 1):
            x, F = model_step_jacobian(system, times[k], times[k + 1], x, u[k], u[k + 1])
            H = np.asarray(system.h_jacobian(times[k + 1], x, u[k + 1]))
            F, H = (np.tile(each, (len(gains), 1, 1)) for each in (F, H))
            K = injection(L, H, (times[k + 1] - times[k]) * weight)
            flow = F @ flow
            flow = flow - K @ (H @ flow)
        scale = vector(system.scale, nx, "scale")
        left = abs(flow * scale / scale[:, None]).max(axis=(1, 2))
    left = np.where(np.isfinite(left), left, np.inf)
    return left.reshape(len(gains), -1).max(axis=1)


def lmi_gain(system: System, rate: float, grid: int = 5) -> np.ndarray:
    """Return the gain L (nx, ny) with which all errors in the initial set decay at a rate (1/s).

    The linear matrix inequalities are P ⪰ I and He(PA − YH) + 2·rate·P ⪯ 0 with Y = PL, for the
    Jacobians A, H at all states of a grid over the box of the benchmark's initial states
    (`StartLaw.corners`). The error then contracts in the constant metric P (Lohmiller & Slotine
    1998; the polytopic form of Alessandri 2004). They are solved by cvxpy, from the extra ``lmi``.

    Args:
        system: the model.
        rate: decay rate in 1/s.
        grid: grid points per state.

    Raises:
        ValueError: in one line, if the inequalities have no solution.
        ImportError: if cvxpy is not installed.
    """
    try:
        cp: Any = importlib.import_module("cvxpy")
    except ImportError:
        raise ImportError(
            'the LMI needs cvxpy; install it with pip install "pinnobs-gym[lmi]"'
        ) from None
    nx, scale = system.nx, np.asarray(system.scale)
    low, high = system.setups["benchmark"].start(nx).corners
    # Jacobians at the grid points, for scaled states.
    axes = [np.linspace(a, b, grid) for a, b in zip(low, high, strict=True)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, nx)
    now = np.asarray(0.0)
    u = np.asarray(system.input(now))
    A = np.asarray(system.f_jacobian(now, x, u)) * scale / scale[:, None]
    H = np.asarray(system.h_jacobian(now, x, u)) * scale / output_scale(system)[:, None]
    size = max(abs(A).max(), np.finfo(float).tiny)
    _, kept = np.unique(np.round(A / size, 12), axis=0, return_index=True)
    A = A[kept]
    # One inequality per vertex of the polytope; the trace keeps P small.
    P, Y = cp.Variable((nx, nx), symmetric=True), cp.Variable((nx, system.ny))
    constraints: list[Any] = [P >> np.eye(nx)]
    for a, h in zip(A, H[kept], strict=True):
        M = P @ a - Y @ h
        constraints.append(M + M.T + 2 * rate * P << 0)
    problem = cp.Problem(cp.Minimize(cp.trace(P)), constraints)
    with contextlib.suppress(cp.SolverError):
        problem.solve(solver=cp.CLARABEL)
    if problem.status not in ("optimal", "optimal_inaccurate"):
        raise ValueError(
            f"{type(system).__name__} has no constant gain and metric with which errors decay at "
            f"{rate:g}/s at all {len(A)} Jacobians of its initial set: the LMI is {problem.status}"
        )
    return scale[:, None] * np.linalg.solve(P.value, Y.value) / output_scale(system)


def injection(L: np.ndarray, H: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the gain K (batch, nx, ny) of the correction x̂ = x⁻ + K(y − h(t, x⁻, u)).

    It is one linearised step of Euler's implicit method for x̂' = L·(y − h(t, x̂, u)):
    K = L·weight·(I + H·L·weight)⁻¹. Unlike L·weight, it is stable for large gains.

    Args:
        L: continuous-time gain, shape (nx, ny) or (batch, nx, ny), in state units per output unit
            and s.
        H: output Jacobians, shape (batch, ny, nx).
        weight: length of the step in s times any factor of the output, shape (batch, ny); zero for
            a missing output. See `time_since`.
    """
    weighted = L * weight[:, None]
    # The batch is the first axis in memory, so that sums are formed alike in any batch.
    M = np.eye(H.shape[1]) + np.ascontiguousarray(H) @ weighted
    # Rows that have diverged give NaN instead of an error.
    usable = np.isfinite(M).all(axis=(1, 2)) & (np.linalg.det(M) != 0)
    inverse = np.full_like(M, np.nan)
    inverse[usable] = np.linalg.inv(M[usable])
    return weighted @ inverse


def time_since(last: np.ndarray, t: float, missing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the time (s) that has passed since each output's last sample, zero for a missing
    output, and the time of its last sample after this one, (batch, ny) each.

    Args:
        last: times of the last samples, (batch, ny); NaN at the first sample, before which no time
            has passed.
        t: time of this sample in s.
        missing: whether each output is missing, (batch, ny).
    """
    first = np.isnan(last)
    return np.where(missing | first, 0.0, t - last), np.where(missing & ~first, last, t)
