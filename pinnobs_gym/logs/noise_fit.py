"""The noise of a model, and its parameters, of largest likelihood given logs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.logs.minimisation import Inside, Quadratic, minimised
from pinnobs_gym.logs.reading import Log
from pinnobs_gym.logs.trajectories import limits
from pinnobs_gym.logs.unknown import Parameters
from pinnobs_gym.simulation.bounds import StateBox
from pinnobs_gym.simulation.matrices import divide
from pinnobs_gym.simulation.noise import AssumedNoise, Level, SampledLevel, noise_root
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, vector

_STEPS = (1e-5, 1e-4)
"""Steps of central differences, by parameters in units of their scale and by logarithms."""
_OUTPUT_FACTORS = 10.0 ** np.array([-1, -0.5, 0, 0.5, 1])
_PROCESS_FACTORS = 10.0 ** np.arange(-2, 3)
"""Factors on the told noise that are tried first, all with each other."""
_RANGE = 1e5
"""Largest factor on the told noise, and the inverse of the smallest."""
_ITERATIONS, _GAIN = 60, 1e-6
_ENTRIES = 2**23
"""About how many numbers the results of a filter on several rows have."""


@dataclass(frozen=True)
class Innovations:
    """What an extended Kalman filter with the noise found predicts of a log."""

    innovation: np.ndarray
    """Outputs less their predictions, shape (num_samples, ny); zero where there is none."""
    S: np.ndarray
    """Their covariances, shape (num_samples, ny, ny)."""


@dataclass(frozen=True)
class NoiseFit:
    """The values of largest likelihood. The unknowns are the parameters in units of their scale,
    less the start, then the logarithms of the factors on the told noise: one for each output whose
    noise is to be found, and one for the process noise."""

    unknowns: np.ndarray
    """Shape (n,)."""
    information: np.ndarray
    """Fisher's information about them, shape (n, n)."""
    log_likelihood: float
    """The logarithm of the likelihood."""
    gain_of_process_noise: float
    """By how much it is larger than without any process noise; NaN if that is not to be found."""
    noise_std: np.ndarray
    """Standard deviation of the noise of each output, shape (ny,)."""
    process_noise: np.ndarray
    """L of the process noise, shape (nx, m), see `Setup.process_noise`."""
    innovations: tuple[Innovations, ...]
    """Those of each log."""


def usual_process_noise(logs: Sequence[Log]) -> Level:
    """Return process noise for a model that tells none, of which a factor is then found: it moves
    each state by its scale over the longest log."""
    system = logs[0].system
    duration = max(float(np.ptp(log.record.t)) for log in logs)
    return tuple((vector(system.scale, system.nx, "scale") / np.sqrt(duration or 1.0)).tolist())


def fit_noise(
    logs: Sequence[Log],
    setup: Setup,
    parameters: Parameters,
    *,
    noise: bool = True,
    starts: Sequence[np.ndarray] = (),
    progress: Callable[[str], object] = lambda text: None,
) -> NoiseFit:
    """Return the parameters and the noise of largest likelihood.

    The likelihood is that of the innovations e of an extended Kalman filter,
    −2 log p = Σ(eᵀS⁻¹e + log det 2πS) (Särkkä 2013, "Bayesian Filtering and Smoothing", section
    12.3.1). It is maximised by Fisher's method of scoring with the information
    Σ(∂eᵀS⁻¹∂e + ½ tr(S⁻¹∂S S⁻¹∂S)) (Gupta & Mehra 1974), whose inverse is the covariance of the
    unknowns; slopes are central differences. The search begins at the best of several sizes of the
    noise. A log's own standard deviations by sample stand as they are.

    Args:
        logs: the logs, each with the prior of its initial state.
        setup: the told noise.
        parameters: the unknown ones; there may be none.
        noise: whether the noise is to be found, too; else it is as told.
        starts: further parameters, in units of their scale, from which the search is tried.
        progress: is told in a few words what is being done.

    Raises:
        ValueError: in one line, if nothing is unknown, if all noise is told by sample, or if the
            filter's estimates are not finite at the start.
    """
    problem = _Problem(logs, setup, parameters, noise)
    progress("first values")
    v = problem.first(starts)
    count = 0

    def evaluate(v: np.ndarray) -> Quadratic:
        nonlocal count
        progress(f"iteration {(count := count + 1)}")
        return problem.about(v)

    v, at = minimised(evaluate, v, problem.inside, most=_ITERATIONS, least_gain=_GAIN)
    if not np.isfinite(at.cost):
        raise ValueError("the filter's estimates of the logs are not finite from the first values")
    return problem.result(v, at)


class _Problem:
    """The likelihood of `fit_noise` by its unknowns, rows v (batch, n)."""

    def __init__(
        self, logs: Sequence[Log], setup: Setup, parameters: Parameters, noise: bool
    ) -> None:
        system = logs[0].system
        self._logs, self._parameters, self._p = logs, parameters, len(parameters.names)
        if noise and not noise_root(setup.process_noise, system.nx, "process_noise").any():
            setup = replace(setup, process_noise=usual_process_noise(logs))
        self._setup = setup
        self._L = noise_root(setup.process_noise, system.nx, "process_noise")
        told = AssumedNoise.of(system, system.noise(setup.noise_std, setup.process_noise))
        self._std = np.sqrt(np.einsum("iib->i", told.R(0.0)))
        self._by_output = np.flatnonzero(_untold(logs)) if noise else np.empty(0, dtype=int)
        self._by_process = noise
        self._n = self._p + len(self._by_output) + noise
        low, high = (side[system.nx :] for side in limits(system, parameters))
        wide = np.full(self._n - self._p, np.log(_RANGE))
        box = StateBox(np.r_[low, -wide], np.r_[high, wide])
        self.inside = Inside(np.zeros(self._n), np.eye(self._n), box)

    def _factors(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the factors on the told noise of outputs, (batch, ny), and of the plant."""
        outputs, process = np.ones((len(rows), len(self._std))), np.ones(len(rows))
        outputs[:, self._by_output] = np.exp(rows[:, self._p : self._p + len(self._by_output)])
        if self._by_process:
            process = np.exp(rows[:, -1])
        return outputs, process

    def costs(self, rows: np.ndarray) -> np.ndarray:
        """Return −2 log p of each row (batch,); infinite where estimates are not finite."""
        cost = np.zeros(len(rows))
        for i in range(len(self._logs)):
            for part in self._chunks(i, len(rows)):
                cost[part] += minus_two_log_likelihoods(self._logs[i].record.y[0], *self._run(i, rows[part]))
        return np.where(np.isfinite(cost), cost, np.inf)

    def first(self, starts: Sequence[np.ndarray]) -> np.ndarray:
        """Return the best of some first values, (n,)."""
        noises = [np.zeros(self._n - self._p)]
        if self._by_process:
            r = np.log(_OUTPUT_FACTORS if len(self._by_output) else np.ones(1))
            q = np.log(_PROCESS_FACTORS)
            noises = [np.r_[np.full(len(self._by_output), a), b] for b in q for a in r]
        tried = np.array([np.r_[d, each] for d in (np.zeros(self._p), *starts) for each in noises])
        return tried[int(np.argmin(self.costs(tried)))]

    def about(self, v: np.ndarray) -> Quadratic:
        """Return the cost −2 log p about v (n,)."""
        n = self._n
        step = np.r_[np.full(self._p, _STEPS[0]), np.full(n - self._p, _STEPS[1])]
        box = self.inside.box
        rows = box.clipped(np.concatenate([v[None], v + np.diag(step), v - np.diag(step)]))
        width = (rows[1 : n + 1] - rows[n + 1 :]).diagonal()
        cost, right, information = 0.0, np.zeros(n), np.zeros((n, n))
        for i in range(len(self._logs)):
            y = self._logs[i].record.y[0]
            parts = [self._run(i, rows[part]) for part in self._chunks(i, len(rows))]
            e, S = (np.concatenate(each) for each in zip(*parts, strict=True))
            costs = minus_two_log_likelihoods(y, e, S)
            cost += float(costs[0])
            right -= (costs[1 : n + 1] - costs[n + 1 :]) / (2 * width)
            slopes = [(a[1 : n + 1] - a[n + 1 :]).T / width for a in (e, S)]
            information += fisher(y, S[0], *slopes)
        if not (np.isfinite(cost) and np.isfinite(right).all() and np.isfinite(information).all()):
            return Quadratic(np.inf, right, information)
        return Quadratic(cost, right, information)

    def _chunks(self, i: int, count: int) -> list[slice]:
        """Return the parts of a number of rows that are filtered at once."""
        log = self._logs[i]
        nx, ny = log.system.nx, log.system.ny
        each = len(log.record.t) * (nx + nx * nx + 2 * ny + ny * ny)
        size = max(1, _ENTRIES // each)
        return [slice(k, min(k + size, count)) for k in range(0, count, size)]

    def _run(self, i: int, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the innovations (batch, num_samples, ny) of a log and their covariances."""
        outputs, process = self._factors(rows)
        e, S = None, None
        for factor in np.unique(process):
            chosen = np.flatnonzero(process == factor)
            found = self._filtered(i, rows[chosen], outputs[chosen], float(factor))
            if e is None or S is None:
                e, S = (np.empty((len(rows), *part.shape[1:])) for part in found)
            e[chosen], S[chosen] = found
        assert e is not None and S is not None
        return e, S

    def _filtered(
        self, i: int, rows: np.ndarray, outputs: np.ndarray, factor: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return what `_run` does with one factor on the process noise."""
        log, count = self._logs[i], len(rows)
        record = log.record
        system = log.system
        if self._p:
            system = self._parameters.of(system, self._parameters.values(rows[:, : self._p]))
        level: Level | SampledLevel = self._setup.noise_std
        std = record.noise_std
        if len(self._by_output) or std is not None:
            own = np.broadcast_to((outputs * self._std)[:, None], (count, *record.y.shape[1:]))
            own = own if std is None else np.where(np.isnan(std), own, std)
            level = SampledLevel(record.t, own, self._setup.noise_std)
        L = tuple(map(tuple, (factor * self._L).tolist()))
        ekf = EKF(system, level, L if self._L.any() and factor else 0.0, assumed_noise=0.0)
        estimates = ekf.run(repeated(record, count))
        assert estimates.innovation is not None and estimates.S is not None
        return estimates.innovation, estimates.S

    def result(self, v: np.ndarray, at: Quadratic) -> NoiseFit:
        """Return the fit at v."""
        outputs, process = self._factors(v[None])
        gain, found = np.nan, []
        if self._by_process:
            without = sum(self._cost_without(i, v, outputs) for i in range(len(self._logs)))
            gain = 0.5 * (without - at.cost) if np.isfinite(without) else np.inf
        for i in range(len(self._logs)):
            e, S = self._run(i, v[None])
            found.append(Innovations(e[0], S[0]))
        std, L = outputs[0] * self._std, process[0] * self._L
        return NoiseFit(v, at.information, -0.5 * at.cost, gain, std, L, tuple(found))

    def _cost_without(self, i: int, v: np.ndarray, outputs: np.ndarray) -> float:
        """Return −2 log p of a log without process noise, with the best common factor on the output
        noise of those that are tried."""
        r = np.r_[1.0, np.linspace(0.5, 2, 16)] if len(self._by_output) else np.ones(1)
        rows, factors = np.repeat(v[None], len(r), axis=0), np.repeat(outputs, len(r), axis=0)
        factors[:, self._by_output] *= r[:, None]
        found = self._filtered(i, rows, factors, 0.0)
        return float(np.nanmin(minus_two_log_likelihoods(self._logs[i].record.y[0], *found)))


def repeated(record: Record, count: int) -> Record:
    """Return a record of several equal rows from one of one row."""
    prior = Prior(np.repeat(record.prior.mean, count, 0), np.repeat(record.prior.cov, count, 0))
    return Record(record.t, np.repeat(record.y, count, 0), np.repeat(record.u, count, 0), prior)


def _untold(logs: Sequence[Log]) -> np.ndarray:
    """Return which outputs have a noise that the logs do not tell, bool (ny,).

    Raises:
        ValueError: in one line, if there is none.
    """
    untold = np.zeros(logs[0].system.ny, dtype=bool)
    for log in logs:
        y, std = log.record.y[0], log.record.noise_std
        present = ~np.isnan(y)
        untold |= (present if std is None else present & np.isnan(std[0])).any(axis=0)
    return untold


def minus_two_log_likelihoods(y: np.ndarray, e: np.ndarray, S: np.ndarray) -> np.ndarray:
    """Return Σ(eᵀS⁻¹e + log det 2πS), shape (batch,), over the samples with outputs.

    Args:
        y: outputs, shape (num_samples, ny); NaN marks a missing one.
        e: innovations, shape (batch, num_samples, ny).
        S: their covariances, shape (batch, num_samples, ny, ny).
    """
    total = np.zeros(len(e))
    with np.errstate(all="ignore"):  # what is not finite is found by the caller
        for rows, present in _patterns(y):
            own = S[:, rows][..., present, :][..., present]
            off = e[:, rows][..., present]
            if own.shape[-1] == 1:  # by far the most frequent
                s = own[..., 0, 0]
                total += (off[..., 0] ** 2 / s + np.log(2 * np.pi * s)).sum(axis=1)
                continue
            weighted = _divided(off[..., None, :], own)[..., 0, :]
            sign, size = np.linalg.slogdet(2 * np.pi * own)
            total += ((weighted * off).sum(axis=-1) + np.where(sign > 0, size, np.nan)).sum(axis=1)
    return total


def fisher(y: np.ndarray, S: np.ndarray, de: np.ndarray, dS: np.ndarray) -> np.ndarray:
    """Return Σ(∂eᵀS⁻¹∂e + ½ tr(S⁻¹∂S S⁻¹∂S)), shape (n, n), over the samples with outputs.

    Args:
        y: outputs, shape (num_samples, ny); NaN marks a missing one.
        S: covariances of the innovations, shape (num_samples, ny, ny).
        de: derivatives of the innovations by the unknowns, shape (ny, num_samples, n).
        dS: those of the covariances, shape (ny, ny, num_samples, n).
    """
    n = de.shape[-1]
    total = np.zeros((n, n))
    with np.errstate(all="ignore"):
        for rows, present in _patterns(y):
            own = S[rows][:, present][:, :, present]
            slopes = de[present][:, rows].transpose(1, 2, 0)  # (samples, n, outputs)
            total += np.einsum("kia,kja->ij", _divided(slopes, own), slopes)
            changes = dS[present][:, present][:, :, rows].transpose(2, 3, 0, 1)
            weighted = _divided(changes, own[:, None])
            total += 0.5 * np.einsum("kiab,kjba->ij", weighted, weighted)
    return total


def _divided(A: np.ndarray, S: np.ndarray) -> np.ndarray:
    """Return AS⁻¹ (..., n, m); NaN where S (..., m, m) is singular or not finite."""
    shape = np.broadcast_shapes(A.shape[:-2], S.shape[:-2])
    n, m = A.shape[-2:]
    flat = np.broadcast_to(A, (*shape, n, m)).reshape(-1, n, m).transpose(1, 2, 0)
    own = np.broadcast_to(S, (*shape, m, m)).reshape(-1, m, m).transpose(1, 2, 0)
    return divide(np.ascontiguousarray(flat), np.ascontiguousarray(own)).transpose(2, 0, 1).reshape(*shape, n, m)


def _patterns(y: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the samples that have the same outputs, with these outputs."""
    present = ~np.isnan(y)
    found = []
    for pattern in np.unique(present[present.any(axis=1)], axis=0):
        rows = np.flatnonzero((present == pattern).all(axis=1))
        found.append((rows, np.flatnonzero(pattern)))
    return found
