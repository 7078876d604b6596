"""The extended Rauch-Tung-Striebel smoother."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pinnobs_gym.estimator import Estimates, OfflineEstimator
from pinnobs_gym.kalman import (
    GaussianEstimator,
    checked,
    divide_factored,
    factor,
    joseph_update,
    observe,
    predict,
    sandwich,
)
from pinnobs_gym.record import Record
from pinnobs_gym.simulate import identity, product


class Filtered(NamedTuple):
    """What a filter leaves on its way forward; in matrices the batch comes last."""

    xhat: np.ndarray
    """Estimates from the outputs so far, shape (batch, nx)."""
    P: np.ndarray
    """Their covariances, shape (nx, nx, batch)."""
    predicted: np.ndarray
    """Predictions of the next state, shape (batch, nx)."""
    F: np.ndarray
    """The flow to the next state, shape (nx, nx, batch)."""
    P_predicted: np.ndarray
    """Covariances of the predictions, shape (nx, nx, batch)."""


@dataclass(frozen=True)
class RTSSmoother(OfflineEstimator, GaussianEstimator):
    """The extended Kalman filter forward, and Rauch, Tung and Striebel's recursion backward, which
    gives each state from all outputs (Särkkä 2013, section 9.1).

    With C = PFᵀ(P⁻)⁻¹: x̂ₛ = x̂ + C(x̂ₛ' − x⁻') and, positive semidefinite in every term,
    Pₛ = (I − CF)P(I − CF)ᵀ + C(Pₛ' + Q)Cᵀ, primes marking the next sample. It takes the filter's
    linearisation: where that locked on wrongly, so does it. Without process noise P⁻ of a plant
    that contracts becomes singular, and the way back rounds; least squares do not.

    Default tuning, the same rule for all systems: P₀ from the prior, R from the noise level it is
    told (`Estimator.output_variance`), Q = (`process_noise`·scale)².
    """

    name = "rts_smoother"

    def run(self, record: Record) -> Estimates:
        with np.errstate(all="ignore"):  # rows that diverge are marked by what they then hold
            forward = self._forward(record)
            Q, _ = self.tuning()
            xhat, P = forward[-1].xhat, forward[-1].P
            means, covariances = [xhat], [P]
            for now in reversed(forward[:-1]):
                L, _ = factor(now.P_predicted, np.zeros(record.batch))
                C = divide_factored(product(now.P, now.F.transpose(1, 0, 2)), L)
                xhat = now.xhat + np.einsum("ijb,bj->bi", C, xhat - now.predicted)
                P = sandwich(identity(len(P)) - product(C, now.F), now.P) + sandwich(C, P + Q)
                P = (P + P.transpose(1, 0, 2)) / 2
                means.insert(0, xhat)
                covariances.insert(0, P)
        return Estimates(np.stack(means, axis=1), np.stack(covariances).transpose(3, 0, 1, 2))

    def _forward(self, record: Record) -> list[Filtered]:
        """The filter at every sample."""
        Q, R = self.tuning()
        prior = checked(record.prior)
        xhat, P = prior.mean, prior.cov.transpose(1, 2, 0)
        samples = []
        for k, t in enumerate(record.t):
            innovation, H = observe(self.system, xhat, record.y[:, k])
            xhat, P, _ = joseph_update(xhat, P, innovation, H, R)
            predicted, F, P_predicted = xhat, P, P
            if k + 1 < record.num_samples:
                times, inputs = (t, record.t[k + 1]), (record.u[:, k], record.u[:, k + 1])
                predicted, P_predicted, F = predict(self.system, times, xhat, P, Q, inputs)
            samples.append(Filtered(xhat, P, predicted, F, P_predicted))
            xhat, P = predicted, P_predicted
        return samples
