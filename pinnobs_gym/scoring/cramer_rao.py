"""How well an episode can be estimated at all: the Cramér–Rao reference, and exact Bayes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.kalman import joseph_update, predict
from pinnobs_gym.scoring.metrics import by_sample, window
from pinnobs_gym.simulation.model import model_step
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import Setup, System, vector


def cramer_rao(
    system: System,
    t: np.ndarray,
    x: np.ndarray,
    P0: np.ndarray,
    R: np.ndarray,
    Q: np.ndarray | None = None,
    missing: np.ndarray | None = None,
) -> np.ndarray:
    """The Cramér–Rao reference of each episode: covariances that no locally unbiased estimate
    x̂(k|k) of this trajectory goes below.

    With Φ the product of the Jacobians F of the steps from t₀ to t_k at the true states, and no
    process noise, it is Φ(P₀⁻¹ + ΣΦᵀHᵀR⁻¹HΦ)⁻¹Φᵀ, here by the recursion P⁻ = FPFᵀ + Q,
    P = P⁻ − P⁻Hᵀ(HP⁻Hᵀ + R)⁻¹HP⁻ (Taylor 1979; Tichavský, Muravchik & Nehorai 1998 for Q > 0).
    Estimates that know the prior are not unbiased and may fall below it: compare medians over many
    episodes, not single ones.

    Args:
        system: the plant.
        t: sample times in s, shape (num_samples,).
        x: true states, shape (batch, num_samples, nx).
        P0: covariance of the prior, shape (nx, nx).
        R: covariance of the output noise, shape (ny, ny).
        Q: covariance of the process noise per sample, shape (nx, nx); none if None.
        missing: which outputs are missing, bool (batch, num_samples, ny); none if None.

    Returns:
        Covariances, shape (batch, num_samples, nx, nx).
    """
    batch, num_samples, nx = x.shape
    P = np.repeat(P0[..., None], batch, axis=-1)
    noise = np.zeros((nx, nx)) if Q is None else Q
    bound = np.empty((num_samples, nx, nx, batch))
    u = system.input(t)
    for k in range(num_samples):
        now = x[:, k]
        if k:
            times, inputs = (float(t[k - 1]), float(t[k])), (u[k - 1 : k], u[k : k + 1])
            _, P, _ = predict(system, times, x[:, k - 1], P, noise[..., None], inputs)
        H = system.h_jacobian(t[k], now, u[k]).transpose(1, 2, 0)
        if missing is not None:
            H = np.where(missing[:, k].T[:, None], 0.0, H)
        innovation = np.zeros((batch, system.ny))
        _, P, _ = joseph_update(now, P, innovation, H, R[..., None])
        bound[k] = P
    return bound.transpose(3, 0, 1, 2)


def expected_scores(
    P: np.ndarray, scale: Sequence[float], scored: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """The root mean squares over scale, (batch,) each, that errors of covariances P have:
    ``nrmse``, ``nrmse_75`` and ``nrmse_tail``, to compare with those of `metrics.error_scores`.

    Args:
        P: covariances, shape (batch, num_samples, nx, nx).
        scale: what errors are divided by, one number per state.
        scored: which errors count, bool, shape (batch, num_samples, nx); all if None.
    """
    variance = np.einsum("bkii->bki", P) / np.square(scale)
    counts = np.ones(variance.shape, dtype=bool) if scored is None else scored
    total, number = np.where(counts, variance, 0.0).sum(axis=-1), counts.sum(axis=-1)
    parts = {"nrmse": 1.0, "nrmse_75": 0.75, "nrmse_tail": 0.25}
    return {name: window(total, number, part) for name, part in parts.items()}


def step_error(system: System, t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """What one step of the model from the true state errs by, shape (batch, num_samples, nx), zero
    at the first sample.

    `cramer_rao` supposes that steps are exact. Without process noise the reference of a plant that
    forgets its past falls without end; below this error it says nothing of any estimate.

    Args:
        system: the plant.
        t: sample times in s, shape (num_samples,).
        x: true states without process noise, shape (batch, num_samples, nx).
    """
    error, u = np.zeros_like(x), system.input(t)
    for k in range(1, len(t)):
        times, inputs = (float(t[k - 1]), float(t[k])), (u[k - 1 : k], u[k : k + 1])
        error[:, k] = model_step(system, *times, x[:, k - 1], *inputs) - x[:, k]
    return error


@dataclass(frozen=True)
class Posterior:
    """What the outputs up to each sample say of the state then."""

    mean: np.ndarray
    """Means, shape (batch, num_samples, nx): no estimate has a smaller mean squared error."""
    cov: np.ndarray
    """Covariances, shape (batch, num_samples, nx, nx)."""
    ess: np.ndarray
    """Effective number of weighted draws behind them, shape (batch, num_samples)."""


def exact_bayes(
    system: System,
    setup: Setup,
    record: Record,
    R: np.ndarray,
    draws: int = 2000,
    seed: int = 0,
) -> Posterior:
    """The posterior of the state from outputs of a plant without process noise, by importance
    sampling of x₀, which is uniform in the setup's set.

    Draws from the prior serve the first sample. For samples up to twice as many, new ones come from
    a Student distribution with 5 degrees of freedom about those before, weighted by the likelihood
    of all outputs so far over their density (population Monte Carlo, Cappé et al. 2004). Whether
    there were enough, `Posterior.ess` tells.

    Args:
        system: the plant.
        setup: where its initial states come from.
        record: the episodes.
        R: variances of the output noise, shape (ny,).
        draws: how many initial states at a time.
        seed: of the draws.
    """
    rng = np.random.default_rng(seed)
    batch, n, nx = record.batch, record.num_samples, system.nx
    low, high = vector(setup.x0_low, nx, "x0_low"), vector(setup.x0_high, nx, "x0_high")
    result = Posterior(np.empty((batch, n, nx)), np.empty((batch, n, nx, nx)), np.empty((batch, n)))
    x0 = np.broadcast_to(_prior_draws(system, low, high, draws, rng)[:, None], (draws, batch, nx))
    log_weight = np.zeros((draws, batch))
    start, stop = 0, 1
    while start < n:
        weight = _run(system, record, R, x0, log_weight, (start, min(stop, n)), result)
        mean, cov = _moments(weight, x0)
        spread = np.linalg.cholesky(2.0 * cov + 1e-18 * np.diag((high - low) ** 2))
        normal = rng.standard_normal((draws, 1, nx, 1))
        normal = normal / np.sqrt(rng.chisquare(5.0, (draws, 1, 1, 1)) / 5.0)
        x0 = mean + (spread @ normal)[..., 0]
        inside = ((x0 >= low) & (x0 <= high)).all(axis=-1) & system.admissible(x0)
        density = -(nx + 5) / 2 * np.log1p((normal**2).sum(axis=(2, 3)) / 5.0)
        log_weight = np.where(inside, -density, -np.inf)
        start, stop = stop, 2 * stop
    return result


def _prior_draws(
    system: System, low: np.ndarray, high: np.ndarray, count: int, rng: np.random.Generator
) -> np.ndarray:
    """Initial states (count, nx), uniform in the admissible part of the box."""
    kept = np.empty((0, len(low)))
    while len(kept) < count:
        drawn = rng.uniform(low, high, (4 * count, len(low)))
        kept = np.concatenate([kept, drawn[np.asarray(system.admissible(drawn))]])
    return kept[:count]


def _run(
    system: System,
    record: Record,
    R: np.ndarray,
    x0: np.ndarray,
    log_weight: np.ndarray,
    samples: tuple[int, int],
    result: Posterior,
) -> np.ndarray:
    """Write the posterior at some samples, and return the weights (draws, batch) at the last."""
    x, weight = x0, np.exp(log_weight - log_weight.max(axis=0))
    for k in range(samples[1]):
        if k:
            times = float(record.t[k - 1]), float(record.t[k])
            x = model_step(system, *times, x, record.u[:, k - 1], record.u[:, k])
        outputs = system.h(record.t[k], x, record.u[:, k])
        misfit = (record.y[:, k] - outputs) ** 2 / R
        log_weight = log_weight - np.nansum(misfit, axis=-1) / 2
        if k >= samples[0]:
            weight = np.exp(log_weight - log_weight.max(axis=0))
            weight /= weight.sum(axis=0)
            result.mean[:, k], result.cov[:, k] = _moments(weight, x)
            result.ess[:, k] = 1 / (weight**2).sum(axis=0)
    return weight


def _moments(weight: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weighted means (batch, nx) and covariances (batch, nx, nx) of x (draws, batch, nx)."""
    mean = np.einsum("nb,nbi->bi", weight, x)
    error = x - mean
    return mean, np.einsum("nb,nbi,nbj->bij", weight, error, error, optimize=True)


@dataclass(frozen=True)
class Reference:
    """What errors that are as large as the Cramér-Rao reference score, for a batch of episodes; not
    a number where it is below what a single step of the model errs by."""

    nrmse: np.ndarray
    """Of the whole episode, shape (batch,)."""
    nrmse_75: np.ndarray
    """Of its last 75 %."""
    nrmse_tail: np.ndarray
    """Of its last 25 %."""
    by_sample: np.ndarray
    """Of each sample, shape (batch, num_samples)."""


def reference(game: Game, record: Record, truth: np.ndarray) -> Reference | None:
    """The Cramér-Rao reference of a game's episodes, in terms of scores.

    Args:
        game: what is played.
        record: what estimators see of the episodes.
        truth: true states at its samples, shape (batch, num_samples, nx).

    Returns:
        None where there is none: without noise, from a fixed initial state, or under a condition
        that is not in the model (`Condition.reference`).
    """
    source = game.source
    std = vector(source.setup.noise_std, source.system.ny, "noise_std")
    if not source.condition.reference or source.fixed_x0 or not (std > 0).all():
        return None
    Q = None if source.process_noise is None else np.diag(source.process_noise**2)
    P0, R = record.prior.cov[0], np.diag(std**2)
    P = cramer_rao(source.system, record.t, truth, P0, R, Q, np.isnan(record.y))
    counted = (source.system.scale, source.system.observable(truth))
    expected = expected_scores(P, *counted)
    if Q is None:
        error = step_error(source.system, record.t, truth)
        floor = expected_scores(error[..., None] * error[..., None, :], *counted)
        expected = {n: np.where(v > floor[n], v, np.nan) for n, v in expected.items()}
    return Reference(**expected, by_sample=by_sample(np.sqrt(np.einsum("bkii->bki", P)), *counted))
