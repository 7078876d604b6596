"""The iterated Kalman smoother, as the guide needs it.

Its process noise and settling are those that make a network follow; see
`pinnobs_gym.estimation.smoother.iterated`.
"""

from __future__ import annotations

import numpy as np

from pinnobs_gym.estimation import smoother
from pinnobs_gym.estimation.smoother import Filtered, Path
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
    narrowed = _WIDE * _NARROWING ** np.arange(2 * _PASSES)
    drifts = (*[DRIFT] * (1 + _PASSES), *np.maximum(narrowed, DRIFT))
    Q = [_process_noise(system, drift) for drift in drifts]
    R = np.diag(noise**2)[..., None]
    return smoother.iterated(system, record, Q, R, caution=caution, settled=_SETTLED)


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
    Q, R = _process_noise(system, drift), np.diag(noise**2)[..., None]
    return smoother.forward(system, record, Q, R, about, caution)


def _process_noise(system: System, drift: float) -> np.ndarray:
    """Q, (nx, nx, 1)."""
    return np.diag((drift * vector(system.scale, system.nx, "scale")) ** 2)[..., None]
