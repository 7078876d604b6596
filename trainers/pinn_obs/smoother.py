"""The iterated Kalman smoother of the guide.

The process noise and the tolerance are chosen so that a network can follow the result; see
`pinnobs_gym.estimation.smoother.iterated`.
"""

from __future__ import annotations

import numpy as np

from pinnobs_gym.estimation import smoother
from pinnobs_gym.estimation.smoother import Filtered, Path
from pinnobs_gym.simulation.noise import Noise
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System, vector

DRIFT = 1e-4
"""Standard deviation of the model's defect from one sample to the next, over the scale."""
_PASSES = 12
_WIDE, _NARROWING = 1e-2, 0.6
_SETTLED = 1e-4


def smooth(system: System, record: Record, noise: np.ndarray, caution: float) -> Path:
    """Run the iterated Kalman smoother, from the estimates of an extended Kalman smoother.

    If the passes do not converge, the process noise is raised and then lowered again pass by pass.

    Args:
        system: the model.
        record: the samples.
        noise: standard deviations of the output noise, shape (ny,), in output units; positive.
        caution: see `pinnobs_gym.estimation.smoother.forward`; it applies to the first pass.
    """
    narrowed = _WIDE * _NARROWING ** np.arange(2 * _PASSES)
    drifts = (*[DRIFT] * (1 + _PASSES), *np.maximum(narrowed, DRIFT))
    noises = {drift: law_of(system, record, noise, drift) for drift in drifts}
    passes = [noises[drift] for drift in drifts]
    return smoother.iterated(system, record, passes, caution=caution, settled=_SETTLED)


def forward(
    system: System,
    record: Record,
    noise: np.ndarray,
    *,
    about: np.ndarray | None = None,
    drift: float = DRIFT,
    caution: float = 0.0,
) -> Filtered:
    """Run `pinnobs_gym.estimation.smoother.forward` with noises given as standard deviations.

    Args:
        system: the model.
        record: the samples.
        noise: standard deviations of the output noise, shape (ny,), in output units; positive.
        about: states (num_samples, batch, nx) of linearisation; the filter's own if None.
        drift: standard deviation of the process noise per sample, over the scale.
        caution: fraction of HPHᵀ that is added to the covariance of the output noise.
    """
    return smoother.forward(system, record, law_of(system, record, noise, drift), about, caution)


def law_of(system: System, record: Record, std: np.ndarray, drift: float) -> Noise:
    """Return the noise with these standard deviations of outputs, and with a drift from one sample
    to the next, on average."""
    step = (record.t[-1] - record.t[0]) / max(1, record.num_samples - 1)
    scale = vector(system.scale, system.nx, "scale")
    return Noise(np.diag(drift / np.sqrt(step or 1.0) * scale), np.diag(std))
