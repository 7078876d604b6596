"""The estimators, one file each. Each file in this folder is registered, checked and ranked."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pinnobs_gym.registry import Registry

if TYPE_CHECKING:
    from pinnobs_gym.estimation.estimator import BaseEstimator

ESTIMATORS: Registry[BaseEstimator] = Registry(
    "estimator", "pinnobs_gym.estimation.estimator:BaseEstimator", __name__, "name"
)
"""All estimators by name."""
