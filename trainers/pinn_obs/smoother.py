"""The iterated Kalman smoother, as the guide needs it.

It (Bell, "The iterated Kalman smoother as a Gauss-Newton method", 1994) minimises the squares of
the innovations, of the departure from the prior and of the model's defects from sample to sample,
each over its variance.
"""

from __future__ import annotations

import numpy as np

from pinnobs_gym.estimation import smoother
from pinnobs_gym.estimation.smoother import Filtered, Path, backward
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System, vector

DRIFT = 1e-4
"""Standard deviation of the model's defect from one sample to the next, over the scale."""
_PASSES = 12
_WIDE, _NARROWING = 1e-2, 0.6
_SETTLED = 1e-4


def smooth(system: System, record: Record, noise: np.ndarray, caution: float) -> Path:
    """The iterated Kalman smoother, begun with the estimates of an extended Kalman smoother.

    If its passes do not settle, it begins again with more process noise, which it then takes away
    again pass by pass.

    Args:
        system: the model.
        record: the samples.
        noise: standard deviations of the output noise, shape (ny,), in output units; positive.
        caution: see `pinnobs_gym.estimation.smoother.forward`; of the first pass.
    """
    path = backward(forward(system, record, noise, caution=caution))
    narrowed = _WIDE * _NARROWING ** np.arange(2 * _PASSES)
    for drift in (*[DRIFT] * _PASSES, *np.maximum(narrowed, DRIFT)):
        before = path.xhat
        path = backward(forward(system, record, noise, about=before, drift=drift))
        settled = (abs(path.xhat - before) <= _SETTLED * np.asarray(system.scale)).all()
        if settled and drift == DRIFT:
            break
    return path


def forward(
    system: System,
    record: Record,
    noise: np.ndarray,
    *,
    about: np.ndarray | None = None,
    drift: float = DRIFT,
    caution: float = 0.0,
) -> Filtered:
    """`pinnobs_gym.estimation.smoother.forward`, told standard deviations.

    Args:
        system: the model.
        record: the samples.
        noise: of the output noise, shape (ny,), in output units; positive.
        about: states (num_samples, batch, nx) about which the model is linearised.
        drift: of the process noise per sample, over the scale.
        caution: which part of HPHᵀ is added to the noise.
    """
    Q = np.diag((drift * vector(system.scale, system.nx, "scale")) ** 2)
    R = np.diag(noise**2)
    return smoother.forward(system, record, Q[..., None], R[..., None], about, caution)
