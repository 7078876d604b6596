"""Conformance: named checks that every system and every estimator passes, yours included.

``check_system(VanDerPol)`` and ``check_estimator(MyObserver(system))`` run them all; the tables
`SYSTEM_CHECKS` and `ESTIMATOR_CHECKS` give them by name, for a parametrised test.
"""

from pinnobs_gym.checks.conformance import CheckFailed
from pinnobs_gym.checks.of_estimators import ESTIMATOR_CHECKS, check_estimator
from pinnobs_gym.checks.of_systems import SYSTEM_CHECKS, check_system

__all__ = ["ESTIMATOR_CHECKS", "SYSTEM_CHECKS", "CheckFailed", "check_estimator", "check_system"]
