"""The estimators, one file each. Each file in this folder is registered, checked and ranked."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pinnobs_gym.registry import Registry

if TYPE_CHECKING:
    from pinnobs_gym.estimation.estimator import BaseEstimator

PREFIX, SUFFIX = "policy:", ".zip"
"""Beginning and end of what stands for the file of a model of Stable-Baselines3."""


def policy_file(spec: str) -> Path | None:
    """Return the file of a model that ``policy:FILE.zip`` stands for; None for other names."""
    if not (spec.startswith(PREFIX) and spec.endswith(SUFFIX)):
        return None
    return Path(spec.removeprefix(PREFIX))


class Estimators(Registry["BaseEstimator"]):
    """The estimators by name. A model in a file that can hold code has no name here: it is loaded
    by ``pinnobs evaluate`` alone, which says so first."""

    def resolve(
        self, spec: str | type[BaseEstimator], near: type | None = None
    ) -> type[BaseEstimator]:
        if isinstance(spec, str) and policy_file(spec) is not None:
            raise ValueError(
                f"{spec}: files of Stable-Baselines3 can hold code and are loaded by pinnobs "
                "evaluate alone; in Python, load the model and pass it"
            )
        return super().resolve(spec, near)


ESTIMATORS: Registry[BaseEstimator] = Estimators(
    "estimator", "pinnobs_gym.estimation.estimator:BaseEstimator", __name__, "name"
)
"""All estimators by name."""
