"""Conformance: named checks that every system and every estimator passes, yours included.

``check_system(VanDerPol)`` and ``check_estimator(MyObserver(system))`` run them all; the tables
`SYSTEM_CHECKS` and `ESTIMATOR_CHECKS` give them by name, for a parametrised test.
"""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from pinnobs_gym.estimator import Estimates, Estimator, State
from pinnobs_gym.record import Prior, Record
from pinnobs_gym.simulate import truth
from pinnobs_gym.system import Setup, System, vector

EXACT = 1e-12
"""Largest difference, over scale, between two ways to evaluate the same equations."""
ROUNDING = 1e-10
"""Largest difference, over scale, between two ways to run the same estimator. Matrix products round
differently in batches of another size, and a filter of ill-conditioned covariances enlarges that:
the EKF of the induction motor to 3e-12."""
JACOBIAN_TOLERANCE = 1e-6
"""Largest error of a Jacobian, over scale; central differences err by less than 1e-9."""
TRUTH_TOLERANCE = 1e-8
"""Largest relative error of what must stay the same along the truth."""
NUM_SAMPLES = 40
"""Length of the records on which estimators are checked."""

SYSTEM_CHECKS: dict[str, Callable[[type[System]], None]] = {}
"""The checks of a system, by name. Each raises `CheckFailed`."""
ESTIMATOR_CHECKS: dict[str, Callable[[Estimator], None]] = {}
"""The checks of an estimator, by name. Each raises `CheckFailed`.

An offline estimator is only held to those that make sense for one: ``immutable``,
``shapes``, ``rows_independent``, ``purity`` and ``save_load``.
"""

T = TypeVar("T")


class CheckFailed(AssertionError):
    """Something does not behave as its interface says; a line per check that found it."""


def check_system(cls: type[System]) -> None:
    """Run all of `SYSTEM_CHECKS` on a system.

    Raises:
        CheckFailed: if any fails, with a line for each: its name, what was found and expected.
    """
    _run_all(SYSTEM_CHECKS, cls)


def check_estimator(estimator: Estimator) -> None:
    """Run all of `ESTIMATOR_CHECKS` on an estimator, on short records of its own system.

    Raises:
        CheckFailed: if any fails, with a line for each: its name, what was found and expected.
    """
    _run_all(ESTIMATOR_CHECKS, estimator)


def _run_all(checks: Mapping[str, Callable[[T], None]], subject: T) -> None:
    failures = []
    for check in checks.values():
        try:
            check(subject)
        except CheckFailed as failure:
            failures.append(str(failure))
    if failures:
        raise CheckFailed("\n".join(failures))


def _into(
    table: dict[str, Callable[[T], None]], name: str
) -> Callable[[Callable[[T], None]], Callable[[T], None]]:
    """Put a check into a table; whatever it raises becomes one line with its name."""

    def register(function: Callable[[T], None]) -> Callable[[T], None]:
        @functools.wraps(function)
        def check(subject: T) -> None:
            try:
                function(subject)
            except Exception as error:
                kind = "" if isinstance(error, _Found) else f"{type(error).__name__}: "
                what = " ".join(str(error).split())
                raise CheckFailed(f"{name}: {kind}{what}") from error

        table[name] = check
        return check

    return register


class _Found(Exception):
    """What a check has found, in one line."""


def _require(condition: object, message: str) -> None:
    if not condition:
        raise _Found(message)


def _require_shape(array: Any, shape: tuple[int, ...], what: str) -> None:
    found = tuple(array.shape)
    _require(found == shape, f"{what} has shape {found}; expected {shape}")


def _require_close(a: Any, b: Any, tolerance: float, size: Any, what: str) -> None:
    """Both must agree, infinities and missing values included, to a tolerance times the size."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    _require_shape(a, b.shape, what)
    with np.errstate(all="ignore"):
        off = abs(a - b) / np.maximum(abs(b), size)
    off = np.where((a == b) | (np.isnan(a) & np.isnan(b)), 0.0, off)
    largest = off.max(initial=0.0)
    _require(
        largest <= tolerance,
        f"{what} differ by {largest:.1e} of scale; expected at most {tolerance:.0e}",
    )


# Systems


def _setups(cls: type[System]) -> Iterator[tuple[str, System, Setup]]:
    for name in cls.setups:
        yield (name, *cls.configured(name))


def _initial_states(system: System, setup: Setup, count: int) -> np.ndarray:
    """Initial states (count, nx) of a setup."""
    low, high = vector(setup.x0_low, system.nx, "x0_low"), vector(setup.x0_high, system.nx, "")
    if setup.fixed_x0:
        return np.repeat(low[None], count, axis=0)
    drawn = np.random.default_rng(0).uniform(low, high, (1000 * count, system.nx))
    x0 = drawn[np.asarray(system.admissible(drawn))][:count]
    _require(len(x0) == count, f"{len(x0)} of {len(drawn)} states of the box are admissible")
    return x0


def _points(system: System, *batch: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (*batch,), states (*batch, nx) about the benchmark's initial ones, and inputs."""
    count = int(np.prod(batch))
    setup = system.setups["benchmark"]
    rng = np.random.default_rng(1)
    spread = 0.01 * vector(system.scale, system.nx, "scale")
    x = _initial_states(system, setup, count) + spread * rng.standard_normal((count, system.nx))
    t = rng.uniform(0, setup.duration, batch)
    return t, x.reshape(*batch, system.nx), np.asarray(system.input(t))


def _trajectories(system: System, setup: Setup, x0: np.ndarray) -> np.ndarray:
    """The truth (num_samples, batch, nx) at no more samples than checks need."""
    times = setup.times
    samples = np.unique(np.linspace(0, len(times) - 1, 200).astype(int))
    return truth(system, x0, times[samples], setup.truth_step)


@_into(SYSTEM_CHECKS, "attributes")
def _system_attributes(cls: type[System]) -> None:
    """The class attributes are complete and make sense."""
    cls.validate()
    frozen = is_dataclass(cls) and getattr(cls, "__dataclass_params__").frozen  # noqa: B009
    own = "__dataclass_params__" in vars(cls) or not vars(cls).get("__annotations__")
    _require(
        frozen and own, f"{cls.__name__} has parameters; expected @dataclass(frozen=True) above it"
    )
    system = cls()
    for kind in ("state_names", "output_names", "input_names"):
        names = getattr(system, kind)
        _require(len(set(names)) == len(names), f"{kind}={names} has a name twice")
    for name in ("scale", "state_bound"):
        values = getattr(system, name)
        if values is not None:
            numbers = vector(values, system.nx, name)
            ok = np.isfinite(numbers).all() and (numbers > 0).all()
            _require(ok, f"{name}={values}; expected positive numbers")
    _require(
        cls.model_step is None or cls.model_step > 0,
        f"model_step={cls.model_step}; expected a positive number of seconds",
    )
    for name, setup in cls.setups.items():
        std = np.asarray(setup.P0_std, dtype=float)
        _require((std > 0).all(), f"P0_std={setup.P0_std} of setup {name!r}; expected positive")


@_into(SYSTEM_CHECKS, "shapes")
def _system_shapes(cls: type[System]) -> None:
    """All functions act on the last axis and take any leading ones."""
    system = cls()
    nx, ny, nu = system.nx, system.ny, system.nu
    for batch in ((), (1,), (5,), (2, 3)):
        t, x, u = _points(system, *batch)
        t = np.asarray(t)
        _require_shape(system.input(t), (*batch, nu), f"input(t) at t {batch}")
        _check_rate_shapes(system, t, x, u)
        _require_shape(system.h(x), (*batch, ny), f"h at x {x.shape}")
        _require_shape(system.h_jacobian(x), (*batch, ny, nx), f"h_jacobian at x {x.shape}")
        for name, shape in (("admissible", batch), ("observable", x.shape)):
            marks = np.asarray(getattr(system, name)(x))
            _require_shape(marks, shape, f"{name} at x {x.shape}")
            _require(marks.dtype == bool, f"{name} returns {marks.dtype}; expected bool")
        invariants = system.invariants(x)
        if invariants is not None:
            _require_shape(invariants, (*batch, invariants.shape[-1]), f"invariants at x {x.shape}")
        for other in system.indistinguishable(x):
            _require_shape(other, x.shape, f"indistinguishable at x {x.shape}")


def _check_rate_shapes(system: System, t: np.ndarray, x: np.ndarray, u: np.ndarray) -> None:
    """F and its Jacobian with a time per state, with one for all, and with one per leading row."""
    now = np.asarray(0.1)
    times = [(t, u), (now, np.asarray(system.input(now)))]
    if t.ndim == 2:
        column = t[:, :1]
        times.append((column, np.asarray(system.input(column))))
    for t, u in times:
        where = f"at t {t.shape}, x {x.shape}, u {u.shape}"
        _require_shape(system.f(t, x, u), x.shape, f"f {where}")
        expected = (*x.shape, system.nx)
        _require_shape(system.f_jacobian(t, x, u), expected, f"f_jacobian {where}")


@_into(SYSTEM_CHECKS, "rows_independent")
def _system_rows_independent(cls: type[System]) -> None:
    """A row of a batch gives the same as that row alone."""
    system = cls()
    t, x, u = _points(system, 4)
    for name, function in _functions(system).items():
        together = np.asarray(function(t, x, u))
        for i in range(len(x)):
            alone = np.asarray(function(t[i : i + 1], x[i : i + 1], u[i : i + 1]))[0]
            size = abs(alone).max(initial=0.0)
            _require_close(together[i], alone, EXACT, size, f"{name}: a row of a batch and alone")


def _functions(system: System) -> dict[str, Callable[[Any, Any, Any], Any]]:
    """What a system computes, as functions of (t, x, u)."""
    return {
        "f": system.f,
        "h": lambda t, x, u: system.h(x),
        "input": lambda t, x, u: system.input(t),
        "f_jacobian": system.f_jacobian,
        "h_jacobian": lambda t, x, u: system.h_jacobian(x),
    }


@_into(SYSTEM_CHECKS, "purity")
def _system_purity(cls: type[System]) -> None:
    """The same call gives the same result, and arguments are not modified."""
    system = cls()
    given = _points(system, 4)
    for name, function in _functions(system).items():
        kept = tuple(array.copy() for array in given)
        first = np.array(function(*given))
        for argument, before, after in zip("txu", kept, given, strict=True):
            _require(np.array_equal(before, after), f"{name} modifies its argument {argument}")
        again = np.array(function(*given))
        _require(np.array_equal(first, again), f"{name} gives another result when called again")


@_into(SYSTEM_CHECKS, "array_api")
def _system_array_api(cls: type[System]) -> None:
    """f, h and input give the same in NumPy and in torch, and torch can differentiate them."""
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
                raise _Found(
                    f"{name} of torch tensors raises {why}; expected that {advice}"
                ) from error
            is_tensor = isinstance(result, torch.Tensor)
            found = f"{dtype} tensors gives {result.dtype if is_tensor else type(result).__name__}"
            _require(
                is_tensor and result.dtype == dtype, f"{name} of {found}; expected that {advice}"
            )
            if dtype == torch.float64:
                size = abs(expected).max(initial=0.0)
                values = result.detach().numpy()
                _require_close(values, expected, EXACT, size, f"{name} in torch and in NumPy")


@_into(SYSTEM_CHECKS, "f_jacobian")
def _system_f_jacobian(cls: type[System]) -> None:
    """f_jacobian is ∂f/∂x, by central differences."""
    system = cls()
    t, x, u = _points(system, 20)
    found = system.f_jacobian(t, x, u)
    _check_jacobian(system, lambda x: system.f(t, x, u), found, x, "f_jacobian")


@_into(SYSTEM_CHECKS, "h_jacobian")
def _system_h_jacobian(cls: type[System]) -> None:
    """h_jacobian is ∂h/∂x, by central differences."""
    system = cls()
    _, x, _ = _points(system, 20)
    _check_jacobian(system, system.h, system.h_jacobian(x), x, "h_jacobian")


def _check_jacobian(
    system: System, function: Callable[[Any], Any], found: Any, x: np.ndarray, name: str
) -> None:
    """Compare ∂f_i/∂x_j·scale_j, over the largest such number of row i."""
    scale = vector(system.scale, system.nx, "scale")
    step = 6e-6 * scale  # the cube root of the rounding error, where central differences are best
    columns = []
    for j in range(system.nx):
        shift = np.zeros(system.nx)
        shift[j] = step[j]
        ahead, behind = np.asarray(function(x + shift)), np.asarray(function(x - shift))
        columns.append((ahead - behind) / (2 * step[j]) * scale[j])
    expected = np.stack(columns, axis=-1)
    given = np.asarray(found) * scale
    _require_shape(given, expected.shape, name)
    size = np.maximum(abs(expected).max(axis=-1), abs(np.asarray(function(x))))
    size = np.maximum(size, size.max(axis=0))[..., None]
    with np.errstate(all="ignore"):
        off = np.where(given == expected, 0.0, abs(given - expected) / size).max(axis=0)
    i, j = np.unravel_index(np.argmax(np.nan_to_num(off, nan=np.inf)), off.shape)
    _require(
        off[i, j] <= JACOBIAN_TOLERANCE,
        f"entry [{i}, {j}] differs from central differences by {off[i, j]:.1e} of its row's size; "
        f"expected at most {JACOBIAN_TOLERANCE:.0e}",
    )


@_into(SYSTEM_CHECKS, "initial_states")
def _system_initial_states(cls: type[System]) -> None:
    """Every setup has admissible initial states, from which the plant stays finite."""
    for name, system, setup in _setups(cls):
        x0 = _initial_states(system, setup, 1 if setup.fixed_x0 else 20)
        _require(np.isfinite(x0).all(), f"setup {name!r} starts from {x0}; expected finite states")
        x = _trajectories(system, setup, x0)
        _require_shape(x, (len(x), *x0.shape), f"the truth of setup {name!r}")
        _require(np.isfinite(system.h(x)).all(), f"outputs of setup {name!r} leave the finite ones")


@_into(SYSTEM_CHECKS, "invariants")
def _system_invariants(cls: type[System]) -> None:
    """What `System.invariants` names stays the same along the truth."""
    for name, system, setup in _setups(cls):
        x0 = _initial_states(system, setup, 1 if setup.fixed_x0 else 5)
        values = system.invariants(x0)
        if values is not None:
            along: Any = system.invariants(_trajectories(system, setup, x0))
            size = abs(np.asarray(values)).max(axis=0)
            expected = np.broadcast_to(values, np.shape(along))
            what = f"invariants at the start and along the truth of setup {name!r}"
            _require_close(along, expected, TRUTH_TOLERANCE, size, what)


@_into(SYSTEM_CHECKS, "indistinguishable")
def _system_indistinguishable(cls: type[System]) -> None:
    """What `System.indistinguishable` names gives the same output for ever."""
    for name, system, setup in _setups(cls):
        x0 = _initial_states(system, setup, 1 if setup.fixed_x0 else 5)
        for other in system.indistinguishable(x0):
            y = np.asarray(system.h(_trajectories(system, setup, x0)))
            like = system.h(_trajectories(system, setup, np.asarray(other)))
            what = f"outputs of indistinguishable states of setup {name!r}"
            _require_close(like, y, TRUTH_TOLERANCE, abs(y).max(), what)


# Estimators


def _record(estimator: Estimator, batch: int = 3, *, irregular: bool = False) -> Record:
    """A short record of the estimator's own system, with the benchmark's initial states and noise.

    It is simulated here, and not taken from an env, which would register a system that is only
    being checked.
    """
    system = estimator.system
    setup = system.setups["benchmark"]
    rng = np.random.default_rng(2)
    steps = np.full(NUM_SAMPLES - 1, setup.dt)
    if irregular:
        steps *= rng.uniform(0.3, 2.0, len(steps))
    t = np.append(0.0, np.cumsum(steps))
    x = truth(system, _initial_states(system, setup, batch), t).swapaxes(0, 1)
    std = vector(setup.noise_std, system.ny, "noise_std")
    y = system.h(x) + std * rng.standard_normal((batch, len(t), system.ny))
    u = np.broadcast_to(system.input(t), (batch, len(t), system.nu)).copy()
    return Record(t, y, u, Prior.of(system, setup, batch))


def _updates(estimator: Estimator, record: Record) -> Iterator[State]:
    """The states after reset and after each sample."""
    state = estimator.reset(record.prior)
    yield state
    for k, t in enumerate(record.t):
        with np.errstate(all="ignore"):  # as `Estimator.run` does
            state = estimator.update(state, float(t), record.y[:, k].copy(), record.u[:, k].copy())
        yield state


def _require_same(
    estimator: Estimator, a: Estimates, b: Estimates, tolerance: float, what: str
) -> None:
    """All that two runs return must agree."""
    for field in fields(Estimates):
        left, right = getattr(a, field.name), getattr(b, field.name)
        both = (left is None) == (right is None)
        _require(both, f"{field.name} of {what}: one has it and one does not; expected the same")
        if left is not None:
            size = 0.0
            if field.name == "xhat":
                size = vector(estimator.system.scale, estimator.system.nx, "scale")
            elif tolerance and np.isfinite(right).any():  # small entries beside large ones round
                size = abs(right[np.isfinite(right)]).max()
            _require_close(left, right, tolerance, size, f"{field.name} of {what}")


def _online(estimator: Estimator) -> bool:
    return estimator.track == "online"


@_into(ESTIMATOR_CHECKS, "immutable")
def _estimator_immutable(estimator: Estimator) -> None:
    """The estimator is immutable."""
    cls = type(estimator)
    params = vars(cls).get("__dataclass_params__")
    _require(
        params is not None and params.frozen,
        f"{cls.__name__} is not decorated; expected @dataclass(frozen=True)",
    )
    _require(estimator.track in ("online", "offline"), f"track={estimator.track!r} is unknown")


@_into(ESTIMATOR_CHECKS, "shapes")
def _estimator_shapes(estimator: Estimator) -> None:
    """Estimates, covariances and innovations have their shapes and are finite."""
    record = _record(estimator)
    batch, n, nx, ny = record.batch, record.num_samples, estimator.system.nx, estimator.system.ny
    expected = {"xhat": (nx,), "P": (nx, nx), "innovation": (ny,), "S": (ny, ny)}
    for k, state in enumerate(_updates(estimator, record) if _online(estimator) else ()):
        when = "after reset" if k == 0 else f"after sample {k - 1}"
        _check_values(state, (batch,), expected, when)
        t = None if k == 0 else record.t[k - 1]
        _require(state.t == t, f"t={state.t} {when}; expected {t}")
    _check_values(estimator.run(record), (batch, n), expected, "from run")


def _check_values(
    holder: State | Estimates,
    leading: tuple[int, ...],
    expected: Mapping[str, tuple[int, ...]],
    when: str,
) -> None:
    for name, shape in expected.items():
        array = getattr(holder, name)
        if array is not None:
            _require_shape(array, (*leading, *shape), f"{name} {when}")
            _require(np.isfinite(array).all(), f"{name} {when} is not finite on a benign record")
    P = holder.P
    if P is not None:
        size = abs(P).max(axis=(-2, -1), keepdims=True)
        off = (abs(P - np.swapaxes(P, -2, -1)) / size).max()
        _require(off < 1e-9, f"P {when} is asymmetric by {off:.1e}; expected a covariance")
        least = (np.linalg.eigvalsh(P) / size[..., 0]).min()
        _require(least > -1e-9, f"P {when} has eigenvalue {least:.1e}; expected none below zero")


@_into(ESTIMATOR_CHECKS, "rows_independent")
def _estimator_rows_independent(estimator: Estimator) -> None:
    """A row of a batch gives the same as that row alone."""
    record = _record(estimator)
    together = estimator.run(record)
    for i in range(record.batch):
        row = slice(i, i + 1)
        part = _rows(together, row)
        alone = estimator.run(record.rows(row))
        _require_same(estimator, part, alone, ROUNDING, f"row {i} in a batch and alone")


def _rows(estimates: Estimates, rows: slice) -> Estimates:
    """Those of some of the episodes only."""
    given = {f.name: getattr(estimates, f.name) for f in fields(Estimates)}
    taken: dict[str, Any] = {name: a if a is None else a[rows] for name, a in given.items()}
    return Estimates(**taken)


@_into(ESTIMATOR_CHECKS, "purity")
def _estimator_purity(estimator: Estimator) -> None:
    """The same record gives the same estimates, and neither it nor earlier states are modified."""
    record = _record(estimator)
    before = _copy(record)
    first = estimator.run(record)
    given = {"t": record.t, "y": record.y, "u": record.u, **vars(record.prior)}
    kept = {"t": before.t, "y": before.y, "u": before.u, **vars(before.prior)}
    for name, array in given.items():
        _require(np.array_equal(array, kept[name]), f"run modifies {name} of the record")
    again = estimator.run(record)
    _require_same(estimator, again, first, 0.0, "a second run and the first")
    if _online(estimator):
        states = [(state, state.xhat.copy()) for state in _updates(estimator, _copy(record))]
        for k, (state, xhat) in enumerate(states):
            same = np.array_equal(state.xhat, xhat, equal_nan=True)
            _require(same, f"xhat of state {k} is modified by a later update; expected a new array")
        _check_arguments(estimator, record)


def _check_arguments(estimator: Estimator, record: Record) -> None:
    """`update` must leave y and u as they are."""
    state = estimator.reset(record.prior)
    for k in range(3):
        y, u = record.y[:, k].copy(), record.u[:, k].copy()
        y[0] = np.nan
        kept = y.copy(), u.copy()
        state = estimator.update(state, float(record.t[k]), y, u)
        for name, now, before in (("y", y, kept[0]), ("u", u, kept[1])):
            same = np.array_equal(now, before, equal_nan=True)
            _require(same, f"update modifies its argument {name}")


def _copy(record: Record) -> Record:
    prior = Prior(record.prior.mean.copy(), record.prior.cov.copy())
    return Record(record.t.copy(), record.y.copy(), record.u.copy(), prior)


@_into(ESTIMATOR_CHECKS, "causality")
def _estimator_causality(estimator: Estimator) -> None:
    """Changing later outputs changes no earlier estimate."""
    if not _online(estimator):
        return
    record = _record(estimator)
    xhat = estimator.run(record).xhat
    for k in (1, record.num_samples // 2, record.num_samples - 1):
        changed = _copy(record)
        changed.y[:, k:] += 3 * abs(changed.y).max()
        same = estimator.run(changed).xhat[:, :k] == xhat[:, :k]
        if not same.all():
            first = int(np.argwhere(~same.all(axis=(0, 2)))[0, 0])
            raise _Found(f"the estimate at sample {first} changes with outputs from sample {k} on")


@_into(ESTIMATOR_CHECKS, "missing_samples")
def _estimator_missing_samples(estimator: Estimator) -> None:
    """A NaN in y is a missing sample, and none sticks; all may be missing."""
    if not _online(estimator):
        return
    record = _record(estimator)
    rng = np.random.default_rng(3)
    ny = estimator.system.ny
    cases = {
        "at random": rng.random(record.y.shape) < 0.3,
        "at first": np.zeros(record.y.shape, dtype=bool),
        "in a gap": np.zeros(record.y.shape, dtype=bool),
        "in one output": np.zeros(record.y.shape, dtype=bool),
        "altogether": np.ones(record.y.shape, dtype=bool),
    }
    cases["at first"][:, 0] = True
    cases["in a gap"][0, 10:20] = True
    cases["in one output"][:, 5:, ny - 1] = True
    for where, missing in cases.items():
        run = estimator.run(replace(record, y=np.where(missing, np.nan, record.y)))
        bad = ~np.isfinite(run.xhat).all(axis=-1)
        if bad.any():
            row, k = np.argwhere(bad)[0]
            raise _Found(
                f"samples missing {where} make the estimate at sample {k} of row {row} not finite; "
                "expected a missing sample to be left out"
            )


@_into(ESTIMATOR_CHECKS, "irregular_times")
def _estimator_irregular_times(estimator: Estimator) -> None:
    """Samples may come at irregular times."""
    if not _online(estimator):
        return
    record = _record(estimator, irregular=True)
    xhat = estimator.run(record).xhat
    _require_shape(xhat, (record.batch, record.num_samples, estimator.system.nx), "xhat")
    _require(np.isfinite(xhat).all(), "xhat is not finite on a record of irregular times")


@_into(ESTIMATOR_CHECKS, "run_equals_updates")
def _estimator_run_equals_updates(estimator: Estimator) -> None:
    """`run` gives what looping `update` does."""
    if not _online(estimator):
        return
    for irregular in (False, True):
        record = _record(estimator, irregular=irregular)
        states = list(_updates(estimator, record))[1:]
        columns = {
            f.name: np.stack([getattr(state, f.name) for state in states], axis=1)
            for f in fields(Estimates)
            if getattr(states[0], f.name) is not None
        }
        looped = Estimates(**columns)
        _require_same(
            estimator, estimator.run(record), looped, ROUNDING, "run and of looped updates"
        )


@_into(ESTIMATOR_CHECKS, "diverging_row")
def _estimator_diverging_row(estimator: Estimator) -> None:
    """A row that diverges is marked by what it holds; it neither raises nor touches the others."""
    if not _online(estimator):
        return
    record = _record(estimator)
    others = np.array([0, 2])
    benign = estimator.run(record)
    for value in (1e300, -1e300, np.inf):
        wild = _copy(record)
        wild.y[1, 5:] = value
        found = estimator.run(wild)
        for name in ("xhat", "P"):
            if getattr(benign, name) is not None:
                a, b = getattr(found, name)[others], getattr(benign, name)[others]
                what = f"{name} of other rows with and without outputs of {value:g} in one row"
                _require_close(a, b, ROUNDING, abs(b).max(axis=(0, 1)), what)


@_into(ESTIMATOR_CHECKS, "save_load")
def _estimator_save_load(estimator: Estimator) -> None:
    """What can be saved is the same when loaded."""
    cls: Any = type(estimator)
    if not (hasattr(cls, "save") and hasattr(cls, "load")):
        return
    record = _record(estimator)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "saved"
        cls.save(estimator, path)
        loaded = cls.load(path, estimator.system)
    found, expected = loaded.run(record), estimator.run(record)
    _require_same(estimator, found, expected, ROUNDING, "a loaded estimator and the one saved")
