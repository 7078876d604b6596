"""The estimators, one file each. A file put here is found, checked and ranked."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pinnobs_gym.registry import Registry

if TYPE_CHECKING:
    from pinnobs_gym.estimation.estimator import Estimator

ESTIMATORS: Registry[Estimator] = Registry(
    "estimator", "pinnobs_gym.estimation.estimator:Estimator", __name__, "name"
)
"""All estimators by name."""
