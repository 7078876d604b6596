"""The Cramér–Rao reference of an episode, a limit of estimation accuracy."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from pinnobs_gym.estimation.kalman import joseph_update
from pinnobs_gym.scoring.metrics import by_sample, window_nrmse, windows
from pinnobs_gym.simulation.matrices import sandwich
from pinnobs_gym.simulation.model import model_step, model_step_moments
from pinnobs_gym.simulation.noise import Noise, noise_std
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System

if TYPE_CHECKING:
    from pinnobs_gym.envs.game import Game


Step: TypeAlias = tuple[np.ndarray | None, np.ndarray, np.ndarray, np.ndarray]
"""The Jacobian F (n, n, batch) of the step to a sample and the covariance Q (n, n, batch or 1) of
its process noise, None and zero at the first; the Jacobian H (ny, n, batch) of the outputs and the
covariance R (ny, ny, batch or 1) of their noise."""


def cramer_rao(
    system: System,
    t: np.ndarray,
    x: np.ndarray,
    P0: np.ndarray,
    noise: Noise,
    missing: np.ndarray | None = None,
    u: np.ndarray | None = None,
) -> np.ndarray:
    """Return the Cramér–Rao reference of each episode: the lower bound on the covariance of any
    locally unbiased estimate x̂(k|k) of this trajectory.

    With Φ the product of the Jacobians F of the steps from t₀ to t_k at the true states, and no
    process noise, it is Φ(P₀⁻¹ + ΣΦᵀHᵀR⁻¹HΦ)⁻¹Φᵀ. It is computed by the recursion P⁻ = FPFᵀ + Q, P
    = P⁻ − P⁻Hᵀ(HP⁻Hᵀ + R)⁻¹HP⁻ (Taylor 1979; Tichavský, Muravchik & Nehorai 1998 for Q > 0).
    Estimates that use the prior are not unbiased and may be below it: compare root mean squares
    over many episodes, not single ones.

    Args:
        system: the plant.
        t: sample times in s, shape (num_samples,).
        x: true states, shape (batch, num_samples, nx).
        P0: covariance of the prior, shape (nx, nx).
        noise: the noise of plant and outputs.
        missing: which outputs are missing, bool (batch, num_samples, ny); none if None.
        u: inputs at the samples, shape (batch, num_samples, nu); those of `System.input` if None.

    Returns:
        Covariances, shape (batch, num_samples, nx, nx).
    """
    batch, num_samples, nx = x.shape
    bound = np.empty((num_samples, nx, nx, batch))
    steps = _linearised(system, noise, t, x, _inputs(system, t, u), missing)
    for k, P in enumerate(covariances(steps, P0)):
        bound[k] = P
    return bound.transpose(3, 0, 1, 2)


def covariances(
    steps: Iterable[Step],
    P0: np.ndarray,
) -> Iterator[np.ndarray]:
    """Yield the covariances P (n, n, batch) after each sample: P⁻ = FPFᵀ + Q, then P = P⁻ −
    P⁻Hᵀ(HP⁻Hᵀ + R)⁻¹HP⁻, in Joseph's form.

    Args:
        steps: one for each sample.
        P0: covariance of the prior, shape (n, n).
    """
    P = P0[..., None]
    for F, Q, H, R in steps:
        if F is not None:
            P = sandwich(F, P) + Q
        ny, n, batch = H.shape
        P = np.broadcast_to(P, (n, n, batch))
        # The covariance does not depend on the estimate and the innovation.
        _, P, _ = joseph_update(np.zeros((batch, n)), P, np.zeros((batch, ny)), H, R)
        yield P


def _linearised(
    system: System,
    noise: Noise,
    t: np.ndarray,
    x: np.ndarray,
    u: np.ndarray,
    missing: np.ndarray | None,
) -> Iterator[Step]:
    """Yield the steps of `covariances`, linearised at the true states; the arguments are those of
    `cramer_rao`."""
    F, Q = None, np.zeros((system.nx, system.nx, 1))
    for k in range(len(t)):
        now = x[:, k]
        if k:
            times, inputs = (float(t[k - 1]), float(t[k])), (u[:, k - 1], u[:, k])
            _, F, Q = model_step_moments(system, noise, *times, x[:, k - 1], *inputs)
        H = system.h_jacobian(t[k], now, u[:, k]).transpose(1, 2, 0)
        R = noise.R(float(t[k]))
        if missing is not None:
            # A zero row of H carries no information.
            H = np.where(missing[:, k].T[:, None], 0.0, H)
            R = noise.R(float(t[k]), np.where(missing[:, k], np.nan, 0.0))
        yield F, Q, H, R


def expected_nrmse(
    P: np.ndarray, scale: Sequence[float], part: slice, scored: np.ndarray | None = None
) -> np.ndarray:
    """Return the NRMSE over a window, (batch,), that is expected of errors with covariances P: the
    root of its mean square.

    Args:
        P: covariances, shape (batch, num_samples, nx, nx).
        scale: scale of the errors, one number per state.
        part: the samples of the window.
        scored: which errors count, bool, shape (batch, num_samples, nx); all if None.
    """
    variance = np.einsum("bkii->bki", P) / np.square(scale)
    counts = np.ones(variance.shape, dtype=bool) if scored is None else scored
    return window_nrmse(np.where(counts, variance, 0.0).sum(axis=-1), counts.sum(axis=-1), part)


def _inputs(system: System, t: np.ndarray, u: np.ndarray | None) -> np.ndarray:
    """Return u or, if it is None, the system's inputs at the samples, (1, num_samples, nu)."""
    return np.asarray(system.input(t))[None] if u is None else u


def step_error(
    system: System, t: np.ndarray, x: np.ndarray, u: np.ndarray | None = None
) -> np.ndarray:
    """Return the error of one step of the model from the true state, shape (batch, num_samples,
    nx), zero at the first sample.

    `cramer_rao` assumes exact steps. Without process noise the reference of a contracting plant
    decreases without limit; below this error it is no bound for any estimate.

    Args:
        system: the plant.
        t: sample times in s, shape (num_samples,).
        x: true states without process noise, shape (batch, num_samples, nx).
        u: inputs, as in `cramer_rao`.
    """
    error, u = np.zeros_like(x), _inputs(system, t, u)
    for k in range(1, len(t)):
        times, inputs = (float(t[k - 1]), float(t[k])), (u[:, k - 1], u[:, k])
        end = model_step(system, *times, x[:, k - 1], *inputs)
        error[:, k] = system.state_residual(end, x[:, k])
    return error


@dataclass(frozen=True)
class Reference:
    """The errors expected at the Cramér-Rao reference, for a batch of episodes."""

    steady: np.ndarray
    """NRMSE of the steady window, shape (batch,); NaN where it is below the error of a single step
    of the model."""
    by_sample: np.ndarray
    """NRMSE of each sample, shape (batch, num_samples)."""


def reference(game: Game, record: Record, truth: np.ndarray) -> Reference | None:
    """Return the Cramér-Rao reference of a game's episodes as scores.

    Args:
        game: what is played.
        record: the record of the episodes that estimators are given.
        truth: true states at its samples, shape (batch, num_samples, nx).

    Returns:
        The reference; None without output noise, from a fixed initial state, or under a condition
        that is not in the model (`Condition.reference`).
    """
    source = game.source
    std = noise_std(source.setup.noise_std, source.system.ny, "noise_std")
    if not source.condition.reference or source.fixed_x0 or not (std > 0).all():
        return None
    P0 = record.prior.cov[0]
    missing = np.isnan(record.y)
    P = cramer_rao(source.system, record.t, truth, P0, source.noise, missing, record.u)
    counted = (source.system.scale, source.system.observable(truth))
    part = windows(record.t, source.setup.transient_end)["steady"]
    steady = expected_nrmse(P, source.system.scale, part, counted[1])
    if not source.noise.stochastic:
        # Discard references below the error of the model's own step.
        error = step_error(source.system, record.t, truth, record.u)
        squares = error[..., None] * error[..., None, :]
        floor = expected_nrmse(squares, source.system.scale, part, counted[1])
        steady = np.where(steady > floor, steady, np.nan)
    return Reference(steady, by_sample(np.sqrt(np.einsum("bkii->bki", P)), *counted))
