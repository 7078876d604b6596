"""Checks that an estimator takes a plant and its record as these say: its units, its noise, its
inputs, and rows without outputs."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from pinnobs_gym.estimation.check_records import copied, short_record, tolerated
from pinnobs_gym.estimation.estimator import BaseEstimator, Estimates
from pinnobs_gym.simulation.conformance import Found, add_check, require, require_close
from pinnobs_gym.simulation.model import model_step
from pinnobs_gym.simulation.noise import Level
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.rescaled import Units, rescaled
from pinnobs_gym.simulation.runge_kutta import longest_step
from pinnobs_gym.simulation.system import System, vector

SAME = 1e-6
"""Largest difference, over scale, between estimates that should be the same."""
NO_MORE = 1e-3
"""Largest influence, over scale, of an output with a standard deviation `MUCH` times as large."""
MUCH = 1e6
"""Factor of the standard deviation of an output that should not count."""
UNIT = 2.0**30
"""Factor between units, about 1e9; a power of two changes no rounding."""
BLANK = 3
"""Number of rows without any output between two samples."""

PLANT_CHECKS: dict[str, Callable[[BaseEstimator], None]] = {}
"""These checks by name."""


@add_check(PLANT_CHECKS, "blank_rows")
def _blank_rows(estimator: BaseEstimator) -> None:
    """Rows without any output between the samples change no estimate at the samples."""
    made = _with_steps_between(estimator)
    every, rows = BLANK + 1, short_record(made)
    system, rows = made.system, rows.first_samples((rows.num_samples - 1) // every * every + 1)
    seen = np.arange(rows.num_samples) % every == 0
    if system.measured_input:
        rows = replace(rows, u=_joined(system, rows, every))
    found = made.run(replace(rows, y=np.where(seen[:, None], rows.y, np.nan)))
    what = f"with {BLANK} rows without outputs between any two samples and without"
    _require_same(system, made.run(rows.samples(seen)), _at(found, seen), what)


def _with_steps_between(estimator: BaseEstimator) -> BaseEstimator:
    """Return the estimator for a model that takes as many Runge-Kutta steps between the samples
    with rows between them as without, so that its error is the same."""
    system = estimator.system
    if system.discrete or system.own_flow or system.stiff:
        return estimator
    dt, longest = system.setups["benchmark"].dt, longest_step(system)
    without, between = (math.ceil(gap / longest - SAME) for gap in ((BLANK + 1) * dt, dt))
    if without == (BLANK + 1) * between:
        return estimator
    return replace(estimator, system=rescaled(system, Units(), model_step=dt / between))


def _joined(system: System, rows: Record, every: int) -> np.ndarray:
    """Return the inputs (batch, num_samples, nu) that those at the samples, one in `every` rows,
    say for the rows between them."""
    k = np.arange(rows.num_samples)
    before = rows.u[:, k // every * every]
    if system.input_hold == "previous":
        return before
    after = rows.u[:, np.minimum(k // every * every + every, k[-1])]
    part = (k % every / every)[:, None]
    return (1 - part) * before + part * after


def _at(estimates: Estimates, chosen: np.ndarray) -> Estimates:
    """Return the estimates and covariances at some of the samples."""
    P = estimates.P
    return Estimates(estimates.xhat[:, chosen], None if P is None else P[:, chosen])


def _require_same(
    system: System, a: Estimates, b: Estimates, what: str, tolerance: float = SAME
) -> None:
    """Require that estimates and covariances agree within a tolerance."""
    scale = vector(system.scale, system.nx, "scale")
    off = system.state_residual(a.xhat, b.xhat)
    require_close(off, np.zeros_like(off), tolerance, scale, f"estimates {what}")
    if a.P is not None and b.P is not None:
        size = np.sqrt(np.einsum("bkii->bki", np.maximum(abs(a.P), abs(b.P))).max(axis=(0, 1)))
        require_close(a.P, b.P, tolerance, np.outer(size, size), f"covariances {what}")


@add_check(PLANT_CHECKS, "units")
def _units(estimator: BaseEstimator) -> None:
    """Estimates do not depend on the units of states, outputs and time."""
    system, record = estimator.system, short_record(estimator).first_samples(15)
    expected = _in_units(estimator, Units(), record)
    for factor in (UNIT, 1 / UNIT):
        units = Units(factor, 1 / factor, 1.0 if system.discrete else factor)
        what = (
            f"in units that make states {factor:.0e}, outputs {1 / factor:.0e} and times "
            f"{units.time:.0e} times as large (is a constant in one unit?) and in the plant's"
        )
        found = _in_units(estimator, units, record)
        try:
            _require_same(system, found, expected, what)
        except Found:
            run = partial(_in_units, estimator, Units())
            _require_same(system, found, expected, what, tolerated(run, system, record, SAME))


def _in_units(estimator: BaseEstimator, units: Units, record: Record) -> Estimates:
    """Return estimates in the plant's units from the estimator of the plant in other units, whose
    benchmark is as long as the record."""
    level, process = estimator.noise_std, estimator.process_noise
    if process is not None:
        process = (np.asarray(process, dtype=float) * units.process_noise).tolist()
    made = replace(
        estimator,
        system=rescaled(estimator.system, units, float(record.t[-1])),
        noise_std=None if level is None else units.output_noise(level),
        process_noise=process,
    )
    run = made.run(units.record(record))
    P = None if run.P is None else run.P / units.states**2
    return Estimates(run.xhat / units.states, P)


@add_check(PLANT_CHECKS, "noise_matrix")
def _noise_matrix(estimator: BaseEstimator) -> None:
    """Correlations of the output noise change the estimates, if its size does."""
    ny = estimator.system.ny
    if "full_noise" not in estimator.takes or ny < 2:
        return
    std, record = _output_std(estimator), short_record(estimator).first_samples(10)
    if not _uses_noise(estimator, record, std):
        return
    correlated = np.linalg.cholesky(0.2 * np.eye(ny) + 0.8)
    found = _told(estimator, (std[:, None] * correlated).tolist()).run(record)
    alone = _told(estimator, std.tolist()).run(record)
    require(
        not np.array_equal(found.xhat, alone.xhat, equal_nan=True),
        "estimates are the same for output noise with a correlation of 0.8 and without; expected "
        "others, or takes without 'full_noise'",
    )


@add_check(PLANT_CHECKS, "sampled_noise")
def _sampled_noise(estimator: BaseEstimator) -> None:
    """An output that is told to be very uncertain at a sample counts no more than a missing one,
    if the size of the noise changes the estimates."""
    if "sampled_noise" not in estimator.takes:
        return
    system, std, k = estimator.system, _output_std(estimator), 5
    record = short_record(estimator).first_samples(10)
    if not _uses_noise(estimator, record, std):
        return
    estimator = _told(estimator, std.tolist())
    levels = np.broadcast_to(std, record.y.shape).copy()
    levels[:, k, 0] *= MUCH
    missing = copied(record)
    missing.y[:, k, 0] = np.nan
    found = estimator.run(replace(record, noise_std=levels)).xhat
    off = system.state_residual(found, estimator.run(missing).xhat)
    what = (
        f"estimates with {system.output_names[0]} at sample {k} told to have {MUCH:.0e} times its "
        "standard deviation and with it missing"
    )
    scale = vector(system.scale, system.nx, "scale")
    require_close(off, np.zeros_like(off), NO_MORE, scale, what)


def _output_std(estimator: BaseEstimator) -> np.ndarray:
    """Return the standard deviations (ny,) of the output noise that an estimator assumes."""
    return np.sqrt(np.einsum("iib->i", estimator.noise.R(0.0)[..., :1]))


def _told(estimator: BaseEstimator, level: Level) -> BaseEstimator:
    """Return the estimator that is told this output noise."""
    return replace(estimator, noise_std=level)


def _uses_noise(estimator: BaseEstimator, record: Record, std: np.ndarray) -> bool:
    """Return whether the size of the output noise changes the estimates. Estimators that do not
    use it take any noise."""
    runs = [_told(estimator, (factor * std).tolist()).run(record).xhat for factor in (1.0, 2.0)]
    return not np.array_equal(*runs, equal_nan=True)


@add_check(PLANT_CHECKS, "held_input")
def _held_input(estimator: BaseEstimator) -> None:
    """Between two samples measured inputs are as `System.input_hold` says: held, so that the state
    at the second depends on the first alone, or on straight lines, so that it depends on both."""
    plant = estimator.system
    if not plant.nu:
        return
    # The other hold is tried, too, where the plant may have it.
    one = plant.own_flow or plant.discrete
    for hold in (plant.input_hold,) if one else ("previous", "linear"):
        if hold == "linear" or "held_input" in estimator.takes:
            duration = 6 * plant.setups["benchmark"].dt
            system = replace(plant, measured_input=True)
            system = rescaled(system, Units(), duration, input_hold=hold)
            _check_hold(replace(estimator, system=system))


def _check_hold(estimator: BaseEstimator) -> None:
    """Change the inputs at each of two samples, which have no outputs, and require that the
    estimate at the second changes if the model's state does, and only then."""
    system, record, k = estimator.system, copied(short_record(estimator).first_samples(7)), 5
    record.y[:, k:] = np.nan
    scale = vector(system.scale, system.nx, "scale")
    first = estimator.run(record).xhat
    for sample, name in ((k, "the first"), (k + 1, "the second")):
        changed = copied(record)
        changed.u[:, sample] += 1 + abs(record.u).max()
        off = abs(estimator.run(changed).xhat[:, k + 1] - first[:, k + 1]) / scale
        t0, t1 = record.t[k : k + 2]
        ends = [
            model_step(system, t0, t1, first[:, k], u[:, k], u[:, k + 1])
            for u in (record.u, changed.u)
        ]
        moves = (abs(ends[1] - ends[0]) / scale).max() > SAME
        where = f"the estimate at a sample depends on the input at {name} of the two samples"
        says = f"with input_hold={system.input_hold!r} the model's state does"
        if moves:
            require(off.max() > 0, f"{where.replace('depends', 'does not depend')}; {says}")
        else:
            require(off.max() <= SAME, f"{where}, by {off.max():.1e} of scale; {says} not")
