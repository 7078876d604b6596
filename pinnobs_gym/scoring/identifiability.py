"""Whether the outputs determine the state under a condition that changes what estimators are not
told."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pinnobs_gym.scoring.cramer_rao import covariances
from pinnobs_gym.simulation.conditions import CONDITIONS
from pinnobs_gym.simulation.conditions.base import Unknowns
from pinnobs_gym.simulation.model import model_step, model_step_jacobian
from pinnobs_gym.simulation.system import Setup, System, vector

if TYPE_CHECKING:
    from pinnobs_gym.envs.game import Game, GameName

LIMIT = 5.0
"""Value of `free_over_known` above which a game counts as not identifiable."""

_SEEDS = range(10)
"""Seeds of the episodes whose trajectories the equations are linearised at."""
_STEP = 1e-3
"""Step of central differences with respect to an unknown, relative to its standard deviation."""

_ratios: dict[tuple[type[System], GameName, bytes], float | None] = {}
"""Results by class of the system, name of the game and its changes."""


def free_over_known(game: Game) -> float | None:
    """Return how much larger errors must be because estimators are not told what the condition
    changes: the steady error of the best estimator that knows the law of these numbers, over that
    of one that knows the numbers.

    Both are root mean squares of the Cramér-Rao reference (`pinnobs_gym.scoring.cramer_rao`) over
    ten episodes, the samples after the transient (`steady_from`) and the scaled states that are
    scored. For the first, the condition's `Condition.unknowns` are constant states of their own
    (van Trees 1968, "Detection, Estimation, and Modulation Theory I", section 2.4), whose prior has
    mean 0 and the standard deviations of the law. The equations are linearised at the trajectories
    of the nominal plant of seeds 0 to 9. The result depends neither on the estimators nor on the
    episodes that are scored. It is kept for the life of the process.

    Where outputs determine only combinations of states and numbers, the first error has a lower
    limit that less noise does not change, so that the ratio grows as the noise decreases.

    Returns:
        The ratio, at least 1; None if the condition has no unknowns, without output noise, from a
        fixed initial state, without a steady sample, or where an error is zero or not finite.
    """
    key = (type(game.source.system), game.name, pickle.dumps(dict(game.changes)))
    if key not in _ratios:
        _ratios[key] = _ratio(game)
    return _ratios[key]


def steady_from(setup: Setup) -> float:
    """Return the time in s after which samples count as steady: a quarter of the duration."""
    return setup.duration / 4


def _ratio(game: Game) -> float | None:
    source = game.source
    system, setup = source.system, source.setup
    unknowns = source.condition.unknowns(system, setup)
    noise_std = vector(setup.noise_std, system.ny, "noise_std")
    t = source.times[:-1]
    steady = t > steady_from(setup)
    applies = bool(unknowns) and not source.fixed_x0 and (noise_std > 0).all() and steady.any()
    if not applies:
        return None
    # Trajectories of the nominal plant, and which of their outputs are missing.
    nominal = _without_unknowns(game)
    episodes = nominal.episodes(_SEEDS)
    x = episodes.x[:-1]
    flow = linearised(system, t, x, unknowns)
    H = np.where(np.isnan(episodes.y[:-1]).swapaxes(1, 2)[:, :, None], 0.0, flow.H)
    # The prior of the states is the game's, that of the unknowns is their law.
    nx, size = system.nx, flow.H.shape[2]
    P0, Q = np.zeros((size, size)), np.zeros((size, size))
    P0[:nx, :nx] = source.record(episodes).prior.cov[0]
    P0[nx:, nx:] = np.diag(np.square([s for each in unknowns for s in each.std]))
    if source.process_noise is not None:
        Q[:nx, :nx] = np.diag(source.process_noise**2)
    # The same recursion with and without the unknowns; only steady variances of states are used.
    R = np.diag(noise_std**2)
    counts = np.asarray(system.observable(x))[steady]
    rms = []
    for n in (size, nx):
        steps = zip([None, *flow.F[:, :n, :n]], H[:, :, :n], strict=True)
        found = covariances(steps, P0[:n, :n], R, Q[:n, :n])
        variances = [np.einsum("iib->bi", P[:nx, :nx]) for P in found]
        rms.append(_rms(np.array(variances)[steady], system.scale, counts))
    free, known = rms
    return free / known if np.isfinite(free) and 0 < known < np.inf else None


def _without_unknowns(game: Game) -> Game:
    """Return the game with those parts of its condition alone that have no unknowns."""
    system, setup = game.source.system, game.source.setup
    parts = game.name.condition.split("+")
    kept = [part for part in parts if not CONDITIONS[part].unknowns(system, setup)]
    return replace(game, name=game.name._replace(condition="+".join(kept) or "nominal"))


def _rms(variances: np.ndarray, scale: Sequence[float], counts: np.ndarray) -> float:
    """Return the root mean square over episodes of the NRMSE expected of errors with these
    variances, shape (num_samples, batch, nx), of which those count (bool) that are scored."""
    total = np.where(counts, variances / np.square(scale), 0.0).sum(axis=(0, 2))
    return float(np.sqrt(np.mean(total / np.maximum(counts.sum(axis=(0, 2)), 1))))


@dataclass(frozen=True)
class Linearised:
    """The model at trajectories, with constant unknowns θ as further states: z = (x, θ)."""

    F: np.ndarray
    """Jacobians ∂z_{k+1}/∂z_k of the model's steps, shape (num_samples - 1, n, n, batch) with n =
    nx + num_unknowns."""
    H: np.ndarray
    """Jacobians ∂y_k/∂z_k of the received outputs, shape (num_samples, ny, n, batch)."""


def linearised(
    system: System, t: np.ndarray, x: np.ndarray, unknowns: Sequence[Unknowns]
) -> Linearised:
    """Linearise the model's steps and the received outputs with respect to states and unknowns.

    Derivatives with respect to states are those of the model. With respect to unknowns, they are
    central differences of the model's step and outputs with plants that deviate.

    Args:
        system: the model.
        t: sample times in s, shape (num_samples,).
        x: states at which to linearise, shape (num_samples, batch, nx).
        unknowns: what a condition changes, from `Condition.unknowns`.
    """
    batch, nx = x.shape[1:]
    # All samples of all episodes are rows of one batch.
    rows, times = x.reshape(-1, nx), np.repeat(t, batch)
    u = np.asarray(system.input(times))
    ends = (times[:-batch], times[batch:], rows[:-batch], u[:-batch], u[batch:])
    by_unknown = _derivatives(
        lambda plant: model_step(plant, *ends), system, unknowns, len(ends[0])
    )
    count = by_unknown.shape[-1]
    F = np.zeros((len(ends[0]), nx + count, nx + count))
    F[:, :nx, :nx] = model_step_jacobian(system, *ends)[1]
    F[:, :nx, nx:] = by_unknown
    F[:, nx:, nx:] = np.eye(count)  # unknowns are constant
    # Outputs change with the plant, and as a condition of the measurement says.
    by_unknown = _derivatives(lambda plant: plant.h(times, rows, u), system, unknowns, len(rows))
    own = [each.output_slopes(system, times, rows, u) for each in unknowns]
    by_state = system.h_jacobian(times, rows, u)
    H = np.concatenate([by_state, by_unknown + np.concatenate(own, axis=-1)], axis=-1)
    F, H = (each.reshape(-1, batch, *each.shape[1:]) for each in (F, H))
    return Linearised(np.moveaxis(F, 1, -1), np.moveaxis(H, 1, -1))


def _derivatives(
    function: Callable[[System], np.ndarray],
    system: System,
    unknowns: Sequence[Unknowns],
    rows: int,
) -> np.ndarray:
    """Return the derivatives (rows, k, num_unknowns) of a function of the plant, with values (rows,
    k), with respect to each unknown: central differences."""
    std = np.concatenate([each.std for each in unknowns])
    columns = []
    for i, step in enumerate(_STEP * std):
        deviations = np.zeros((rows, len(std)))
        deviations[:, i] = step
        larger, smaller = (function(_plant(system, unknowns, d)) for d in (deviations, -deviations))
        columns.append((larger - smaller) / (2 * step))
    return np.stack(columns, axis=-1)


def _plant(system: System, unknowns: Sequence[Unknowns], deviations: np.ndarray) -> System:
    """Return the system with these deviations, shape (batch, num_unknowns)."""
    first = 0
    for each in unknowns:
        system = each.plant(system, deviations[:, first : first + len(each.std)])
        first += len(each.std)
    return system
