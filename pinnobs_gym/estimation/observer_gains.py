"""Design of constant observer gains, and the correction of an observer at a sample."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from pinnobs_gym.simulation.model import model_step, model_step_jacobian
from pinnobs_gym.simulation.system import System, vector

TIME_CONSTANTS = 20.0
"""Duration of a benchmark episode over an observer's time constant, by default."""


def default_rate(system: System) -> float:
    """Return the default decay rate of errors in 1/s, by the same rule for all systems."""
    return TIME_CONSTANTS / system.setups["benchmark"].duration


def operating_point(system: System) -> tuple[float, np.ndarray]:
    """Return the time (s) and state (nx,) of linearisation.

    It is the model's state after a quarter of a benchmark episode that begins at x̂₀.
    """
    setup = system.setups["benchmark"]
    x = vector(setup.xhat0, system.nx, "xhat0")
    times = setup.times[: len(setup.times) // 4 + 1]
    u = np.asarray(system.input(times))
    for k in range(len(times) - 1):
        x = model_step(system, times[k], times[k + 1], x, u[k], u[k + 1])
    return float(times[-1]), x


def linearised_scaled(
    system: System, t: float, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A and H at a state (nx,), both for states divided by their scale, and the scale (nx,).

    Raises:
        ValueError: if (A, H) is not observable.
    """
    now, scale = np.asarray(t), vector(system.scale, system.nx, "scale")
    u = np.asarray(system.input(now))
    A = np.asarray(system.f_jacobian(now, x, u)) * scale / scale[:, None]
    H = np.asarray(system.h_jacobian(now, x, u)) * scale
    # Rank of the observability matrix; A is normalised so that its powers stay of one size.
    powers = [np.linalg.matrix_power(A / max(abs(A).max(), 1e-300), i) for i in range(system.nx)]
    rows = np.concatenate([H @ power for power in powers])
    if np.linalg.matrix_rank(rows, tol=1e-9 * abs(H).max(initial=0.0)) < system.nx:
        raise ValueError(
            f"{type(system).__name__} linearised at x={np.round(x, 3).tolist()} is not observable, "
            "so its poles cannot be placed; give a gain"
        )
    return A, H, scale


def placed_gain(system: System, rate: float, poles: Sequence[complex] | None = None) -> np.ndarray:
    """Return the gain L (nx, ny) that places the poles of A − LH, linearised at `operating_point`.

    With ``poles``, these are placed (Kautsky, Nichols & Van Dooren 1985). Without, all poles are
    placed to the left of −rate (1/s) by the Kalman gain for A + rate·I, which mirrors at −rate the
    poles to the right of it (Anderson & Moore 1971, "Linear Optimal Control", section 4.1).

    Raises:
        ValueError: in one line, if (A, H) is not observable, or the number of poles is not nx.
    """
    A, H, scale = linearised_scaled(system, *operating_point(system))
    if poles is not None:
        if len(poles) != system.nx:
            raise ValueError(f"poles={tuple(poles)}; {type(system).__name__} has nx={system.nx}")
        from scipy.signal import place_poles  # takes long to import

        placed: Any = place_poles(A.T, H.T, poles)
        return scale[:, None] * placed.gain_matrix.T
    # Riccati equation of the shifted system; the small process noise keeps the gain small.
    identity = np.eye(system.nx)
    noise = (0.1 * rate) ** 2 * identity
    from scipy.linalg import solve_continuous_are

    P = solve_continuous_are((A + rate * identity).T, H.T, noise, np.eye(system.ny))
    return scale[:, None] * (P @ H.T)


@lru_cache(maxsize=64)
def settling_gain(system: System, rate: float, largest: float = 1.0) -> np.ndarray:
    """Return L (nx, ny) of the default design: the `placed_gain` times a factor of at most 1.

    A gain that is stable at one operating point may amplify errors at others. Among the factors 1,
    1/2, ..., 1/128 and 0, the one is chosen with the least error at the end of a benchmark episode,
    by the error dynamics linearised along the model's trajectory from x̂₀.

    Args:
        system: the model.
        rate: see `placed_gain`.
        largest: largest factor by which the observer multiplies its gain; the candidates are
            judged with it.

    Raises:
        ValueError: in one line, if (A, H) is not observable.
    """
    L, setup = placed_gain(system, rate), system.setups["benchmark"]
    parts = np.append(0.5 ** np.arange(8), 0.0)
    weight = np.repeat(largest * parts[:, None], system.ny, axis=1)
    scale = vector(system.scale, system.nx, "scale")
    x, flow = vector(setup.xhat0, system.nx, "xhat0")[None], np.eye(system.nx)
    times = setup.times
    u = np.asarray(system.input(times))[:, None]
    with np.errstate(all="ignore"):
        for k in range(len(times) - 1):  # error transition matrix of each candidate gain
            x, F = model_step_jacobian(system, times[k], times[k + 1], x, u[k], u[k + 1])
            H = np.asarray(system.h_jacobian(times[k + 1], x, u[k + 1]))
            K = injection(L, np.repeat(H, len(parts), axis=0), weight, times[k + 1] - times[k])
            flow = (np.eye(system.nx) - K @ H) @ F @ flow
        # Largest scaled component of the error that is left from a unit initial error.
        remaining = abs(flow * scale / scale[:, None]).max(axis=(1, 2))
    gain = parts[np.argmin(np.nan_to_num(remaining, nan=np.inf))] * L
    gain.flags.writeable = False  # the cache returns the same array again
    return gain


def lmi_gain(system: System, rate: float, grid: int = 5) -> np.ndarray:
    """Return the gain L (nx, ny) with which all errors in the initial set decay at a rate (1/s).

    The linear matrix inequalities are P ⪰ I and He(PA − YH) + 2·rate·P ⪯ 0 with Y = PL, for the
    Jacobians A, H at all states of a grid over the benchmark's box of initial states. The error
    then contracts in the constant metric P (Lohmiller & Slotine 1998; the polytopic form of
    Alessandri 2004). They are solved by cvxpy, from the extra ``lmi``.

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
    setup, nx, scale = system.setups["benchmark"], system.nx, np.asarray(system.scale)
    low, high = vector(setup.x0_low, nx, "x0_low"), vector(setup.x0_high, nx, "x0_high")
    # Jacobians at the grid points, for scaled states.
    axes = [np.linspace(a, b, grid) for a, b in zip(low, high, strict=True)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, nx)
    now = np.asarray(0.0)
    u = np.asarray(system.input(now))
    A = np.asarray(system.f_jacobian(now, x, u)) * scale / scale[:, None]
    H = np.asarray(system.h_jacobian(now, x, u)) * scale
    A, kept = np.unique(np.round(A, 12), axis=0, return_index=True)
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
    return scale[:, None] * np.linalg.solve(P.value, Y.value)


def injection(L: np.ndarray, H: np.ndarray, weight: np.ndarray, dt: float) -> np.ndarray:
    """Return the gain K (batch, nx, ny) of the correction x̂ = x⁻ + K(y − h(t, x⁻, u)).

    It is one linearised step of Euler's implicit method for x̂' = L·weight·(y − h(t, x̂, u)):
    K = dt·L·weight·(I + dt·H·L·weight)⁻¹. Unlike dt·L, it is stable for large gains.

    Args:
        L: continuous-time gain, shape (nx, ny), in state units per output unit and s.
        H: output Jacobians, shape (batch, ny, nx).
        weight: factor of each output, shape (batch, ny); zero for a missing output.
        dt: length of the step in s.
    """
    weighted = dt * L * weight[:, None]
    M = np.eye(H.shape[1]) + H @ weighted
    # Rows that have diverged give NaN instead of an error.
    usable = np.isfinite(M).all(axis=(1, 2)) & (np.linalg.det(M) != 0)
    inverse = np.full_like(M, np.nan)
    inverse[usable] = np.linalg.inv(M[usable])
    return weighted @ inverse
