"""Conformance checks that every estimator has to pass, user-defined ones included.

``check_estimator(MyObserver(system))`` runs all of them; `ESTIMATOR_CHECKS` lists them by name, for
a parametrised test.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np

from pinnobs_gym.estimation.check_records import copied, short_record, tolerated
from pinnobs_gym.estimation.estimator import BaseEstimator, Estimates, Estimator, State
from pinnobs_gym.estimation.plant_checks import PLANT_CHECKS
from pinnobs_gym.estimation.takes import EVERYTHING, FEATURES
from pinnobs_gym.simulation.conformance import (
    Found,
    add_check,
    require,
    require_close,
    require_shape,
    run_all,
)
from pinnobs_gym.simulation.model import model_step
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import System, initial_states, output_scale, vector

ROUNDING = 1e-10
"""Largest difference, over scale, between two runs of the same estimator. Matrix products round
differently in batches of different sizes, and ill-conditioned covariances amplify the difference:
to 3e-12 for the EKF of the induction motor."""
MODEL_STEP = 1e-6
"""Largest difference, over scale, between an estimator's own integration of the model and ours."""
PERIODS = 1e-9
"""Largest difference, over scale, between estimates from outputs that differ by whole periods."""

ESTIMATOR_CHECKS: dict[str, Callable[[BaseEstimator], None]] = {}
"""The checks of an estimator, by name. Each raises `CheckFailed`, also for an estimator that is
exempt from it."""


@runtime_checkable
class Saved(Protocol):
    """An estimator that can be saved, a learned one or a plug-in."""

    def save(self, path: Path) -> None:
        """Write the estimator to a file."""

    @classmethod
    def load(cls, path: Path, system: System) -> Self:
        """The estimator in a file, on a system."""
        ...


def check_estimator(estimator: BaseEstimator) -> None:
    """Run `ESTIMATOR_CHECKS` on an estimator, on short records of its own system: all but those
    that it is exempt from.

    Its class declares them: `BaseEstimator.exempt_from` gives the name of each check and, in a
    line, why it does not hold. `OfflineEstimator` declares those of estimators that see the whole
    record first. If it names an unknown check, the check ``exemptions`` fails; no estimator can be
    exempt from that one.

    Raises:
        CheckFailed: if any check fails, with a line for each: its name, the finding and the
            expectation.
        TypeError: in one line, if the argument is not an instance of an Estimator.
    """
    if not isinstance(estimator, BaseEstimator):
        raise TypeError(f"{estimator!r} is not an instance of an Estimator; expected one")
    declared: Any = estimator.exempt_from
    left_out = declared if isinstance(declared, Mapping) else {}  # else `exemptions` fails
    held_to = {
        name: check
        for name, check in ESTIMATOR_CHECKS.items()
        if name not in left_out or name == "exemptions"
    }
    run_all(held_to, estimator)


def _updates(estimator: Estimator, record: Record) -> Iterator[State]:
    """Yield the states after reset and after each sample."""
    state = estimator.reset(record.prior)
    yield state
    for k, t in enumerate(record.t):
        with np.errstate(all="ignore"):  # as `Estimator.run` does
            state = estimator.update(state, float(t), record.y[:, k].copy(), record.u[:, k].copy())
        yield state


def _require_same(
    estimator: BaseEstimator, a: Estimates, b: Estimates, tolerance: float, what: str
) -> None:
    """Require that two runs return the same estimates."""
    for field in fields(Estimates):
        left, right = getattr(a, field.name), getattr(b, field.name)
        both = (left is None) == (right is None)
        require(both, f"{field.name} of {what}: one has it and one does not; expected the same")
        if left is not None:
            size = 0.0
            if field.name == "xhat":
                size = vector(estimator.system.scale, estimator.system.nx, "scale")
            elif tolerance and np.isfinite(right).any():  # small entries beside large ones round
                size = abs(right[np.isfinite(right)]).max()
            require_close(left, right, tolerance, size, f"{field.name} of {what}")


@add_check(ESTIMATOR_CHECKS, "immutable")
def _estimator_immutable(estimator: BaseEstimator) -> None:
    """The estimator is immutable."""
    cls = type(estimator)
    params = vars(cls).get("__dataclass_params__")
    require(
        params is not None and params.frozen,
        f"{cls.__name__} is not decorated; expected @dataclass(frozen=True)",
    )
    require(estimator.track in ("online", "offline"), f"track={estimator.track!r} is unknown")


@add_check(ESTIMATOR_CHECKS, "exemptions")
def _estimator_exemptions(estimator: BaseEstimator) -> None:
    """Every name in `exempt_from` is that of a check, and its reason is one line."""
    declared: Any = estimator.exempt_from
    require(
        isinstance(declared, Mapping),
        f"exempt_from={declared!r}; expected a mapping from names of checks to reasons",
    )
    for name, reason in declared.items():
        known = ", ".join(check for check in ESTIMATOR_CHECKS if check != "exemptions")
        require(name in known.split(", "), f"exempt_from names {name!r}; known are {known}")
        one_line = isinstance(reason, str) and reason.strip() and "\n" not in reason
        require(one_line, f"exempt_from[{name!r}]={reason!r}; expected a reason in one line")


@add_check(ESTIMATOR_CHECKS, "shapes")
def _estimator_shapes(estimator: BaseEstimator) -> None:
    """Estimates, covariances and innovations have their shapes and are finite."""
    record = short_record(estimator)
    batch, n, nx, ny = record.batch, record.num_samples, estimator.system.nx, estimator.system.ny
    expected = {"xhat": (nx,), "P": (nx, nx), "innovation": (ny,), "S": (ny, ny)}
    for k, state in enumerate(
        _updates(estimator, record) if isinstance(estimator, Estimator) else ()
    ):
        when = "after reset" if k == 0 else f"after sample {k - 1}"
        _check_values(state, (batch,), expected, when)
        t = None if k == 0 else record.t[k - 1]
        require(state.t == t, f"t={state.t} {when}; expected {t}")
    _check_values(estimator.run(record), (batch, n), expected, "from run")


def _check_values(
    holder: State | Estimates,
    leading: tuple[int, ...],
    expected: Mapping[str, tuple[int, ...]],
    when: str,
) -> None:
    """Require the shapes, finite values, and symmetric positive semidefinite covariances."""
    for name, shape in expected.items():
        array = getattr(holder, name)
        if array is not None:
            require_shape(array, (*leading, *shape), f"{name} {when}")
            require(np.isfinite(array).all(), f"{name} {when} is not finite on a benign record")
    P = holder.P
    if P is not None:
        size = abs(P).max(axis=(-2, -1), keepdims=True)
        off = (abs(P - np.swapaxes(P, -2, -1)) / size).max()
        require(off < 1e-9, f"P {when} is asymmetric by {off:.1e}; expected a covariance")
        least = (np.linalg.eigvalsh(P) / size[..., 0]).min()
        require(least > -1e-9, f"P {when} has eigenvalue {least:.1e}; expected none below zero")


@add_check(ESTIMATOR_CHECKS, "rows_independent")
def _estimator_rows_independent(estimator: BaseEstimator) -> None:
    """A row of a batch gives the same estimates as that row alone."""
    record = short_record(estimator)
    together = estimator.run(record)
    for i in range(record.batch):
        row = slice(i, i + 1)
        part = _rows(together, row)
        alone = estimator.run(record.rows(row))
        _require_same(estimator, part, alone, ROUNDING, f"row {i} in a batch and alone")


def _rows(estimates: Estimates, rows: slice) -> Estimates:
    """Return the estimates of some of the rows."""
    arrays = {f.name: getattr(estimates, f.name) for f in fields(Estimates)}
    taken: dict[str, Any] = {name: a if a is None else a[rows] for name, a in arrays.items()}
    return Estimates(**taken)


@add_check(ESTIMATOR_CHECKS, "purity")
def _estimator_purity(estimator: BaseEstimator) -> None:
    """The same record gives the same estimates, and neither it nor earlier states are modified."""
    record = short_record(estimator)
    before = copied(record)
    first = estimator.run(record)
    given = {"t": record.t, "y": record.y, "u": record.u, **vars(record.prior)}
    kept = {"t": before.t, "y": before.y, "u": before.u, **vars(before.prior)}
    for name, array in given.items():
        require(np.array_equal(array, kept[name]), f"run modifies {name} of the record")
    again = estimator.run(record)
    _require_same(estimator, again, first, 0.0, "a second run and the first")
    if isinstance(estimator, Estimator):
        states = [(state, state.xhat.copy()) for state in _updates(estimator, copied(record))]
        for k, (state, xhat) in enumerate(states):
            same = np.array_equal(state.xhat, xhat, equal_nan=True)
            require(same, f"xhat of state {k} is modified by a later update; expected a new array")
        _check_arguments(estimator, record)


def _check_arguments(estimator: Estimator, record: Record) -> None:
    """Require that `update` does not modify y and u."""
    state = estimator.reset(record.prior)
    for k in range(3):
        y, u = record.y[:, k].copy(), record.u[:, k].copy()
        y[0] = np.nan
        kept = y.copy(), u.copy()
        state = estimator.update(state, float(record.t[k]), y, u)
        for name, now, before in (("y", y, kept[0]), ("u", u, kept[1])):
            same = np.array_equal(now, before, equal_nan=True)
            require(same, f"update modifies its argument {name}")


@add_check(ESTIMATOR_CHECKS, "causality")
def _estimator_causality(estimator: BaseEstimator) -> None:
    """A change of later outputs changes no earlier estimate."""
    record = short_record(estimator)
    xhat = estimator.run(record).xhat
    for k in (1, record.num_samples // 2, record.num_samples - 1):
        changed = copied(record)
        changed.y[:, k:] += 3 * abs(changed.y).max()
        same = estimator.run(changed).xhat[:, :k] == xhat[:, :k]
        if not same.all():
            first = int(np.argwhere(~same.all(axis=(0, 2)))[0, 0])
            raise Found(f"the estimate at sample {first} changes with outputs from sample {k} on")


@add_check(ESTIMATOR_CHECKS, "missing_samples")
def _estimator_missing_samples(estimator: BaseEstimator) -> None:
    """A NaN in y is a missing output and makes no estimate NaN, even if all outputs are missing."""
    record = short_record(estimator)
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
        for what, found in (("estimate", run.xhat), ("covariance", run.P)):
            if found is not None and not np.isfinite(found).all():
                row, k = np.argwhere(~np.isfinite(found))[0, :2]
                raise Found(
                    f"samples missing {where} make the {what} at sample {k} of row {row} not "
                    "finite; expected a missing sample to be left out"
                )


@add_check(ESTIMATOR_CHECKS, "model_alone")
def _estimator_model_alone(estimator: BaseEstimator) -> None:
    """Where all outputs are missing, the estimates are the model's from the prior's mean."""
    system, record = estimator.system, short_record(estimator)
    # A benchmark's mean may be an equilibrium, at which every estimate stays.
    x = initial_states(system, system.setups["benchmark"], record.batch)
    prior = Prior(x, record.prior.cov)
    found = estimator.run(replace(record, y=np.full_like(record.y, np.nan), prior=prior)).xhat
    for k, t in enumerate(record.t):
        if k:
            x = model_step(system, record.t[k - 1], t, x, record.u[:, k - 1], record.u[:, k])
        what = (
            f"without any output (exempt_from it if it has no prior), the estimate at sample {k} "
            f"and the model's state from x̂₀"
        )
        require_close(found[:, k], x, MODEL_STEP, vector(system.scale, system.nx, "scale"), what)


@add_check(ESTIMATOR_CHECKS, "bounds")
def _estimator_bounds(estimator: BaseEstimator) -> None:
    """Estimates are within the bounds of the states, whatever the outputs. A system without bounds
    has none to leave."""
    box = estimator.system.state_box
    if box is None:
        return
    record, size = short_record(estimator), 10 * output_scale(estimator.system)
    for change in (0.0, size, -size):
        found = estimator.run(replace(record, y=record.y + change)).xhat
        outside = box.outside(found)
        if outside.any():
            row, k = np.argwhere(outside)[0]
            raise Found(
                f"the estimate {found[row, k].tolist()} at sample {k} of row {row} is outside of "
                f"the bounds {box.low.tolist()} to {box.high.tolist()}; expected one within"
            )


@add_check(ESTIMATOR_CHECKS, "irregular_times")
def _estimator_irregular_times(estimator: BaseEstimator) -> None:
    """Estimates are finite for samples at irregular times."""
    record = short_record(estimator, irregular=True)
    xhat = estimator.run(record).xhat
    require_shape(xhat, (record.batch, record.num_samples, estimator.system.nx), "xhat")
    require(np.isfinite(xhat).all(), "xhat is not finite on a record of irregular times")


@add_check(ESTIMATOR_CHECKS, "run_equals_updates")
def _estimator_run_equals_updates(estimator: BaseEstimator) -> None:
    """`run` gives the same estimates as a loop of `update`."""
    if not isinstance(estimator, Estimator):
        raise Found(f"{type(estimator).__name__} has no update")
    for irregular in (False, True):
        record = short_record(estimator, irregular=irregular)
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


@add_check(ESTIMATOR_CHECKS, "periods")
def _estimator_periods(estimator: BaseEstimator) -> None:
    """An output moved by whole periods changes no estimate, for a system that declares periods."""
    system = estimator.system
    if system.output_period is None:
        return
    record, rng = short_record(estimator), np.random.default_rng(4)
    run, scale = estimator.run(record), vector(system.scale, system.nx, "scale")
    for i, period in enumerate(system.output_period):
        if period is None:
            continue
        moved = copied(record)
        moved.y[..., i] += period * rng.integers(-2, 3, moved.y.shape[:2])
        found = estimator.run(moved)
        what = f"with {system.output_names[i]} moved by whole periods and without"
        off = system.state_residual(found.xhat, run.xhat)
        most = PERIODS
        if not abs(off / scale).max() <= most:
            most = tolerated(estimator.run, system, record, most)
        require_close(off, np.zeros_like(off), most, scale, f"xhat {what}")
        if run.P is not None:
            require_close(found.P, run.P, most, abs(run.P).max(), f"P {what}")


@add_check(ESTIMATOR_CHECKS, "diverging_row")
def _estimator_diverging_row(estimator: BaseEstimator) -> None:
    """A diverging row neither raises an error nor affects the other rows."""
    record = short_record(estimator)
    others = np.array([0, 2])
    benign = estimator.run(record)
    for value in (1e300, -1e300):  # a record with infinite outputs is refused
        diverging = copied(record)
        diverging.y[1, 5:] = value
        estimates = estimator.run(diverging)
        for name in ("xhat", "P"):
            if getattr(benign, name) is not None:
                a, b = getattr(estimates, name)[others], getattr(benign, name)[others]
                what = f"{name} of other rows with and without outputs of {value:g} in one row"
                require_close(a, b, ROUNDING, abs(b).max(axis=(0, 1)), what)


@add_check(ESTIMATOR_CHECKS, "save_load")
def _estimator_save_load(estimator: BaseEstimator) -> None:
    """A saved estimator gives the same estimates after loading.

    An estimator that needs training, or has one of ``save`` and ``load``, has both. Others are not
    held to this check, and pass.
    """
    cls = type(estimator)
    lacking = [name for name in ("save", "load") if not callable(getattr(cls, name, None))]
    if len(lacking) == 2 and cls.needs_training is None:
        return
    why = "since it needs training" if len(lacking) == 2 else "or neither"
    require(
        not lacking,
        f"{cls.__name__} has no {' and no '.join(lacking)}; expected save and load, {why}",
    )
    assert isinstance(estimator, Saved)
    record = short_record(estimator)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "saved"
        estimator.save(path)
        loaded = type(estimator).load(path, estimator.system)
    found, expected = loaded.run(record), estimator.run(record)
    _require_same(estimator, found, expected, ROUNDING, "a loaded estimator and the one saved")


@add_check(ESTIMATOR_CHECKS, "takes")
def _estimator_takes(estimator: BaseEstimator) -> None:
    """Every name in `takes` is that of a feature of a plant."""
    declared: Any = estimator.takes
    require(
        isinstance(declared, frozenset),
        f"takes={declared!r}; expected a frozenset of names",
    )
    unknown = sorted(map(str, declared - EVERYTHING))
    require(not unknown, f"takes names {', '.join(unknown)}; known are {', '.join(FEATURES)}")


ESTIMATOR_CHECKS.update(PLANT_CHECKS)
