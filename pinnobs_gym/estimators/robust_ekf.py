"""The extended Kalman filter with a gate and Huber's weights."""

from __future__ import annotations

from dataclasses import dataclass

from pinnobs_gym.estimators.ekf import EKF


@dataclass(frozen=True)
class RobustEKF(EKF):
    """The extended Kalman filter (`pinnobs_gym.estimators.ekf.EKF`) with `gate` and `huber` in use.

    The gate recovers the filter from estimates that are wrong by more than P says (Bar-Shalom, Li &
    Kirubarajan 2001, section 5.4), and Huber's weights bound the influence of a single output
    (Huber 1964; Karlgaard & Schaub 2007).

    Default tuning is the same rule for all systems: P₀ is that of the prior, the noise is the known
    one with `assumed_noise` added, and the settings are the defaults below.

    When to choose it: where outputs have outliers, or the filter has to recover from a state that
    jumped or from a first guess that is wrong by more than P says.
    """

    gate: float | None = 0.9999
    """As in `EKF`. A consistent filter has one sample in 10,000 beyond it."""
    huber: float | None = 1.345
    """As in `EKF`. The value is 95 % efficient on Gaussian noise."""

    name = "robust_ekf"
