"""The Luenberger observer, its gain as constants."""

from __future__ import annotations

from typing import Any

from pinnobs_gym.estimators.luenberger import Luenberger
from pinnobs_gym.export.algorithm import Algorithm, model_parts, own
from pinnobs_gym.simulation.kernels.plant_code import PlantCode
from pinnobs_gym.simulation.record import Prior


def algorithm(estimator: Any, code: PlantCode, prior: Prior) -> Algorithm | None:
    """Return the code of the observer."""
    if type(estimator) is not Luenberger:
        return None
    ny = estimator.system.ny
    fields = (
        f"@real@ innovation[{ny}]; /* outputs less their predictions; 0 where missing */",
        f"double last[{ny}]; /* time of each output's last sample */",
    )
    texts = own("solve.c"), own("between.c"), own("luenberger.c")
    return Algorithm(model_parts(code), texts, {"gain": estimator.designed()}, fields)
