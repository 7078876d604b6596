"""Unknown parameters of a model, by least squares over the trajectories through logs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pinnobs_gym.estimation.least_squares import root
from pinnobs_gym.logs.minimisation import Inside, Quadratic, minimised
from pinnobs_gym.logs.reading import Log
from pinnobs_gym.logs.trajectories import Sensitivity, Trajectory, limits
from pinnobs_gym.logs.unknown import Parameters
from pinnobs_gym.simulation.bounds import StateBox
from pinnobs_gym.simulation.kernels.asked import ask
from pinnobs_gym.simulation.system import Setup

_SHORTEST = 16
"""Largest number of samples with outputs in the first part of a log."""
_ITERATIONS = (15, 60)
"""Largest number of iterations on each part, and on the whole logs."""
_GAIN = (1e-2, 1e-8)
"""Predicted decrease of the cost at which these end."""
_FACTORS = (1.0, 0.5, 2.0)
"""Factors on the first values from which the search is tried."""
_EXPLAINED = 4.0
"""Mean square of the residuals over their expectation up to which the first search is the last."""


@dataclass(frozen=True)
class ParameterFit:
    """The parameters that fit logs best, and what is known of them."""

    d: np.ndarray
    """The parameters in units of their scale, less the start, shape (p,)."""
    information: np.ndarray
    """The inverse of their covariance by the told output noise, whatever the initial states, shape
    (p, p); singular where the logs do not tell them."""
    excess: float
    """Mean square of the residuals over that of the told output noise."""
    start: tuple[np.ndarray, ...]
    """The initial state of each log, shape (nx,)."""
    trajectories: tuple[Trajectory, ...]
    """The trajectory of the model through each log."""


def fit_parameters(
    logs: Sequence[Log],
    setup: Setup,
    parameters: Parameters,
    progress: Callable[[str], object] = lambda text: None,
    *,
    again: bool = True,
) -> ParameterFit:
    """Return the parameters with the least sum of squared output errors.

    The cost Σ(y − h)ᵀR⁻¹(y − h) + Σ(x₀ − x̂₀)ᵀP₀⁻¹(x₀ − x̂₀) is minimised over the parameters, which
    all logs have in common, and over the initial state of each log, of which the prior is known
    (output error method: Ljung 1999, "System Identification", sections 4.3 and 7.2). With output
    noise alone these are the values of largest likelihood. The search begins with the first samples
    of the logs and doubles their number, so that the phase of an oscillation is not lost. As these
    parts may not tell all parameters, each also has a prior of its start and its scale there, which
    the whole logs have not. If the residuals are large in the end, the search is repeated from half
    and from twice the first values, and the best result is taken.

    Args:
        logs: the logs, each with the prior of its initial state.
        setup: the output noise.
        parameters: the unknown ones.
        progress: is told in a few words what is being done.
        again: whether the search may be repeated.

    Raises:
        ValueError: in one line, if the logs have too few outputs, or if the model is not defined at
            the start.
    """
    problem = _Problem(logs, setup, parameters)
    found: list[tuple[float, np.ndarray]] = []
    for factor in _FACTORS:
        start = parameters.start
        d = (np.clip(factor * start, parameters.low, parameters.high) - start) / parameters.scale
        found.append(
            problem.grown(d, lambda text, f=factor: progress(f"{text}, start times {f:g}"))
        )
        explained = found[-1][0] <= _EXPLAINED * problem.freedom
        if explained or not again or not start.any():
            break
    cost, v = min(found, key=lambda each: each[0])
    if not np.isfinite(cost):
        values = ", ".join(
            f"{n}={x:g}" for n, x in zip(parameters.names, parameters.start, strict=True)
        )
        raise ValueError(f"the model's outputs are not finite from {values}; give another start")
    return problem.result(v)


class _Problem:
    """The cost of `fit_parameters`. Its unknowns v are, for each log, z with x₀ = x̂₀ + Lz and
    LLᵀ = P₀, whose prior is standard normal, and then the parameters in units of their scale."""

    def __init__(self, logs: Sequence[Log], setup: Setup, parameters: Parameters) -> None:
        self._logs, self._parameters = logs, parameters
        self._nx, self._p = logs[0].system.nx, len(parameters.names)
        self._n = self._nx * len(logs) + self._p
        self._means = [log.record.prior.mean[0] for log in logs]
        self._roots = [root(log.record.prior.cov.transpose(1, 2, 0))[..., 0] for log in logs]
        for log in logs:
            ask(log.system, "model")
        self._runs = [Sensitivity(log, setup, parameters) for log in logs]
        self._measured = [np.flatnonzero(~np.isnan(log.record.y[0]).all(axis=1)) for log in logs]
        outputs = sum(int(np.count_nonzero(~np.isnan(log.record.y))) for log in logs)
        self.freedom = outputs - self._p
        """Number of outputs less that of parameters."""
        if self.freedom < 1:
            raise ValueError(
                f"the logs have {outputs} output(s) in all; expected more than the {self._p} "
                "parameter(s)"
            )
        self._inside = self._bounds()

    def _bounds(self) -> Inside | None:
        parts = [limits(log.system, self._parameters) for log in self._logs]
        nx = self._nx
        low, high = (
            np.concatenate([*(part[side][:nx] for part in parts), parts[0][side][nx:]])
            for side in (0, 1)
        )
        if not (np.isfinite(low).any() or np.isfinite(high).any()):
            return None
        T = np.eye(self._n)
        for i, L in enumerate(self._roots):
            T[i * nx : (i + 1) * nx, i * nx : (i + 1) * nx] = L
        return Inside(np.r_[(*self._means, np.zeros(self._p))], T, StateBox(low, high))

    def first(self, d: np.ndarray) -> np.ndarray:
        """Return where the search begins: the prior's means and parameters d (p,)."""
        v = np.r_[np.zeros(self._n - self._p), d]
        return v if self._inside is None else self._inside.nearest(v, np.eye(self._n))

    def shares(self) -> list[float]:
        """Return the shares of the logs that are fitted in turn."""
        shares, most = [1.0], max(map(len, self._measured))
        while shares[0] * most > _SHORTEST:
            shares.insert(0, shares[0] / 2)
        return shares

    def grown(self, d: np.ndarray, progress: Callable[[str], object]) -> tuple[float, np.ndarray]:
        """Return the least cost that is found from parameters d (p,), and its unknowns."""
        v, cost, shares = self.first(d), np.inf, self.shares()
        for number, share in enumerate(shares):
            progress(f"part {number + 1} of {len(shares)}")
            v, at = self.searched(v, share)
            cost = at.cost
        return cost, v

    def searched(self, v: np.ndarray, share: float) -> tuple[np.ndarray, Quadratic]:
        """Return the best v near one for the first share of the logs, and the cost about it."""
        whole = int(share == 1.0)
        lengths = [
            len(log.record.t) if whole else int(rows[max(0, int(share * len(rows)) - 1)]) + 1
            for log, rows in zip(self._logs, self._measured, strict=True)
        ]
        return minimised(
            lambda v: self._cost(v, lengths, 0.0 if whole else 1.0),
            v,
            self._inside,
            most=_ITERATIONS[whole],
            least_gain=_GAIN[whole],
        )

    def _cost(self, v: np.ndarray, lengths: Sequence[int], weight: float) -> Quadratic:
        """Return the cost about v over the first samples of each log, with the prior of the
        parameters times a weight."""
        weights = np.r_[np.ones(self._n - self._p), np.full(self._p, weight)]
        cost, right, information = float(weights @ v**2), -weights * v, np.diag(weights)
        for i, length in enumerate(lengths):
            at = self._trajectory(v, i, length)
            r, G = at.whitened.ravel(), at.slopes.reshape(at.whitened.size, -1)
            if not (np.isfinite(r).all() and np.isfinite(G).all()):
                return Quadratic(np.inf, right, information)
            G = np.concatenate([G[:, : self._nx] @ self._roots[i], G[:, self._nx :]], axis=1)
            own = np.r_[self._own(i), np.arange(self._n - self._p, self._n)]
            cost += float(r @ r)
            right[own] += G.T @ r
            information[np.ix_(own, own)] += G.T @ G
        return Quadratic(cost, right, information)

    def _own(self, i: int) -> np.ndarray:
        return np.arange(i * self._nx, (i + 1) * self._nx)

    def _start(self, v: np.ndarray, i: int) -> np.ndarray:
        """Return the initial state of a log."""
        x0 = self._means[i] + self._roots[i] @ v[self._own(i)]
        box = self._logs[i].system.state_box
        return x0 if box is None else box.clipped(x0)  # against rounding

    def _trajectory(self, v: np.ndarray, i: int, length: int) -> Trajectory:
        point = np.r_[self._start(v, i), v[self._n - self._p :]]
        return self._runs[i].along(point, length)

    def result(self, v: np.ndarray) -> ParameterFit:
        """Return the fit at v."""
        lengths = [len(log.record.t) for log in self._logs]
        information, m = self._cost(v, lengths, 0.0).information, self._n - self._p
        # What is left of the information on the parameters if the initial states are unknown
        both = information[m:, :m]
        own = information[m:, m:] - both @ np.linalg.solve(information[:m, :m], both.T)
        paths = [self._trajectory(v, i, length) for i, length in enumerate(lengths)]
        squares = sum(float((path.whitened**2).sum()) for path in paths)
        # An initial state takes as much of the freedom as the outputs tell of it.
        told = np.trace(np.linalg.solve(information[:m, :m], information[:m, :m] - np.eye(m)))
        freedom = max(1.0, self.freedom - float(told))
        starts = tuple(self._start(v, i) for i in range(len(lengths)))
        return ParameterFit(v[m:], own, squares / freedom, starts, tuple(paths))
