"""Checks that every system must pass."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import is_dataclass
from typing import Any

import numpy as np

from pinnobs_gym.simulation.at_bounds import faults_at_bounds
from pinnobs_gym.simulation.bounds import beyond
from pinnobs_gym.simulation.conformance import (
    Found,
    add_check,
    require,
    require_close,
    require_shape,
    run_all,
)
from pinnobs_gym.simulation.derivatives import central_differences, traced_jacobian
from pinnobs_gym.simulation.initial_set import prior_moments
from pinnobs_gym.simulation.model import described, model_step
from pinnobs_gym.simulation.noise import Noise
from pinnobs_gym.simulation.probe import ModelError, probe
from pinnobs_gym.simulation.residual import nearest
from pinnobs_gym.simulation.runge_kutta import longest_step
from pinnobs_gym.simulation.system import Setup, System, initial_states, vector
from pinnobs_gym.simulation.truth import disturbed_truth, noise_shape, truth

EXACT = 1e-12
"""Largest difference, relative to scale, between two evaluations of the same equations."""
JACOBIAN_TOLERANCE = 1e-6
"""Largest error of a Jacobian, relative to scale; that of central differences is below 1e-9."""
TRUTH_TOLERANCE = 1e-8
"""Largest relative change of a conserved quantity along the truth."""
PERIOD_TOLERANCE = 1e-9
"""Largest difference, relative to their size, of values one period of a state apart."""
STEP_WARNING = 1e-5
"""Largest error of the model over a sample, relative to scale, without a warning. By default steps
have a local error of at most `pinnobs_gym.simulation.runge_kutta.STEP_TOLERANCE`."""

SYSTEM_CHECKS: dict[str, Callable[[type[System]], None]] = {}
"""The checks of a system by name. Each raises `CheckFailed`."""


def check_system(cls: type[System]) -> None:
    """Run all `SYSTEM_CHECKS` on a system.

    Warns:
        UserWarning: if an equation or its Jacobian is not finite at the x̂₀ of a setup, if one is
            not finite within the bounds of states, or too steep at one, if the model takes several
            Runge-Kutta steps per sample, or if it differs from the truth after one.

    Raises:
        CheckFailed: if any check fails; one line per failure with the check's name, what it found
            and what it expected. A class that is incomplete, or of which a function fails, is told
            in one line, without further checks.
    """
    for name in ("attributes", "equations"):  # without these the others fail for the same reason
        SYSTEM_CHECKS[name](cls)
    run_all(SYSTEM_CHECKS, cls)


def _setups(cls: type[System]) -> Iterator[tuple[str, System, Setup]]:
    for name in cls.setups:
        yield (name, *cls.configured(name))


def _points(system: System, *batch: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times (*batch,), states (*batch, nx) near the benchmark's initial states, and inputs
    (*batch, nu) from `_inputs`."""
    count = int(np.prod(batch))
    setup = system.setups["benchmark"]
    rng = np.random.default_rng(1)
    spread = 0.01 * vector(system.scale, system.nx, "scale")
    x = initial_states(system, setup, count) + spread * rng.standard_normal((count, system.nx))
    t = rng.uniform(0, setup.duration, batch)
    t = np.floor(t) if system.discrete else t
    return t, x.reshape(*batch, system.nx), _inputs(system, t)


def _inputs(system: System, t: np.ndarray) -> np.ndarray:
    """Return inputs (..., nu) at times t (...). Inputs that `System.input` leaves at zero may be
    measured ones; they are drawn from 0.1 to 1 instead."""
    u = np.array(system.input(t))
    idle = (u == 0).all(axis=tuple(range(u.ndim - 1)))
    drawn = np.random.default_rng(2).uniform(0.1, 1.0, u.shape)
    return np.where(idle, drawn, u)


def _trajectories(system: System, setup: Setup, x0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the truth (num_samples, batch, nx) and its outputs (num_samples, batch, ny) at no more
    than 200 samples."""
    times = setup.times
    t = times[np.unique(np.linspace(0, len(times) - 1, 200).astype(int))]
    x, u = truth(system, x0, t, setup.truth_step), np.asarray(system.input(t))
    return x, np.asarray(system.h(t[:, None], x, u[:, None]))


def _disturbed(system: System, setup: Setup, noise: Noise, x0: np.ndarray) -> np.ndarray:
    """Return the truth with process noise (num_samples, batch, nx) at the first samples, no more
    than 200 of them."""
    times = setup.times[:200]
    each = noise_shape(system, noise, setup.dt, longest_step(system))
    shape = (len(times) - 1, *each[:2], len(x0), each[2])
    draws = np.random.default_rng(3).standard_normal(shape)
    return disturbed_truth(system, noise, x0, times, draws, setup.truth_step)


@add_check(SYSTEM_CHECKS, "attributes")
def _system_attributes(cls: type[System]) -> None:
    """The class attributes are complete and valid."""
    cls.validate()
    frozen = is_dataclass(cls) and getattr(cls, "__dataclass_params__").frozen  # noqa: B009
    own = "__dataclass_params__" in vars(cls) or not vars(cls).get("__annotations__")
    require(
        frozen and own, f"{cls.__name__} has parameters; expected @dataclass(frozen=True) above it"
    )


@add_check(SYSTEM_CHECKS, "equations")
def _system_equations(cls: type[System]) -> None:
    """All functions can be called on a batch."""
    try:
        probe(cls)
    except ModelError as error:
        raise Found(str(error)) from error


@add_check(SYSTEM_CHECKS, "shapes")
def _system_shapes(cls: type[System]) -> None:
    """All functions act on the last axis and accept any leading axes."""
    system = cls()
    for batch in ((), (1,), (5,), (2, 3)):
        t, x, u = _points(system, *batch)
        t = np.asarray(t)
        require_shape(system.input(t), (*batch, system.nu), f"input(t) at t {batch}")
        _check_equation_shapes(system, t, x, u)
        for name, shape in (("admissible", batch), ("observable", x.shape)):
            marks = np.asarray(getattr(system, name)(x))
            require_shape(marks, shape, f"{name} at x {x.shape}")
            require(marks.dtype == bool, f"{name} returns {marks.dtype}; expected bool")
        invariants = system.invariants(x)
        if invariants is not None:
            require_shape(invariants, (*batch, invariants.shape[-1]), f"invariants at x {x.shape}")
        for other in system.indistinguishable(x):
            require_shape(other, x.shape, f"indistinguishable at x {x.shape}")


def _check_equation_shapes(system: System, t: np.ndarray, x: np.ndarray, u: np.ndarray) -> None:
    """Check the shapes of the equations and their Jacobians with one time per state, one time for
    all states, and one time per leading row; those of the output also with the time as a plain
    number."""
    now, nx = np.asarray(1.0 if system.discrete else 0.1), system.nx
    u_now = _inputs(system, now)
    times = [(t, u), (now, u_now)]
    if t.ndim == 2:
        column = t[:, :1]
        times.append((column, _inputs(system, column)))
    for t, u in times:
        where = f"at t {t.shape}, x {x.shape}, u {u.shape}"
        require_shape(system.f(t, x, u), x.shape, f"f {where}")
        require_shape(system.f_jacobian(t, x, u), (*x.shape, nx), f"f_jacobian {where}")
        _check_output_shapes(system, t, x, u, where)
    _check_output_shapes(system, float(now), x, u_now, f"at t {now}, x {x.shape}, u {u_now.shape}")


def _check_output_shapes(system: System, t: Any, x: np.ndarray, u: np.ndarray, where: str) -> None:
    y = (*x.shape[:-1], system.ny)
    require_shape(system.h(t, x, u), y, f"h {where}")
    require_shape(system.h_jacobian(t, x, u), (*y, system.nx), f"h_jacobian {where}")


@add_check(SYSTEM_CHECKS, "rows_independent")
def _system_rows_independent(cls: type[System]) -> None:
    """A row of a batch gives the same result as that row alone."""
    system = cls()
    t, x, u = _points(system, 4)
    for name, function in _functions(system).items():
        together = np.asarray(function(t, x, u))
        for i in range(len(x)):
            alone = np.asarray(function(t[i : i + 1], x[i : i + 1], u[i : i + 1]))[0]
            size = abs(alone).max(initial=0.0)
            require_close(together[i], alone, EXACT, size, f"{name}: a row of a batch and alone")


def _functions(system: System) -> dict[str, Callable[[Any, Any, Any], Any]]:
    """Return the functions of a system by name, each as a function of (t, x, u)."""
    return {
        "f": system.f,
        "h": system.h,
        "input": lambda t, x, u: system.input(t),
        "f_jacobian": system.f_jacobian,
        "h_jacobian": system.h_jacobian,
    }


@add_check(SYSTEM_CHECKS, "purity")
def _system_purity(cls: type[System]) -> None:
    """The same call gives the same result, and arguments are not modified."""
    system = cls()
    given = _points(system, 4)
    for name, function in _functions(system).items():
        kept = tuple(array.copy() for array in given)
        first = np.array(function(*given))
        for argument, before, after in zip("txu", kept, given, strict=True):
            require(np.array_equal(before, after), f"{name} modifies its argument {argument}")
        again = np.array(function(*given))
        require(np.array_equal(first, again), f"{name} gives another result when called again")


@add_check(SYSTEM_CHECKS, "array_api")
def _system_array_api(cls: type[System]) -> None:
    """f, h and input give the same result in NumPy and in torch, and torch can differentiate
    them."""
    import torch

    system = cls()
    t, x, u = _points(system, 4)
    functions = _functions(system)
    for name in ("f", "h", "input"):
        expected = np.asarray(functions[name](t, x, u))
        advice = f"{name} is written in the array API, xp = array_namespace(x), not with np.*"
        for dtype in (torch.float64, torch.float32):
            tensors = [torch.tensor(a, dtype=dtype, requires_grad=True) for a in (t, x, u)]
            try:
                result = functions[name](*tensors)
            except Exception as error:
                why = f"{type(error).__name__}: {error}"
                raise Found(
                    f"{name} of torch tensors raises {why}; expected that {advice}"
                ) from error
            is_tensor = isinstance(result, torch.Tensor)
            found = f"{dtype} tensors gives {result.dtype if is_tensor else type(result).__name__}"
            require(
                is_tensor and result.dtype == dtype, f"{name} of {found}; expected that {advice}"
            )
            if dtype == torch.float64:
                size = abs(expected).max(initial=0.0)
                values = result.detach().numpy()
                require_close(values, expected, EXACT, size, f"{name} in torch and in NumPy")


@add_check(SYSTEM_CHECKS, "f_jacobian")
def _system_f_jacobian(cls: type[System]) -> None:
    """f_jacobian equals ∂f/∂x, of the traced equations or by central differences."""
    _check_jacobian(cls(), "f")


@add_check(SYSTEM_CHECKS, "h_jacobian")
def _system_h_jacobian(cls: type[System]) -> None:
    """h_jacobian equals ∂h/∂x, of the traced equations or by central differences."""
    _check_jacobian(cls(), "h")


def _check_jacobian(system: System, name: str) -> None:
    """Compare the entries ∂f_i/∂x_j·scale_j of a Jacobian by hand with those of the traced
    equations, and entries of any with central differences, whose error is relative to the size of
    row i."""
    t, x, u = _points(system, 20)
    scale = vector(system.scale, system.nx, "scale")
    function, jacobian = getattr(system, name), getattr(system, f"{name}_jacobian")(t, x, u)
    periods = system.output_period if name == "h" else None
    differences = central_differences(lambda x: function(t, x, u), x, scale, periods=periods)
    require_shape(jacobian, differences.shape, f"{name}_jacobian")
    given, expected = np.asarray(jacobian) * scale, differences * scale
    # Size of a row: its largest entry or the function's value, and at least the largest over the
    # batch.
    size = np.maximum(abs(expected).max(axis=-1), abs(np.asarray(function(t, x, u))))
    size = np.broadcast_to(np.maximum(size, size.max(axis=0))[..., None], given.shape)
    _require_entries(given, expected, size, "central differences", "its row's size")
    by_hand = getattr(type(system), f"{name}_jacobian") is not getattr(System, f"{name}_jacobian")
    if by_hand and (exact := traced_jacobian(system, name, t, x, u)) is not None:
        exact = exact * scale
        size = np.maximum(abs(exact), 1e-3 * size)
        _require_entries(given, exact, size, "the traced equations", "its size")


def _require_entries(
    given: np.ndarray, expected: np.ndarray, size: np.ndarray, peer: str, unit: str
) -> None:
    """Raise `Found`, naming the entry that differs most, unless the matrices (..., m, nx) agree
    within `JACOBIAN_TOLERANCE` of the size."""
    with np.errstate(all="ignore"):
        off = np.where(given == expected, 0.0, abs(given - expected) / size).max(axis=0)
    i, j = np.unravel_index(np.argmax(np.nan_to_num(off, nan=np.inf)), off.shape)
    require(
        off[i, j] <= JACOBIAN_TOLERANCE,
        f"entry [{i}, {j}] differs from {peer} by {off[i, j]:.1e} of {unit}; "
        f"expected at most {JACOBIAN_TOLERANCE:.0e}",
    )


@add_check(SYSTEM_CHECKS, "initial_states")
def _system_initial_states(cls: type[System]) -> None:
    """Every setup has admissible initial states from which the plant stays finite."""
    for name, system, setup in _setups(cls):
        x0 = initial_states(system, setup, 1 if setup.fixed_x0 else 20)
        require(np.isfinite(x0).all(), f"setup {name!r} starts from {x0}; expected finite states")
        x, y = _trajectories(system, setup, x0)
        require_shape(x, (len(x), *x0.shape), f"the truth of setup {name!r}")
        require(np.isfinite(y).all(), f"outputs of setup {name!r} leave the finite ones")


@add_check(SYSTEM_CHECKS, "bounds")
def _system_bounds(cls: type[System]) -> None:
    """The truth of every setup stays within the bounds of the states, also with process noise. A
    warning says where f or h is not finite or nearly infinitely steep at a bound."""
    for name, system, setup in _setups(cls):
        if system.state_box is None:
            continue
        for line in faults_at_bounds(system, setup):
            warnings.warn(f"system {cls.__name__}, setup {name!r}: {line}", stacklevel=2)
        x0 = initial_states(system, setup, 1 if setup.fixed_x0 else 20)
        x, _ = _trajectories(system, setup, x0)
        noise = system.noise(setup.noise_std, setup.process_noise)
        if noise.stochastic:
            x = np.concatenate([x, _disturbed(system, setup, noise, x0)])
        found = beyond(system, x)
        require(
            found is None,
            f"in the truth of setup {name!r}, {found}; expected a plant that stays within its "
            "bounds",
        )


@add_check(SYSTEM_CHECKS, "prior")
def _system_prior(cls: type[System]) -> None:
    """Every setup has a prior. A warning says where an equation is not finite at its mean, as the
    mean of a set need not belong to the set."""
    for name, system, setup in _setups(cls):
        xhat0, _ = prior_moments(system, setup)
        now = np.asarray(0.0)
        at_mean = now, xhat0, _inputs(system, now)
        for what, function in _functions(system).items():
            with np.errstate(all="ignore"):
                value = np.asarray(function(*at_mean))
            if not np.isfinite(value).all():
                warnings.warn(
                    f"system {cls.__name__}, setup {name!r}: {what} is not finite at "
                    f"x̂₀={xhat0.tolist()}; filters that linearise there fail",
                    stacklevel=2,
                )


@add_check(SYSTEM_CHECKS, "model_step")
def _system_model_step(cls: type[System]) -> None:
    """The model's step over a sample agrees with the truth. A warning says where it does not, and
    where a sample takes several Runge-Kutta steps, which take time."""
    for name, system, setup in _setups(cls):
        if system.discrete:  # the model's step and the truth are the same map
            continue
        dt, moves = setup.dt, described(system, setup.dt)
        where = f"system {cls.__name__}, setup {name!r}: a sample of {dt:g} s"
        by_steps = not (system.own_flow or system.stiff)
        step = longest_step(system) if by_steps else dt
        if system.model_step is None and step < dt * (1 - 1e-9):
            found = f"{where} takes Runge-Kutta steps of at most {step:g} s to be precise"
            warnings.warn(f"{found}; set model_step if they are too many", stacklevel=2)
        off = _model_error(system, setup)
        if not off <= STEP_WARNING:
            advice = "set a shorter model_step, or add the times at which f jumps to breakpoints()"
            if system.own_flow:
                advice = "a flow that agrees with f"
            warnings.warn(
                f"{where} by the model ({moves}) is off by {off:.1e} of scale; expected at most "
                f"{STEP_WARNING:.0e}: {advice}",
                stacklevel=2,
            )


def _model_error(system: System, setup: Setup) -> float:
    """Return the largest difference of the model's step over a sample from the truth, relative to
    the larger of state and scale. Samples over a breakpoint do not count."""
    x0 = initial_states(system, setup, 1 if setup.fixed_x0 else 5)
    first = np.unique(np.linspace(0, setup.num_steps - 1, 100).astype(int))
    samples = np.unique([first, first + 1])
    times, path = setup.times[samples], truth(system, x0, setup.times[samples], setup.truth_step)
    off = 0.0
    for k in np.flatnonzero(np.isin(samples, first)):
        t0, t1, end = times[k], times[k + 1], path[k + 1]
        with np.errstate(all="ignore"):
            size = np.maximum(abs(end), vector(system.scale, system.nx, "scale"))
            error = abs(system.state_residual(model_step(system, t0, t1, path[k]), end)) / size
        off = np.maximum(off, error.max())  # NaN stays
    return float(off)


@add_check(SYSTEM_CHECKS, "invariants")
def _system_invariants(cls: type[System]) -> None:
    """The quantities of `System.invariants` are constant along the truth."""
    for name, system, setup in _setups(cls):
        x0 = initial_states(system, setup, 1 if setup.fixed_x0 else 5)
        values = system.invariants(x0)
        if values is not None:
            along: Any = system.invariants(_trajectories(system, setup, x0)[0])
            size = abs(np.asarray(values)).max(axis=0)
            expected = np.broadcast_to(values, np.shape(along))
            what = f"invariants at the start and along the truth of setup {name!r}"
            require_close(along, expected, TRUTH_TOLERANCE, size, what)


@add_check(SYSTEM_CHECKS, "indistinguishable")
def _system_indistinguishable(cls: type[System]) -> None:
    """The states of `System.indistinguishable` give the same outputs at all times."""
    for name, system, setup in _setups(cls):
        x0 = initial_states(system, setup, 1 if setup.fixed_x0 else 5)
        for other in system.indistinguishable(x0):
            _, y = _trajectories(system, setup, x0)
            _, like = _trajectories(system, setup, np.asarray(other))
            what = f"outputs of indistinguishable states of setup {name!r}"
            like = nearest(like, y, system.output_period)
            require_close(like, y, TRUTH_TOLERANCE, abs(y).max(), what)


@add_check(SYSTEM_CHECKS, "periods")
def _system_periods(cls: type[System]) -> None:
    """A state moved by its period has the same rates of change and the same outputs."""
    system = cls()
    t, x, u = _points(system, 4)
    f, y = np.asarray(system.f(t, x, u)), np.asarray(system.h(t, x, u))
    for i, period in enumerate(system.state_period or ()):
        if period is None:
            continue
        other = x + period * np.eye(system.nx)[i]
        name = system.state_names[i]
        for what, found, expected in (
            ("f", system.f(t, other, u), f),
            ("h", nearest(np.asarray(system.h(t, other, u)), y, system.output_period), y),
        ):
            size = np.maximum(abs(expected).max(), 1e-300)
            said = f"{what} at {name} and at {name} + {period:g}, the period of {name},"
            require_close(found, expected, PERIOD_TOLERANCE, size, said)
