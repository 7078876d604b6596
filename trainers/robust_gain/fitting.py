"""The probabilities of beliefs that explain simulated episodes best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pinnobs_gym.estimation.learned.beliefs import SMALL_NOISE, Beliefs

FLOOR = -8.0
"""Logarithm of the density, over that of the best filter in hindsight, below which it counts no
more: few looks at which all likely filters are wrong would outweigh all others."""
RIDGE = 1e-4
"""Weight of the squares of the logarithms of probabilities in the loss, which thus has one
minimum."""
CAUTION = 0.02
"""Part of the probability that all kinds of beliefs share equally, whatever the episodes say: one
that explained none of them may be needed."""
SCARCE = 0.1
"""Factor of the probabilities that the plant deviates from the model. Where outputs tell such a
deviation, a thousand samples outweigh any probability beforehand; where they cannot tell it from
an error of the state, its filters stay in the mixture for good, with errors many times as large."""
_TINY = 1e-300


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
        """Return the mean negative logarithm of the density of states, over that of the best filter
        in hindsight, or, if states are not used, of the density of outputs; and its derivatives by
        the logarithms of the hypotheses' probabilities.

        With w ∝ p₀·p(outputs), the density of the state is Σ w·p(state).
        """
        told = self.outputs + log_prior
        of_outputs = _log_sum(told)
        by_states = self.states.any()
        both = told + self.states
        of_both = _log_sum(both)
        best = self.states.max(axis=1)
        value = of_both - of_outputs - best if by_states else of_outputs
        floored = np.logaddexp(value, FLOOR) if by_states else value
        scale = self.weight / self.weight.sum()
        loss = -float(scale @ floored)
        if not gradient:
            return loss, None
        share = np.exp(both - of_both[:, None])
        if by_states:
            share = (share - np.exp(told - of_outputs[:, None])) * np.exp(value - floored)[:, None]
        return loss, -(scale @ share)


def joined(parts: Sequence[Evidence]) -> Evidence:
    """Return the looks of several pieces of evidence together."""
    return Evidence(
        np.concatenate([each.outputs for each in parts]),
        np.concatenate([each.states for each in parts]),
        np.concatenate([each.weight for each in parts]),
    )


def _log_sum(values: np.ndarray) -> np.ndarray:
    largest = values.max(axis=1, keepdims=True)
    return np.log(np.exp(values - largest).sum(axis=1)) + largest[:, 0]


def fit(beliefs: Beliefs, evidence: Evidence) -> np.ndarray:
    """Return the probabilities of the beliefs with the least loss.

    Outliers are independent of all else: beliefs come in pairs of a kind, without and with them.
    """
    from scipy.optimize import minimize

    kinds = len(beliefs.weight) // 2

    def probabilities(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        kind = np.exp(theta[:-1] - theta[:-1].max())
        outliers = 1 / (1 + np.exp(-theta[-1]))
        return kind / kind.sum(), np.array([1 - outliers, outliers])

    def objective(theta: np.ndarray) -> tuple[float, np.ndarray]:
        kind, outliers = probabilities(theta)
        log_weight = np.log(kind[:, None] * outliers + _TINY).ravel()
        loss, slope = evidence.loss(log_weight[beliefs.belief] + np.log(beliefs.share), True)
        assert slope is not None
        by_belief = np.bincount(beliefs.belief, slope, minlength=2 * kinds).reshape(kinds, 2)
        by_kind = by_belief.sum(axis=1) - kind * by_belief.sum()
        by_outliers = by_belief.sum(axis=0) @ (np.array([0.0, 1.0]) - outliers[1])
        gradient = np.append(by_kind, by_outliers)
        return loss + RIDGE * float(theta @ theta), gradient + 2 * RIDGE * theta

    found = minimize(objective, np.zeros(kinds + 1), jac=True, method="L-BFGS-B").x
    kind, outliers = probabilities(found)
    # No probability is nearly zero, whatever the episodes say.
    kind = (1 - CAUTION) * kind + CAUTION / kinds
    kind = np.where(beliefs.deviation[::2] > 0, SCARCE * kind, kind)
    # The prior that will be told may be better than the set of the training, or worse.
    right = (beliefs.deviation == 0) & (beliefs.assumed_noise <= SMALL_NOISE) & ~beliefs.wide
    if right.any():
        kind[right[::2]] = kind[right[::2]].mean()
    kind = kind / kind.sum()
    outliers = (1 - CAUTION) * outliers + CAUTION / 2
    return (kind[:, None] * outliers).ravel()
