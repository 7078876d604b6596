"""Simulation of an episode's truth by a high-order solver."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from pinnobs_gym.simulation import dop853
from pinnobs_gym.simulation.bounds import absorbed
from pinnobs_gym.simulation.driven import Driven, driven
from pinnobs_gym.simulation.kernels.asked import asked_library
from pinnobs_gym.simulation.maps import Map
from pinnobs_gym.simulation.mesh import NODES, Mesh, mesh_of
from pinnobs_gym.simulation.motion import Interval, check_steps
from pinnobs_gym.simulation.noise import Noise, weighted
from pinnobs_gym.simulation.stiff import Stiff
from pinnobs_gym.simulation.system import System, vector
from pinnobs_gym.simulation.value_shape import of_shape

if TYPE_CHECKING:
    from pinnobs_gym.simulation.kernels.truth_kernel import TruthKernel

TOLERANCE = 3e-11
"""Largest accepted local error of the truth, relative to the larger of a state and its scale."""

_HALVINGS = 7
"""Number of steps tried, each half the one before, before an episode is passed to an adaptive
solver."""
_EVALUATIONS = 40_000
"""Largest number of evaluations of f by the adaptive solver in a `_PART` of an interval."""
_PART = 0.01
"""Part of an interval by which the adaptive solver has to advance with that many."""
_DIVERGED = 1e9
"""Size of a state, relative to its scale, at which it counts as diverged."""


def truth(
    system: System,
    x0: np.ndarray,
    times: np.ndarray,
    max_step: float | None = None,
    out: np.ndarray | None = None,
    inputs: np.ndarray | None = None,
) -> np.ndarray:
    """Return the trajectories x(t) of the plant from given initial states.

    The solver is Dormand and Prince's method of order 8 with a step common to all episodes (Hairer,
    Nørsett & Wanner, "Solving Ordinary Differential Equations I", II.5). Between its nodes the
    state is the Hermite polynomial of degree 11 through the nearest six. The defect x' − f(t, x) of
    that polynomial, midway between nodes, controls the error: episodes whose local error exceeds
    `TOLERANCE` are simulated again with half the step. Episodes that no step satisfies (stiff or
    not smooth) are solved by an adaptive method, LSODA. The result of an episode does not depend on
    the others in its batch. All episodes of a plant with `System.stiff` are solved by LSODA, and a
    map is evaluated.

    Args:
        system: the plant; its parameters may be arrays (batch,), one value per episode.
        x0: initial states, shape (batch, nx), in state units.
        times: sample times in s, ascending, shape (num_samples,); x0 is the state at the first.
        max_step: the initial step in s; a hundredth of the time span if None.
        out: array for the result.
        inputs: inputs at the samples, shape (num_samples, batch, nu), which replace those of
            `System.input`; between samples they are as `System.input_hold` says.

    If the plant's library has been asked for (`pinnobs_gym.simulation.kernels.asked`), steps of
    fixed length are those of compiled code, which agrees with NumPy to rounding.

    Returns:
        States, shape (num_samples, batch, nx).

    Raises:
        ValueError: in one line, if it would take too many steps between two samples.
        FloatingPointError: in one line, if a state is not finite, or the adaptive method cannot go
            on beyond some time.
    """
    times = np.asarray(times, dtype=float)
    x = np.empty((len(times), *x0.shape)) if out is None else out
    x[0] = x0
    if system.discrete:
        with np.errstate(all="ignore"):
            for k in range(len(times) - 1):
                x[k + 1] = Map().step(_between(system, times, inputs, k), x[k])
        _check_finite(system, x0, x)
        return x
    longest = max_step or float(times[-1] - times[0]) / 100
    _check_gaps(system, times, longest)
    if inputs is not None:  # they, or their slopes, jump at each sample
        for k in range(len(times) - 1):
            plant = driven(system, times[k : k + 2], inputs[k : k + 2])
            truth(plant, x[k], times[k : k + 2], longest, x[k : k + 2])
        return x
    # Integrate each interval between breakpoints separately, since f is smooth only within it.
    ends = [b for b in _breakpoints(system) if times[0] < b < times[-1]] + [times[-1]]
    start, state = float(times[0]), np.asarray(x0, dtype=float)
    done = 1
    for end in ends:
        stop = int(np.searchsorted(times, end, side="right"))
        last = _solve_interval(
            system, state, start, float(end), times[done:stop], longest, x[done:stop]
        )
        done, start, state = stop, float(end), last
    _check_finite(system, x0, x)
    return x


def _check_gaps(system: System, times: np.ndarray, longest: float) -> None:
    """Raise ValueError, in one line, if steps of at most ``longest`` (s) are too many between two
    of the samples at these times (num_samples,)."""
    if len(times) > 1 and not (system.discrete or system.stiff):
        k = int(np.argmax(np.diff(times)))
        count = float(times[k + 1] - times[k]) / longest
        check_steps(system, times[k], times[k + 1], count, longest)


def _breakpoints(system: System) -> list[float]:
    """Return the system's breakpoints in s, ascending and each once."""
    return sorted(set(system.breakpoints()))


def noise_shape(system: System, noise: Noise, dt: float, step: float) -> tuple[int, int, int]:
    """Return how many standard normal numbers the process noise of an episode takes in each time
    between samples: the parts of that time, the numbers for each component in a part, and the
    components.

    Args:
        system: the plant.
        noise: its noise.
        dt: time between samples in s.
        step: longest step of the model in s, see
            `pinnobs_gym.simulation.runge_kutta.longest_step`.

    Raises:
        ValueError: in one line, if there would be too many parts.
    """
    if not system.stiff:
        check_steps(system, 0.0, dt, dt / step, step)
    if system.discrete:
        return round(dt), 1, noise.L(0.0).shape[1]
    if system.stiff:
        return 1, 1, system.nx
    return math.ceil(dt / step - 1e-6), 2, noise.L(0.0).shape[1]


def disturbed_truth(
    system: System,
    noise: Noise,
    x0: np.ndarray,
    times: np.ndarray,
    draws: np.ndarray,
    max_step: float | None = None,
    out: np.ndarray | None = None,
    inputs: np.ndarray | None = None,
) -> np.ndarray:
    """Return the trajectories of a plant with process noise, dx = f dt + L dw.

    The law is that of `pinnobs_gym.simulation.model.noisy_model_step`: in each of equal parts of
    the intervals between samples, white noise is replaced by its projection on linear functions of
    time. The solver is that of `truth` with equal steps of at most ``max_step``. Its error is not
    controlled, as it is far below any relevant noise. Maps and stiff plants move as the model does.
    After each part, states that noise moved beyond a bound are at that bound, as in the model's
    ensembles (`pinnobs_gym.simulation.bounds.absorbed`).

    Args:
        system: as in `truth`.
        noise: the noise of the plant.
        x0: initial states, shape (batch, nx), in state units.
        times: sample times in s, ascending, shape (num_samples,).
        draws: standard normal numbers, shape (num_samples - 1, num_parts, num_each, batch, m), see
            `noise_shape`.
        max_step: longest step of the solver in s; a hundredth of the time span if None.
        out: array for the result.
        inputs: as in `truth`.

    Returns:
        States, shape (num_samples, batch, nx).

    Raises:
        ValueError: as `truth`.
        FloatingPointError: if a state is not finite.
    """
    x = np.empty((len(times), *x0.shape)) if out is None else out
    x[0] = x0
    longest = max_step or float(times[-1] - times[0]) / 100
    _check_gaps(system, times, longest)
    stages = np.empty((1 + len(dop853.B), *x0.shape))
    stages[0] = x0
    compiled = None if system.discrete or system.stiff else _compiled(system)
    if compiled is not None and type(noise).L is Noise.L:
        compiled.disturbed(system, noise.L(0.0)[..., 0], times, draws, longest, x, inputs)
        _check_finite(system, x0, x)
        return x
    box = system.state_box
    with np.errstate(all="ignore"):
        for k in range(len(times) - 1):
            if system.discrete or system.stiff:
                x[k + 1] = _moved(_between(system, times, inputs, k), noise, x[k], draws[k])
                continue
            plant = system
            if inputs is not None:
                plant = driven(system, times[k : k + 2], inputs[k : k + 2])
            parts = np.linspace(times[k], times[k + 1], draws.shape[1] + 1)
            for start, end, (even, odd) in zip(parts[:-1], parts[1:], draws[k], strict=True):
                force = _Force(noise, float(start), float(end), even, odd)
                _through_part(plant, float(start), float(end), longest, force, stages)
                stages[0] = absorbed(stages[0], box)
            x[k + 1] = stages[0]
    _check_finite(system, x0, x)
    return x


def _between(system: System, times: np.ndarray, inputs: np.ndarray | None, k: int) -> Interval:
    """Return the interval that follows sample k, with the inputs (num_samples, batch, nu) at the
    samples or, if they are None, those that the system defines."""
    plant = replace(system, measured_input=inputs is not None)
    ends = (None, None) if inputs is None else (inputs[k], inputs[k + 1])
    return Interval(plant, float(times[k]), float(times[k + 1]), *ends)


def _moved(between: Interval, noise: Noise, x: np.ndarray, draws: np.ndarray) -> np.ndarray:
    """Return the states of a map or a stiff plant with process noise at the end of an interval,
    from x (batch, nx) at its start, given numbers (num_parts, 1, batch, m)."""
    motion = Map() if between.system.discrete else Stiff()
    drawn = iter(draws)
    return motion.noisy(between, noise, x[None], lambda size: next(drawn))[0]


@dataclass(frozen=True)
class _Force:
    """White noise projected on linear functions of time between two times in s."""

    noise: Noise
    start: float
    end: float
    even: np.ndarray
    """Standard normal numbers of the constant function, shape (batch, m)."""
    odd: np.ndarray
    """Those of the linear function, shape (batch, m)."""

    def at(self, t: float) -> np.ndarray:
        """Return Lẇ, (batch, nx), at a time."""
        length = self.end - self.start
        s = np.sqrt(3) * (2 * (t - self.start) / length - 1)
        w = (self.even + s * self.odd) / np.sqrt(length)
        return weighted(self.noise.L(t)[..., 0], w)


def _through_part(
    system: System, start: float, end: float, longest: float, force: _Force, stages: np.ndarray
) -> None:
    """Advance the state in ``stages`` from one time to another, in steps no longer than ``longest``
    (s) that begin anew at each breakpoint."""
    ends = [b for b in _breakpoints(system) if start < b < end] + [end]
    for part in ends:
        steps = max(1, int(np.ceil((part - start) / longest - 1e-9)))
        step = round((part - start) / steps, 15)
        last = np.nextafter(part, start)  # f may jump at the end: use its left limit
        for i in range(steps):
            _take_step(system, start + i * step, step, last, stages, force)
        start = part


def _take_step(
    system: System,
    start: float,
    step: float,
    last: float,
    stages: np.ndarray,
    force: _Force | None = None,
) -> None:
    """Take one step of Dormand and Prince's method of order 8, in place.

    f is evaluated no later than at ``last``. ``stages`` (13, batch, nx) holds the state, followed
    by space for the slopes of the stages. The new state replaces the old one; the first slope
    remains that of the old state. A force, if given, is added to f.
    """
    flat = stages.reshape(len(stages), -1)
    t = np.minimum(start + step * dop853.C, last)
    u = system.input(t)
    weights = _tableau(step)
    # Each stage evaluates f at the state plus a combination of the earlier slopes.
    for i, row in enumerate(weights[:-1]):
        stage = _combined(row, flat[: i + 1]).reshape(stages.shape[1:])
        stages[i + 1] = of_shape(system, "f", system.f(t[i], stage, u[i]), stage.shape)
        if force is not None:
            stages[i + 1] += force.at(float(t[i]))
    flat[0] = _combined(weights[-1], flat)[0]


def _compiled(system: System) -> TruthKernel | None:
    """Return the compiled solver of a plant, None unless its library has been asked for."""
    plant = system.plant if isinstance(system, Driven) else system
    made = asked_library(plant, "truth")
    if made is None:
        return None
    from pinnobs_gym.simulation.kernels.truth_kernel import TruthKernel

    return TruthKernel(made)


def _check_finite(system: System, x0: np.ndarray, x: np.ndarray) -> None:
    if not np.isfinite(x.sum()):
        row = int(np.flatnonzero(~np.isfinite(x).all(axis=(0, 2)))[0])
        raise FloatingPointError(
            f"{type(system).__name__} leaves the finite numbers from x0={x0[row].tolist()}"
        )


def _solve_interval(
    system: System,
    x0: np.ndarray,
    start: float,
    end: float,
    times: np.ndarray,
    max_step: float,
    out: np.ndarray,
) -> np.ndarray:
    """Simulate the truth over an interval on which f is smooth, write it to ``out`` and return the
    state at the end."""
    steps = max(NODES, int(np.ceil((end - start) / max_step - 1e-9)))
    last = np.empty_like(x0)
    rows = np.arange(len(x0))
    with np.errstate(all="ignore"):
        # Simulate the remaining episodes; those over the tolerance continue with half the step.
        for _ in range(0 if system.stiff else _HALVINGS):
            plant = rows_of(system, rows)
            everything = len(rows) == len(x0)
            part = out if everything else np.empty((len(times), len(rows), x0.shape[1]))
            last[rows], error = _fixed_step(plant, x0[rows], start, end, steps, times, part)
            if not everything:
                out[:, rows] = part
            rows = rows[~(error <= TOLERANCE)]
            if not len(rows):
                return last
            steps *= 2
        # Adaptive solver for episodes that no fixed step satisfies, one at a time.
        for row in rows:
            plant = rows_of(system, np.array([row]))
            x = _solve_adaptively(plant, x0[row], start, end, np.unique(np.append(times, end)))
            out[:, row], last[row] = x[: len(times)], x[-1]
    return last


def _fixed_step(
    system: System,
    x0: np.ndarray,
    start: float,
    end: float,
    steps: int,
    times: np.ndarray,
    out: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate with a fixed mesh and write the states at the times to ``out`` (num_samples, batch,
    nx). Return the states at the end, and the local error of each episode (batch,)."""
    mesh = mesh_of(start, end, steps, times.tobytes())
    compiled = _compiled(system)
    if compiled is not None:
        return compiled.fixed_step(system, x0, mesh, out)
    last = np.nextafter(end, start)  # f may jump at the end: use its left limit
    batch, nx = x0.shape
    path = np.empty((len(mesh.nodes), 2, batch, nx))  # the states and their slopes at the nodes
    stages = np.empty((1 + len(dop853.B), batch, nx))  # the state, then the slopes of the stages
    stages[0] = x0
    # Integrate, keeping the state and slope at each node.
    for k, step in enumerate(mesh.steps):
        path[k, 0] = stages[0]
        _take_step(system, mesh.nodes[k], step, last, stages)
        path[k, 1] = stages[1]
    path[-1, 0] = stages[0]
    path[-1, 1] = system.f(last, stages[0], system.input(last))
    flat = path.reshape(2 * len(path), -1)
    # Interpolate the states at the samples of each interval.
    for k, (window, weights) in enumerate(mesh.intervals):
        if len(weights):
            inside = slice(mesh.bounds[k], mesh.bounds[k + 1])
            out.reshape(len(times), -1)[inside] = _combined(weights, flat[window])
    return path[-1, 0], _local_error(system, mesh, flat, path[0, 0].shape)


def _local_error(
    system: System, mesh: Mesh, flat: np.ndarray, shape: tuple[int, int]
) -> np.ndarray:
    """Return the largest local error of each episode, (batch,): the defect of the polynomials
    midway between nodes times the step, relative to the larger of state and scale."""
    middle, rate = np.empty((2, len(mesh.checked), *shape))
    # State and slope of the polynomials midway between nodes.
    for i, (window, weights) in enumerate(mesh.checks):
        middle[i], rate[i] = _combined(weights, flat[window]).reshape(2, *shape)
    k = mesh.checked
    t = (mesh.nodes[k] + mesh.steps[k] / 2)[:, None]
    # Defect x' − f(t, x).
    rate -= system.f(t, middle, system.input(t))
    size = np.maximum(abs(middle), vector(system.scale, system.nx, "scale"))
    return (abs(rate) / size * mesh.steps[k, None, None]).max(axis=0).max(axis=-1)


@lru_cache(maxsize=64)
def _tableau(step: float) -> list[np.ndarray]:
    """Return the weights (1, num_values) of (state, slopes of the earlier stages) in each stage,
    followed by those in the next state."""
    rows = [np.append(1.0, step * row[:i])[None] for i, row in enumerate(dop853.A)]
    return [*rows, np.append(1.0, step * dop853.B)[None]]


def _combined(weights: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the sums of values (num_values, n) with each row of weights (num_sums, num_values),
    shape (num_sums, n).

    They are formed in the order of the values for any n, so that the truth of an episode is the
    same to the last bit in any batch. With BLAS it would depend on the shape.
    """
    if values.shape[1] == 1:  # the innermost loop of einsum would be over the values
        return np.add.accumulate(weights * values[:, 0], axis=1)[:, -1:]
    return np.einsum("sk,kn->sn", weights, values)


def _solve_adaptively(
    system: System, x0: np.ndarray, start: float, end: float, times: np.ndarray
) -> np.ndarray:
    """Simulate one episode by LSODA, which handles stiff and non-smooth plants.

    Returns NaN if the state diverges; near a singularity such a method would never finish.

    Raises:
        FloatingPointError: in one line, if it takes more than `_EVALUATIONS` evaluations of f to
            advance by a `_PART` of the interval: no step is short enough where f jumps back and
            forth, as Coulomb friction does at rest.
    """
    from scipy.integrate import solve_ivp  # importing it takes longer than simulating an episode

    last = np.nextafter(end, start)
    scale = vector(system.scale, system.nx, "scale")

    part, count, now, state = start, 0, start, x0

    def stuck(why: str) -> FloatingPointError:
        return FloatingPointError(
            f"{type(system).__name__} from x0={x0.tolist()}: the solver cannot go on beyond "
            f"t={now:.6g} s, x={state.tolist()}, {why}; expected an f that is continuous in x, or "
            f"jumps that the state crosses"
        )

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        nonlocal part, count, now, state
        count, now, state = count + 1, t, x
        if t > part + _PART * (end - start):
            part, count = t, 0
        elif count > _EVALUATIONS:
            raise stuck(f"with {_EVALUATIONS} evaluations of f")
        at = np.asarray(min(t, last))
        return system.f(at, x[None], system.input(at))[0]

    def margin(t: float, x: np.ndarray) -> float:
        return _DIVERGED - float((abs(x) / scale).max())

    margin.terminal = True  # pyright: ignore[reportFunctionMemberAccess]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the reason for which LSODA ends is its status
        try:
            tolerances: dict[str, Any] = {"rtol": 1e-11, "atol": 1e-12 * scale}
            solution = solve_ivp(
                rate, (start, end), x0, "LSODA", times, events=margin, **tolerances
            )
        except ValueError as error:
            if "must have different signs" not in str(error):
                raise
            # The state leaves every bound within a step as short as rounding.
            return np.full((len(times), len(x0)), np.nan)
    diverged = solution.status == 1 or not np.isfinite(state).all()
    if solution.status == -1 and not diverged:
        raise stuck("with any step")
    return np.full((len(times), len(x0)), np.nan) if diverged else solution.y.T


def rows_of(system: System, rows: np.ndarray) -> System:
    """Return the system with its array parameters (batch,) restricted to some rows, and those of a
    plant that is one of its parameters. Arrays of a single entry hold for all rows."""
    values = {f.name: getattr(system, f.name) for f in fields(system)}
    arrays = {name: value for name, value in values.items() if getattr(value, "ndim", 0)}
    changes = {name: value[rows] for name, value in arrays.items() if len(value) > 1}
    for name, value in values.items():
        if isinstance(value, System) and (part := rows_of(value, rows)) is not value:
            changes[name] = part
    return replace(system, **changes) if changes else system
