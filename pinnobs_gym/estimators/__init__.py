"""The estimators, one file each. A file put here is found, checked and ranked."""

from pinnobs_gym.estimator import Estimator
from pinnobs_gym.registry import Registry

ESTIMATORS: Registry[Estimator] = Registry("estimator", Estimator, __name__, "trainers")
"""All estimators by name; those that train on the record they are given stand beside their
trainer."""
