"""What speaks against the estimates of a record without known states, such as a sensor log."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pinnobs_gym.estimation.estimator import Estimates
from pinnobs_gym.logs.facts import FEWEST, common_facts, innovation_facts, state_fact
from pinnobs_gym.logs.innovation_tests import (
    Size,
    correlation_of,
    drift_of,
    size_of,
)
from pinnobs_gym.logs.input_tests import driven_by
from pinnobs_gym.logs.meanings import early_facts, warnings_of
from pinnobs_gym.logs.normalised import Normalised, normalised
from pinnobs_gym.logs.outlier_tests import outliers_of
from pinnobs_gym.logs.times import instant
from pinnobs_gym.logs.unseen import Seen, seen
from pinnobs_gym.logs.verdicts import OutputTests
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import Setup, System, vector

_FAR = 1e3
"""Distance of an estimate from the prior's mean, in scales, from which on it counts as diverged."""
_KNOWN = 0.1
"""Standard deviation over that distance below which the estimate of such a state is a known one."""
_ENOUGH = 100
"""Least number of samples of its second half by which a log may fit later."""
_UNLIKELY = 6.0
"""Standard deviations from which on the first innovation of an output speaks against the prior."""


@dataclass(frozen=True)
class Judgement:
    """What a log says of the estimates made from it."""

    facts: tuple[str, ...]
    """Lines that are always shown: sizes and correlations of innovations, steps of t, states that
    the outputs tell, missing outputs."""
    warnings: tuple[str, ...]
    """What speaks against the estimates, a line each: what is seen, what it means, what to try."""


def judge(system: System, setup: Setup, record: Record, estimates: Estimates) -> Judgement:
    """Judge the estimates of a record's first row.

    The innovations of a filter whose model and noise are right are white and as large as their
    covariances say (Bar-Shalom, Li & Kirubarajan 2001, section 5.4), which
    `pinnobs_gym.logs.innovation_tests` tests for each output. Of estimates without innovation
    covariances, residuals are judged, see `pinnobs_gym.logs.normalised.normalised`. The start of
    the log is left out, except for the first innovation of each output, which tells of the prior.
    A log of few samples is not judged.

    Args:
        system: the model.
        setup: its noise, as the estimator was told, and its time between samples.
        record: the samples.
        estimates: of an estimator.
    """
    if not np.isfinite(estimates.xhat[0]).all():
        return Judgement(common_facts(system, setup, record), (_not_finite(record, estimates),))
    found = normalised(system, setup, record, estimates)
    tests, together = _tests(system, record, found)
    told = seen(system, setup, record, estimates)
    facts = [*innovation_facts(found, tests, together), *early_facts(tests)]
    facts += common_facts(system, setup, record)
    warnings = warnings_of(tests, together)
    fits = bool(tests) and not warnings
    warnings = [*_diverged(system, record, estimates, fits), *warnings]
    warnings += _first(system, record, found)
    if told is not None:
        facts.append(state_fact(system, told))
        warnings += _unseen(system, told, estimates)
    return Judgement(tuple(facts), tuple(warnings))


def _tests(
    system: System, record: Record, found: Normalised
) -> tuple[list[OutputTests], Size | None]:
    """Return the tests of the outputs that have enough samples, and the size of all together."""
    tests = []
    for i in range(system.ny):
        rows = np.flatnonzero(np.isfinite(found.values[:, i]))
        rows = rows[rows >= found.start]
        if len(rows) >= FEWEST:
            half = rows[len(rows) // 2 :]
            later = _tests_of(i, system, record, found, half) if len(half) >= _ENOUGH else None
            tests.append(replace(_tests_of(i, system, record, found, rows), later=later))
    if found.squares is None or len(tests) < 2:
        return tests, None
    rows = np.flatnonzero(np.isfinite(found.squares))
    rows = rows[rows >= found.start]
    if len(rows) < FEWEST:
        return tests, None
    degrees = np.isfinite(found.values[rows]).sum(axis=1)
    return tests, size_of(found.squares[rows], degrees)


def _tests_of(
    i: int, system: System, record: Record, found: Normalised, rows: np.ndarray
) -> OutputTests:
    """Return the tests of an output at some samples (n,) that have it."""
    values, t = found.values[rows, i], record.t[rows]
    outliers = outliers_of(values)
    return OutputTests(
        system.output_names[i],
        size_of(values**2, np.ones(len(values))),
        correlation_of(values, t),
        drift_of(values),
        outliers,
        tuple(instant(t[k], record.t) for k in (outliers.first, outliers.last, outliers.worst)),
        driven_by(values, rows, record.u[0], system.input_names),
        bool(found.small_tells[i]),
        bool(found.white[i]),
        found.of_filter,
        instant(t[0], record.t),
    )


def _unseen(system: System, told: Seen, estimates: Estimates) -> list[str]:
    names = [name for name, each in zip(system.state_names, told.matters, strict=True) if each]
    if not names or estimates.P is None:
        return []
    return [
        f"{', '.join(names)}: the variance never fell, as these outputs tell nothing of it; the "
        "estimate is the model's alone; measure more, or fix it by a small standard deviation "
        "(--P0-std, or that of a constant in --also)"
    ]


def _first(system: System, record: Record, found: Normalised) -> list[str]:
    """Return what the first innovation of each output says of the prior."""
    if not found.of_filter:
        return []
    parts = []
    for i, name in enumerate(system.output_names):
        rows = np.flatnonzero(np.isfinite(found.values[:, i]))
        if len(rows) and abs(found.values[rows[0], i]) > _UNLIKELY:
            y = record.y[0, rows[0], i]
            parts.append(f"{name} = {y:.4g} ({abs(found.values[rows[0], i]):.2g} times)")
    if not parts:
        return []
    return [
        f"the first {', '.join(parts)} is that many standard deviations from what the start says; "
        "check --xhat0, --P0-std and the unit of the output"
    ]


def _diverged(system: System, record: Record, estimates: Estimates, fits: bool) -> list[str]:
    """Return whether an estimate is so far from the start that it has probably diverged. A plant
    may go far, too: where the innovations fit, a state that is known well is where it is said to
    be."""
    xhat = estimates.xhat[0]
    far = abs(xhat - record.prior.mean[0]) / vector(system.scale, system.nx, "scale")
    if fits and estimates.P is not None:
        with np.errstate(all="ignore"):
            std = np.sqrt(np.einsum("kii->ki", estimates.P[0]))
        known = std < _KNOWN * abs(xhat - record.prior.mean[0])
        far = np.where(known, 0.0, far)
    k, i = np.unravel_index(np.argmax(far), far.shape)
    if far[k, i] <= _FAR:
        return []
    return [
        f"{system.state_names[i]} is estimated as {xhat[k, i]:.6g}, {far[k, i]:.2g} times its "
        "scale away from the start; the estimator has probably diverged"
    ]


def _not_finite(record: Record, estimates: Estimates) -> str:
    k = int(np.flatnonzero(~np.isfinite(estimates.xhat[0]).all(axis=1))[0])
    return f"the estimates leave the finite numbers at t = {instant(record.t[k], record.t)}"
