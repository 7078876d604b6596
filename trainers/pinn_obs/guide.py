"""What guides the fast recipe: where the states most likely were, and a gain that is stable there.

The loss of PINN-Obs alone fixes neither. Estimates whose unmeasured states are wrong can satisfy it
with a gain to suit, and once the innovation has died out any gain does. Both come from the same
samples and the same model by linear algebra: the states from an iterated Kalman smoother, the gain
from the Riccati recursion along them. The network is drawn towards both, which leaves its loss a
single valley, the same from every seed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pinnobs_gym.estimation.smoother import Filtered
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import System
from trainers.pinn_obs.objective import Points
from trainers.pinn_obs.points import on_lines
from trainers.pinn_obs.smoother import forward, smooth

QUIET = 1e-4
"""Least standard deviation of output noise, over the output's scale."""
LEAVING = 0.5
"""Time constant with which x̂ leaves x̂₀ for the smoothed states, over the first interval."""
_CAUTION = 0.2
_CLEAR = 1e-3
"""Least innovation that tells something, over the output's scale."""
_TOLD = 5.0
"""How many times that, or the noise, the first innovation has to be to lead x̂ away at once."""
_LEFT_OVER = 0.3
"""Part of the prior's deviation that the gains after the first interval reckon with."""
_LAYER = 10.0
"""How many time constants long x̂ is taken to be leaving x̂₀."""


@dataclass(frozen=True, eq=False)
class Guide:
    """What the network is drawn towards."""

    xhat: np.ndarray
    """Estimates at the points, shape (num_points, nx)."""
    L: np.ndarray
    """Gains there in state units per s and output unit, shape (num_points, nx, ny)."""
    t: np.ndarray
    """Times in s of the samples that it was made from, shape (num_samples,)."""
    smoothed: np.ndarray
    """The states at these samples, given all of them, shape (num_samples, nx)."""
    P: np.ndarray
    """Their covariances, shape (num_samples, nx, nx)."""


def guide_of(
    system: System,
    samples: Record,
    points: Points,
    noise: np.ndarray,
    y_scale: np.ndarray,
    transfer: bool = False,
) -> Guide | None:
    """The guide of a record of one episode; None if the smoother leaves the finite numbers.

    x̂ has to begin at x̂₀. Where the first innovation tells more than noise, a finite gain can lead
    it away from there at once: it goes to the smoothed states within the first interval, and the
    gain that this takes, good for this record alone, is added to Riccati's. Of noisy outputs that
    is Riccati's from a part of the prior: from the whole it would give away to the noise of the
    next samples what is known by then. Otherwise x̂ has to wait for the outputs to show what is
    wrong, and goes with the filter.

    Args:
        system: the model.
        samples: those samples of the record that the filters see.
        points: where the guide is wanted.
        noise: standard deviations of the output noise, shape (ny,), in output units.
        y_scale: sizes of the outputs, shape (ny,).
        transfer: go with the filter whatever the first innovation tells, so that the gain is
            Riccati's alone.
    """
    known_noise = np.maximum(noise, QUIET * y_scale)
    with np.errstate(all="ignore"):
        path = smooth(system, samples, known_noise, _CAUTION)
        along = forward(system, samples, known_noise, about=path.xhat, caution=_CAUTION)
    if not all(np.isfinite(part).all() for part in (path.xhat, path.P, along.K)):
        return None
    smoothed, P = path.xhat[:, 0], path.P[..., 0]
    t, tau = points.t, LEAVING * (samples.t[1] - samples.t[0])
    first = abs(points.y[0] - system.h(t[0], points.xhat0, points.u[0])) * points.present[0]
    if transfer or not (first > _TOLD * np.maximum(noise, _CLEAR * y_scale)).any():
        L = on_lines(t, samples.t, observer_gain(samples.t, along))
        return Guide(on_lines(t, samples.t, along.xhat[:, 0]), L, samples.t, smoothed, P)
    if noise.any():
        prior = Prior(samples.prior.mean, P[0] + _LEFT_OVER**2 * samples.prior.cov)
        begun = replace(samples, prior=prior)
        along = forward(system, begun, known_noise, about=path.xhat, caution=_CAUTION)
    L = on_lines(t, samples.t, observer_gain(samples.t, along))
    left = np.exp((t[0] - t) / tau)[:, None]
    goal = on_lines(t, samples.t, smoothed)
    xhat = left * points.xhat0 + (1 - left) * goal
    rate = (1 - left) * np.gradient(goal, t, axis=0) + left / tau * (goal - points.xhat0)
    innovation = (points.y - system.h(t, xhat, points.u)) * points.present / y_scale
    residual = rate - system.f(t, xhat, points.u)
    residual -= np.einsum("kij,kj->ki", L, innovation * y_scale)
    floor = max(_CLEAR, float((noise / y_scale).max()))
    share = (innovation / y_scale) / ((innovation**2).sum(-1, keepdims=True) + floor**2)
    inside = (t < t[0] + _LAYER * tau)[:, None, None]
    L = L + inside * residual[:, :, None] * share[:, None, :]
    return Guide(xhat, L, samples.t, smoothed, P)


def observer_gain(t: np.ndarray, filtered: Filtered) -> np.ndarray:
    """Gains L (num_samples, nx, ny) with which an observer, over the interval that ends at a
    sample, takes away as much of that output's innovation as the filter does at the sample."""
    K, H = filtered.K[..., 0], filtered.H[..., 0]
    taken = np.clip(np.einsum("kji,kij->kj", H, K), 1e-9, 1 - 1e-9)
    per_interval = -np.log1p(-taken) / taken
    interval = np.diff(t, prepend=2 * t[0] - t[1])
    return K * (per_interval / interval[:, None])[:, None, :]
