"""The noise of a model, and its parameters, of largest likelihood given logs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pinnobs_gym.logs.filter_rows import FilterRows
from pinnobs_gym.logs.likelihood import fisher, minus_two_log_likelihoods
from pinnobs_gym.logs.minimisation import Inside, Quadratic, minimised
from pinnobs_gym.logs.reading import Log
from pinnobs_gym.logs.trajectories import limits
from pinnobs_gym.logs.unknown import Parameters
from pinnobs_gym.simulation.bounds import StateBox
from pinnobs_gym.simulation.system import Setup

_STEPS = (1e-5, 1e-4)
"""Steps of central differences, by parameters in units of their scale and by logarithms."""
_OUTPUT_FACTORS = 10.0 ** np.arange(-2, 1.5, 0.5)
_PROCESS_FACTORS = 10.0 ** np.arange(-2, 3)
"""Factors on the told noise that are tried first, all with each other."""
_SMALLEST, _LARGEST = (1e-3, 1e-5), 1e5
"""Smallest factors on the noise of outputs and on process noise, and the largest on both."""
_WITHOUT = np.geomspace(1, 1000, 40)
"""Factors on the noise of outputs that are tried where there is no process noise."""
_LEAST_GAIN = 1.35
"""Gain in log-likelihood below which process noise is not told from none: twice this is the 95 %
quantile of its law if there is none, half a χ² of one degree (Self & Liang 1987, case 5)."""
_ITERATIONS, _GAIN = 60, 1e-6
_LONGEST = 2.0
"""Largest change of a logarithm, or of a parameter in its scale, in one step."""


@dataclass(frozen=True)
class NoiseFit:
    """The values of largest likelihood. The unknowns are the parameters in units of their scale,
    less the start, then the logarithms of the factors on the told noise of outputs, and on the
    process noise (`pinnobs_gym.logs.filter_rows.FilterRows`)."""

    unknowns: np.ndarray
    """Shape (n,)."""
    information: np.ndarray
    """Fisher's information about them, shape (n, n)."""
    log_likelihood: float
    """The logarithm of the likelihood."""
    gain_of_process_noise: float
    """By how much it is larger than without any process noise; NaN if that is not to be found."""
    outputs: np.ndarray
    """Numbers of the outputs whose noise was found, as far as no log tells it by sample."""
    noise_std: np.ndarray
    """Standard deviation of the noise of each output, shape (ny,)."""
    process_noise: np.ndarray
    """L of the process noise, shape (nx, m), see `Setup.process_noise`."""
    usual: bool
    """Whether the model tells no process noise, so that that of each state was found by itself."""
    innovation: tuple[np.ndarray, ...]
    """Outputs of each log less their predictions, shape (num_samples, ny); zero where there is no
    output."""
    S: tuple[np.ndarray, ...]
    """Their covariances, shape (num_samples, ny, ny)."""

    @property
    def perhaps_none(self) -> bool:
        """Whether the logs do not tell the process noise from none."""
        return self.gain_of_process_noise < _LEAST_GAIN


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
    noise. Noise that a log tells by sample stands as it is.

    Args:
        logs: the logs, each with the prior of its initial state.
        setup: the told noise.
        parameters: the unknown ones; there may be none.
        noise: whether the noise is to be found, too; else it is as told.
        starts: further parameters, in units of their scale, from which the search is tried.
        progress: is told in a few words what is being done.

    Raises:
        ValueError: in one line, if the logs have no more outputs than there are unknowns, or if
            the filter's estimates are not finite at any of the first values.
    """
    filters = FilterRows(logs, setup, parameters, noise)
    outputs = sum(int(np.count_nonzero(~np.isnan(log.record.y))) for log in logs)
    if outputs <= sum(filters.sizes):
        p, r, q = filters.sizes
        raise ValueError(
            f"the logs have {outputs} output(s) in all; expected more than the {p + r + q} "
            f"unknown(s): {p} parameter(s) and {r + q} of the noise"
        )
    likelihood = _Likelihood(filters, parameters)
    progress("first values")
    v = likelihood.first(starts)
    count = 0

    def evaluate(v: np.ndarray) -> Quadratic:
        nonlocal count
        progress(f"step {(count := count + 1)} of the likelihood")
        return likelihood.about(v)

    v, at = minimised(
        evaluate,
        v,
        likelihood.inside,
        most=_ITERATIONS,
        least_gain=_GAIN,
        longest=_LONGEST,
    )
    if not np.isfinite(at.cost):
        raise ValueError("the filter's estimates of the logs are not finite from the first values")
    return likelihood.result(v, at)


class _Likelihood:
    """The likelihood of `fit_noise` by its unknowns, rows v (batch, n)."""

    def __init__(self, rows: FilterRows, parameters: Parameters) -> None:
        self._filters, self._n = rows, sum(rows.sizes)
        _, r, q = rows.sizes
        nx = len(rows.L)
        low, high = (side[nx:] for side in limits(rows.logs[0].system, parameters))
        least = np.r_[np.log(rows.smallest(_SMALLEST[0])), np.full(q, np.log(_SMALLEST[1]))]
        box = StateBox(np.r_[low, least], np.r_[high, np.full(r + q, np.log(_LARGEST))])
        self.inside = Inside(np.zeros(self._n), np.eye(self._n), box)

    def costs(self, rows: np.ndarray) -> np.ndarray:
        """Return −2 log p of each row (batch,); infinite where estimates are not finite."""
        cost = np.zeros(len(rows))
        for log in self._filters.logs:
            for part in self._filters.chunks(log, len(rows)):
                found = self._filters.run(log, rows[part])
                cost[part] += minus_two_log_likelihoods(log.record.y[0], *found)
        return np.where(np.isfinite(cost), cost, np.inf)

    def first(self, starts: Sequence[np.ndarray]) -> np.ndarray:
        """Return the best of some first values, (n,)."""
        p, r, q = self._filters.sizes
        outputs = np.log(_OUTPUT_FACTORS) if r else np.zeros(1)
        process = np.log(_PROCESS_FACTORS) if q else np.zeros(1)
        noises = [np.r_[np.full(r, a), np.full(q, b)] for b in process for a in outputs]
        tried = np.array([np.r_[d, each] for d in (np.zeros(p), *starts) for each in noises])
        return tried[int(np.argmin(self.costs(tried)))]

    def about(self, v: np.ndarray) -> Quadratic:
        """Return the cost −2 log p about v (n,)."""
        n, p = self._n, self._filters.sizes[0]
        step = np.diag(np.repeat(_STEPS, (p, n - p)))
        rows = self.inside.box.clipped(np.concatenate([v[None], v + step, v - step]))
        width = (rows[1 : n + 1] - rows[n + 1 :]).diagonal()
        cost, right, information = 0.0, np.zeros(n), np.zeros((n, n))
        for log in self._filters.logs:
            y = log.record.y[0]
            parts = [
                self._filters.run(log, rows[part]) for part in self._filters.chunks(log, len(rows))
            ]
            e, S = (np.concatenate(each) for each in zip(*parts, strict=True))
            costs = minus_two_log_likelihoods(y, e, S)
            cost += float(costs[0])
            right -= (costs[1 : n + 1] - costs[n + 1 :]) / (2 * width)
            slopes = ((a[1 : n + 1] - a[n + 1 :]).T / width for a in (e, S))
            information += fisher(y, S[0], *slopes)
        defined = np.isfinite(cost) and np.isfinite(right).all() and np.isfinite(information).all()
        return Quadratic(cost if defined else np.inf, right, information)

    def result(self, v: np.ndarray, at: Quadratic) -> NoiseFit:
        """Return the fit at v, about which the cost is ``at``."""
        filters = self._filters
        outputs, process = filters.factors(v[None])
        gain = 0.5 * (self._cost_without(v) - at.cost) if filters.sizes[2] else np.nan
        found = [filters.run(log, v[None]) for log in filters.logs]
        return NoiseFit(
            v,
            at.information,
            -0.5 * at.cost,
            gain,
            filters.outputs,
            outputs[0] * filters.std,
            process[0, :, None] * filters.L,
            filters.usual,
            tuple(e[0] for e, _ in found),
            tuple(S[0] for _, S in found),
        )

    def _cost_without(self, v: np.ndarray) -> float:
        """Return −2 log p without process noise, with the best common factor on the output noise of
        those that are tried; infinite if no estimate is finite."""
        filters = self._filters
        common = _WITHOUT if len(filters.outputs) else np.ones(1)
        rows = np.repeat(v[None], len(common), axis=0)
        outputs, none = filters.factors(rows)[0], np.zeros(len(filters.L))
        outputs[:, filters.outputs] *= common[:, None]
        cost = np.zeros(len(common))
        for log in filters.logs:
            for part in filters.chunks(log, len(common)):
                found = filters.filtered(log, rows[part], outputs[part], none)
                cost[part] += minus_two_log_likelihoods(log.record.y[0], *found)
        return float(np.where(np.isfinite(cost), cost, np.inf).min())
