"""The extended Rauch-Tung-Striebel smoother."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pinnobs_gym.estimation.estimator import Estimates, OfflineEstimator
from pinnobs_gym.estimation.gaussian import GaussianEstimator, checked
from pinnobs_gym.estimation.smoother import backward, forward
from pinnobs_gym.simulation.record import Record


@dataclass(frozen=True)
class RTSSmoother(OfflineEstimator, GaussianEstimator):
    """The extended Kalman filter, followed by the backward recursion of Rauch, Tung and Striebel,
    which estimates each state from all outputs (Särkkä 2013, section 9.1).

    The smoother uses the filter's linearisation. Where the filter converges to a wrong trajectory,
    the smoother does, too. Without process noise, P⁻ of a contracting plant becomes singular, and
    the backward recursion loses accuracy to rounding; least squares (`BatchLeastSquares`) do not.

    Default tuning is the same rule for all systems: P₀ is that of the prior, and the noise is
    the known one with `assumed_noise` added.
    """

    name = "rts_smoother"
    exempt_from = {
        name: OfflineEstimator.exempt_from[name] for name in ("causality", "run_equals_updates")
    }
    equations = r"""
C_k &= P_k F_k^\top (P_{k+1}^-)^{-1} \\
\hat x_k^s &= \hat x_k + C_k (\hat x_{k+1}^s - \hat x_{k+1}^-) \\
P_k^s &= (I - C_k F_k)\, P_k (I - C_k F_k)^\top + C_k (P_{k+1}^s + Q)\, C_k^\top
"""

    def run(self, record: Record) -> Estimates:
        record = replace(record, prior=checked(record.prior))
        with np.errstate(all="ignore"):  # diverged rows are marked by their non-finite values
            path = backward(forward(self.system, record, self.noise))
        return Estimates(path.xhat.swapaxes(0, 1), path.P.transpose(3, 0, 1, 2))
