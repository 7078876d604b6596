"""The probabilities of beliefs that explain simulated episodes best."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pinnobs_gym.estimation.learned.beliefs import Beliefs

FLOOR = -40.0
"""Logarithm of the density below which an episode counts no more: no belief explains it."""
RIDGE = 1e-4
"""Weight of the squares of the logarithms of probabilities in the loss, which thus has one
minimum."""
TOLERANCE = 2e-3
"""Largest increase of the loss, in nats, for which a belief is dropped."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the filters say of simulated episodes, at some of their samples (looks)."""

    outputs: np.ndarray
    """Logarithm of the density of all outputs so far under each hypothesis, shape (looks,
    hypotheses)."""
    states: np.ndarray
    """Logarithm of the density of the true scaled states, shape (looks, hypotheses); 0 if they are
    not used."""
    weight: np.ndarray
    """Weight of each look, shape (looks,)."""

    def of(self, hypotheses: np.ndarray) -> Evidence:
        """Return the evidence on some of the hypotheses, given by their numbers."""
        return Evidence(self.outputs[:, hypotheses], self.states[:, hypotheses], self.weight)

    def loss(
        self, log_prior: np.ndarray, gradient: bool = False
    ) -> tuple[float, np.ndarray | None]:
        """Return the mean negative logarithm of the density of states or, if they are not used, of
        outputs, and its derivatives by the logarithms of the hypotheses' probabilities.

        With w ∝ p₀·p(outputs), the density of the state is Σ w·p(state).
        """
        told = self.outputs + log_prior
        of_outputs = _log_sum(told)
        by_outputs = self.states.any()
        both = told + self.states
        of_both = _log_sum(both)
        value = of_both - of_outputs if by_outputs else of_outputs
        floored = np.logaddexp(value, FLOOR) if by_outputs else value
        scale = self.weight / self.weight.sum()
        loss = -float(scale @ floored)
        if not gradient:
            return loss, None
        share = np.exp(both - of_both[:, None])
        if by_outputs:
            share = (share - np.exp(told - of_outputs[:, None])) * np.exp(value - floored)[:, None]
        return loss, -(scale @ share)


def _log_sum(values: np.ndarray) -> np.ndarray:
    largest = values.max(axis=1, keepdims=True)
    return np.log(np.exp(values - largest).sum(axis=1)) + largest[:, 0]


def fit(beliefs: Beliefs, evidence: Evidence) -> tuple[np.ndarray, float]:
    """Return the probabilities of the beliefs with the least loss, and the loss."""
    from scipy.optimize import minimize

    count = len(beliefs.weight)

    def objective(theta: np.ndarray) -> tuple[float, np.ndarray]:
        log_weight = theta - np.log(np.exp(theta - theta.max()).sum()) - theta.max()
        log_prior = log_weight[beliefs.belief] + np.log(beliefs.share)
        loss, slope = evidence.loss(log_prior, gradient=True)
        assert slope is not None
        by_belief = np.bincount(beliefs.belief, slope, minlength=count)
        by_belief = by_belief - np.exp(log_weight) * by_belief.sum()
        return loss + RIDGE * float(theta @ theta), by_belief + 2 * RIDGE * theta

    found = minimize(objective, np.zeros(count), jac=True, method="L-BFGS-B")
    weight = np.exp(found.x - found.x.max())
    return weight / weight.sum(), float(found.fun)


def chosen(beliefs: Beliefs, evidence: Evidence) -> tuple[Beliefs, np.ndarray]:
    """Return the beliefs without those that hardly change the loss, with their probabilities, and
    the numbers of their hypotheses.

    One after the other is dropped, the least probable first, while the loss increases by less than
    `TOLERANCE` over the least so far.
    """
    weight, loss = fit(beliefs, evidence)
    best, kept = loss, np.arange(len(weight))
    present = beliefs.kept(kept, weight)
    dropped = True
    while dropped and len(kept) > 1:
        dropped = False
        for i in np.argsort(present.weight, kind="stable")[:4]:
            fewer = np.delete(kept, i)
            part = evidence.of(np.flatnonzero(np.isin(beliefs.belief, fewer)))
            tried = beliefs.kept(fewer, np.full(len(fewer), 1 / len(fewer)))
            weight, loss = fit(tried, part)
            if loss < best + TOLERANCE:
                present, kept = beliefs.kept(fewer, weight), fewer
                best, dropped = min(best, loss), True
                break
    return present, np.flatnonzero(np.isin(beliefs.belief, kept))
