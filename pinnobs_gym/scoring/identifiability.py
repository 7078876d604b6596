"""Whether the outputs determine the state under a condition that changes what estimators are not
told."""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pinnobs_gym.estimation.kalman import kalman_gain, update_with
from pinnobs_gym.scoring.cramer_rao import Step, covariances
from pinnobs_gym.scoring.metrics import windows
from pinnobs_gym.scoring.sensitivity import linearised
from pinnobs_gym.simulation.conditions import CONDITIONS
from pinnobs_gym.simulation.matrices import sandwich
from pinnobs_gym.simulation.noise import noise_std
from pinnobs_gym.simulation.system import System

if TYPE_CHECKING:
    from pinnobs_gym.envs.game import Game, GameName

MOST_FREE = 5.0
"""Largest `Identifiability.free_over_known` with which any game is identifiable."""
LEAST_NOMINAL = 1.5
"""Smallest `Identifiability.nominal_over_free` with which any game is identifiable."""
_SEEDS = range(10)
"""Seeds of the episodes whose trajectories the equations are linearised at."""

_known: dict[tuple[type[System], GameName, bytes], Identifiability | None] = {}
"""Results by class of the system, name of the game and its changes."""


@dataclass(frozen=True)
class Identifiability:
    """How a game's unknowns, the numbers that its condition changes without estimators being told,
    enlarge errors. All errors are root mean squares over the steady window."""

    free_over_known: float
    """The smallest error that can be reached if the unknowns are to be estimated, over that if they
    are known; at least 1."""
    nominal_over_free: float
    """The error of the Kalman filter that takes the unknowns for the model's values, over the
    smallest error that can be reached if they are to be estimated; at least 1."""

    @property
    def holds(self) -> bool:
        """Whether the outputs determine the state well enough to tell estimators apart.

        They do not if the unknowns enlarge the smallest error more than `MOST_FREE` times, and even
        a filter that ignores them is within `LEAST_NOMINAL` of it: then nothing can be done about
        them, and the errors of all estimators are nearly the same.
        """
        return self.free_over_known <= MOST_FREE or self.nominal_over_free >= LEAST_NOMINAL


def identifiability(game: Game) -> Identifiability | None:
    """Compute how the unknowns of a game enlarge errors.

    Errors are those of Kalman filters of the equations linearised at the trajectories of the
    nominal plant of seeds 0 to 9, in the scaled states that are scored. Where unknowns are to be
    estimated, they are constant states of their own (van Trees 1968, "Detection, Estimation, and
    Modulation Theory I", section 2.4), whose prior has mean 0 and the standard deviations of their
    law. The result depends neither on the estimators nor on the episodes that are scored. It is
    kept for the life of the process.

    Where outputs determine only combinations of states and unknowns, the smallest error has a lower
    limit that less noise does not change, so that `free_over_known` grows as the noise decreases.

    Returns:
        None if the condition has no unknowns, without output noise, from a fixed initial state,
        with inputs that are drawn, or where an error is zero or not finite.
    """
    key = (type(game.source.system), game.name, pickle.dumps(dict(game.changes)))
    if key not in _known:
        _known[key] = _computed(game)
    return _known[key]


def _computed(game: Game) -> Identifiability | None:
    source = game.source
    system, setup = source.system, source.setup
    unknowns = source.condition.unknowns(system, setup)
    std = noise_std(setup.noise_std, system.ny, "noise_std")
    if not unknowns or source.fixed_x0 or system.draws_input or not (std > 0).all():
        return None
    # Trajectories of the nominal plant, and which of their outputs are missing.
    episodes = _without_unknowns(game).episodes(_SEEDS)
    t, x = source.times[:-1], episodes.x[:-1]
    flow = linearised(system, source.noise, t, x, unknowns)
    missing = np.isnan(episodes.y[:-1]).swapaxes(1, 2)
    H = np.where(missing[:, :, None], 0.0, flow.H)
    # The prior of the states is the game's, that of the unknowns is their law.
    nx, size = system.nx, flow.H.shape[2]
    P0 = np.zeros((size, size))
    P0[:nx, :nx] = source.record(episodes).prior.cov[0]
    P0[nx:, nx:] = np.diag(np.square([s for each in unknowns for s in each.std]))
    R = [source.noise.R(float(now), y) for now, y in zip(t, episodes.y, strict=False)]
    nothing = np.zeros((size, size, 1))
    steps = list(zip([None, *flow.F], [nothing, *flow.Q], H, R, strict=True))
    own = [(None if F is None else F[:nx, :nx], Q[:nx, :nx], H[:, :nx], R) for F, Q, H, R in steps]
    # The filters that estimate the unknowns, that know them, and that ignore them.
    filters = (
        covariances(steps, P0),
        covariances(own, P0[:nx, :nx]),
        _of_nominal_filter(nx, steps, P0),
    )
    part = windows(t, setup.transient_end)["steady"]
    counts = np.asarray(system.observable(x))[part]
    errors = []
    for found in filters:
        variances = np.array([np.einsum("iib->bi", P[:nx, :nx]) for P in found])
        errors.append(_rms(variances[part], system.scale, counts))
    free, known, nominal = errors
    if not (np.isfinite(errors).all() and known > 0):
        return None
    return Identifiability(free / known, nominal / free)


def _of_nominal_filter(nx: int, steps: Iterable[Step], P0: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the covariances (n, n, batch) after each sample of states and unknowns where the gains
    are those of a Kalman filter of the nx states alone, which never corrects the unknowns.

    The arguments are those of `covariances`.
    """
    own = P = P0[..., None]
    own = own[:nx, :nx]
    for F, Q, H, R in steps:
        ny, n, batch = H.shape
        if F is not None:
            P = sandwich(F, P) + Q
            own = sandwich(F[:nx, :nx], own) + Q[:nx, :nx]
        P, own = (np.broadcast_to(each, (*each.shape[:2], batch)) for each in (P, own))
        # The gain follows from the covariance that the filter believes in.
        K, _ = kalman_gain(own, H[:, :nx], R)
        zero = np.zeros((batch, nx)), np.zeros((batch, ny))
        _, own = update_with(K, zero[0], own, zero[1], H[:, :nx], R)
        # The covariance that this gain really leaves.
        whole = np.concatenate([K, np.zeros((n - nx, ny, batch))])
        _, P = update_with(whole, np.zeros((batch, n)), P, zero[1], H, R)
        yield P


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
