"""The Kalman filters that run by templates: the extended and the strong-tracking, the unscented and
the cubature filter."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pinnobs_gym.estimation.compiled_code import changed_method
from pinnobs_gym.estimation.export.algorithm import Algorithm, own
from pinnobs_gym.simulation.kernels.plant_code import PlantCode
from pinnobs_gym.simulation.kernels.source import filter_parts
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.system import vector

if TYPE_CHECKING:
    from pinnobs_gym.estimation.recursive import RecursiveEstimator

_SIGMA_POINTS = "sigma_points"
EXPORTED = "ekf", _SIGMA_POINTS
"""The templates that exported files have, too."""


def filter_code(estimator: RecursiveEstimator, code: PlantCode, prior: Prior) -> Algorithm:
    """Return the code of a filter whose class names a template.

    Raises:
        ValueError: in one line, if it does something that the template does not.
    """
    cls, system = type(estimator), estimator.system
    if changed := changed_method(cls):
        raise ValueError(f"{cls.__name__} defines {changed}, which exported code does not have")
    if reason := estimator.not_compiled():
        raise ValueError(f"{estimator.label} is not exported: {reason}")
    if cls.template == _SIGMA_POINTS and system.state_box is not None:
        raise ValueError(
            f"{type(system).__name__} has bounds of states, with which {estimator.label} is not "
            "exported; expected ekf"
        )
    if estimator.reset(prior).root is not None:
        raise ValueError(
            "the prior is so wide beside the output noise that exported code would lose its "
            "digits; expected a narrower one"
        )
    nx, ny, settings = system.nx, system.ny, estimator.plan_settings()
    gate = "gate" in settings
    numbers = {"prior_cov": prior.cov[0], "output_noise": estimator.noise.R(0.0)[..., 0]}
    fields = [
        f"@real@ P[{nx * nx}]; /* covariance of the estimates' errors */",
        f"@real@ innovation[{ny}]; /* outputs less their predictions; 0 where missing */",
        f"@real@ S[{ny * ny}]; /* covariance of the innovation */",
    ]
    places: dict[str, str] = dict.fromkeys(("restart", "before", "after"), "")
    if gate:
        fields += [
            f"@real@ P_restart[{nx * nx}]; /* covariance after a restart by the gate */",
            "int32_t beyond; /* samples in a row beyond the gate */",
        ]
        numbers["restart_variance"] = np.square(vector(system.scale, nx, "scale"))
        places = {
            "restart": _RESTART,
            "before": _BEFORE,
            "after": "filter->beyond = (int32_t)memory.carried[0];\n    ",
        }
    elif settings.get("carried"):
        fields.append("@real@ size; /* of the last innovation, e' R^-1 e / NY */")
        places |= {
            "before": "memory.carried[0] = filter->size;\n    ",
            "after": "filter->size = memory.carried[0];\n    ",
        }
    ekf = cls.template != _SIGMA_POINTS
    angles = "angles.c" if ekf and system.state_period is not None else "no_angles.c"
    bounds = "no_bounds.c" if system.state_box is None else "bounds.c"
    lanes = filter_parts(code, cls.template, (own("leaves.c"), own(f"{cls.template}.c")))
    return Algorithm(
        ["#define RESTARTS" if gate else "", *lanes],
        [own(angles), own(bounds), own("between.c"), own("filter.c")],
        numbers,
        fields,
        settings,
        places=places,
        covariance=True,
    )


_RESTART = """memcpy(filter->P_restart, filter->P, sizeof filter->P);
    for (int i = 0; i < NX; i++) filter->P_restart[i * (NX + 1)] += restart_variance[i];
    """
_BEFORE = """memory.carried[0] = filter->beyond;
    memcpy(memory.P_restart, filter->P_restart, sizeof memory.P_restart);
    """
