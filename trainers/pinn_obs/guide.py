"""The guide of the fast recipe: the most probable states of a record, and a stable gain along them.

The loss of PINN-Obs alone determines neither. Estimates whose unmeasured states are wrong can
satisfy it with a suitable gain, and where the innovation is zero, any gain satisfies it. The guide
is computed from the same samples and the same model: the states by an iterated Kalman smoother, the
gain by the Riccati recursion along them. A penalty draws the network towards both, so that
trainings from different seeds reach the same minimum.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from pinnobs_gym.estimation.smoother import Filtered, Path
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import System
from trainers.pinn_obs.objective import Points
from trainers.pinn_obs.points import on_lines
from trainers.pinn_obs.smoother import forward, smooth

PathT = TypeVar("PathT", bound=Path)

QUIET = 1e-4
"""Least standard deviation of output noise, over the output's scale."""
LEAVING = 0.5
"""Time constant with which x̂ leaves x̂₀ for the smoothed states, over the first interval."""
CAUTION = 0.2
"""Fraction of HPHᵀ that is added to the output noise of the filters."""
_CLEAR = 1e-3
"""Least significant innovation, over the output's scale."""
_SIGNIFICANT = 5.0
"""Factor of that, or of the noise, above which the first innovation is significant."""
_LEFT_OVER = 0.3
"""Fraction of the prior's standard deviation that is left after the first interval."""
_LAYER = 10.0
"""Duration of the initial layer, in which x̂ leaves x̂₀, in time constants."""


@dataclass(frozen=True, eq=False)
class Guide:
    """Targets of the network's estimates and gains."""

    xhat: np.ndarray
    """Estimates at the points, shape (num_points, nx)."""
    L: np.ndarray
    """Gains at the points, in state units per s and output unit, shape (num_points, nx, ny)."""
    t: np.ndarray
    """Times in s of the samples of the smoother, shape (num_samples,)."""
    smoothed: np.ndarray
    """Smoothed states at these samples, shape (num_samples, nx)."""
    P: np.ndarray
    """Covariances of the smoothed states, shape (num_samples, nx, nx)."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """What filters and smoothers find of the samples of a batch of records."""

    path: Path
    """The smoothed states and their covariances."""
    along: Filtered
    """A filter linearised about them."""
    partly: Filtered | None
    """The same from a part of the prior's covariance; None if that was not asked for."""

    @property
    def finite(self) -> bool:
        """Whether all of it is finite."""
        parts = (self.path.xhat, self.path.P, self.along.K)
        return all(np.isfinite(part).all() for part in parts)

    def row(self, row: int) -> Tracks:
        """Return those of one record."""

        def of(path: PathT) -> PathT:
            parts = {}
            for name, part in vars(path).items():
                if isinstance(part, Path):
                    parts[name] = of(part)
                else:
                    at = (slice(None), [row]) if name == "xhat" else (..., [row])
                    parts[name] = part[at]
            return replace(path, **parts)

        return Tracks(of(self.path), of(self.along), self.partly and of(self.partly))


def least_noise(noise: np.ndarray, y_scale: np.ndarray) -> np.ndarray:
    """Return the standard deviations (ny,) of the output noise that the filters are told, given the
    known ones and the scales of the outputs, (ny,) each."""
    return np.maximum(noise, QUIET * y_scale)


def tracks_of(system: System, samples: Record, told: np.ndarray, again: bool) -> Tracks:
    """Run the filters and the smoother of the guide on the samples of a batch of records at once.

    Args:
        system: the model.
        samples: the samples of the records.
        told: see `least_noise`; the same for all records.
        again: whether to run a filter from a part of the prior, too.
    """
    with np.errstate(all="ignore"):
        path, partly = smooth(system, samples, told, CAUTION), None
        along = forward(system, samples, told, about=path.xhat, caution=CAUTION)
        if again:
            cov = path.P[0].transpose(2, 0, 1) + _LEFT_OVER**2 * samples.prior.cov
            finite = np.isfinite(cov).all(axis=(1, 2), keepdims=True)  # others have no guide
            cov = np.where(finite, cov, samples.prior.cov)
            part = replace(samples, prior=Prior(samples.prior.mean, cov))
            partly = forward(system, part, told, about=path.xhat, caution=CAUTION)
    return Tracks(path, along, partly)


def guide_of(
    system: System,
    samples: Record,
    points: Points,
    noise: np.ndarray,
    y_scale: np.ndarray,
    transfer: bool = False,
    tracks: Tracks | None = None,
) -> Guide | None:
    """Compute the guide of a record of one episode; None if the smoother does not stay finite.

    x̂ has to begin at x̂₀. If the first innovation is significant, a finite gain can move x̂ at once.
    Then x̂ goes to the smoothed states within the first interval, and the gain that this takes,
    valid for this record alone, is added to the Riccati gain. With noisy outputs the Riccati
    recursion begins with a part of the prior's covariance, because with all of it the gain would
    follow the noise of the next samples. If the first innovation is not significant, x̂ is the
    filter's estimate.

    Args:
        system: the model.
        samples: the samples of the record that the filters use.
        points: the points of the guide.
        noise: standard deviations of the output noise, shape (ny,), in output units.
        y_scale: scales of the outputs, shape (ny,).
        transfer: use the filter's estimate in any case, so that the gain is the Riccati gain alone.
        tracks: see `tracks_of`, of this record; computed if None.
    """
    # Smoothed states, and a filter linearised about them for the Riccati gain.
    if tracks is None:
        again = bool(noise.any()) and not transfer
        tracks = tracks_of(system, samples, least_noise(noise, y_scale), again)
    if not tracks.finite:
        return None
    smoothed, P, along = tracks.path.xhat[:, 0], tracks.path.P[..., 0], tracks.along
    t, tau = points.t, LEAVING * (samples.t[1] - samples.t[0])
    first = system.output_residual(points.y[0], system.h(t[0], points.xhat0, points.u[0]))
    first = abs(first) * points.present[0]
    if transfer or not (first > _SIGNIFICANT * np.maximum(noise, _CLEAR * y_scale)).any():
        L = on_lines(t, samples.t, observer_gain(samples.t, along))
        return Guide(on_lines(t, samples.t, along.xhat[:, 0]), L, samples.t, smoothed, P)
    along = tracks.partly or along  # the Riccati recursion from a part of the prior
    L = on_lines(t, samples.t, observer_gain(samples.t, along))
    # x̂ moves exponentially from x̂₀ to the smoothed states.
    decay = np.exp((t[0] - t) / tau)[:, None]
    target = on_lines(t, samples.t, smoothed)
    xhat = decay * points.xhat0 + (1 - decay) * target
    rate = (1 - decay) * np.gradient(target, t, axis=0) + decay / tau * (target - points.xhat0)
    # In the initial layer add the gain of least norm that cancels the residual, regularised.
    innovation = system.output_residual(points.y, system.h(t, xhat, points.u))
    innovation = innovation * points.present / y_scale
    residual = rate - system.f(t, xhat, points.u)
    residual -= np.einsum("kij,kj->ki", L, innovation * y_scale)
    floor = max(_CLEAR, float((noise / y_scale).max()))
    share = (innovation / y_scale) / ((innovation**2).sum(-1, keepdims=True) + floor**2)
    inside = (t < t[0] + _LAYER * tau)[:, None, None]
    L = L + inside * residual[:, :, None] * share[:, None, :]
    return Guide(xhat, L, samples.t, smoothed, P)


def observer_gain(t: np.ndarray, filtered: Filtered) -> np.ndarray:
    """Convert Kalman gains to continuous-time observer gains L (num_samples, nx, ny).

    Over the interval that ends at a sample, the observer reduces each output's innovation by the
    same factor as the filter does at the sample.
    """
    # Factor 1 − HK per sample, that is, the rate −log(1 − HK) over the interval.
    K, H = filtered.K[..., 0], filtered.H[..., 0]
    taken = np.clip(np.einsum("kji,kij->kj", H, K), 1e-9, 1 - 1e-9)
    per_interval = -np.log1p(-taken) / taken
    interval = np.diff(t, prepend=2 * t[0] - t[1])
    return K * (per_interval / interval[:, None])[:, None, :]
