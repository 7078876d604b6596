"""Kinds of estimators, by what they declare."""

from pinnobs_gym.estimators import ESTIMATORS

FEW = {"particle": {"particles": 100}, "enkf": {"members": 20}}
"""Options of estimators that draw samples, for checks of rules that few keep to as well."""


def untrained():
    """Names of those that need no trainer, neither beforehand nor on every record."""
    return [
        name
        for name, cls in ESTIMATORS.classes().items()
        if cls.needs_training is None and cls.trains_on_record is None
    ]


def trained():
    """Names of the others."""
    return sorted(set(ESTIMATORS.classes()) - set(untrained()))
