"""Gaussians of angles that are wider than their circle: what is left of a covariance when whole
periods do not count, and where it is not enough.

With z normal, of variance s, and wrap(z) the nearest representative of zero, the slope of the best
linear prediction of wrap(z) by z is g = E[wrap'(z)] = 1 − period·p(period/2), with p the density of
wrap(z) (Stein's identity), and wrap(z) has the variance f below (from the Fourier series of p, see
Mardia & Jupp 2000, "Directional Statistics", section 3.5.7). Narrow ones have g = 1 and f = s; wide
ones g = 0 and f = period²/12. Matrices have the batch as their last axis.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pinnobs_gym.estimation import square_root
from pinnobs_gym.estimation.estimator import State
from pinnobs_gym.simulation.matrices import cholesky, product, total
from pinnobs_gym.simulation.notices import say_once
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.residual import Periods
from pinnobs_gym.simulation.system import System

_WIDE = 1 / 12
"""Standard deviation, over the period, from which on wrapping counts. Half a period is six of them,
and g is 1 − 2e-7."""
_CURVED = 1 / 8
"""Standard deviation of a state, over its period, from which on it matters that outputs are not
linear in it."""
_UNSURE = 1 / 6
"""Standard deviation of an output's prediction, over its period, from which on its turn is not
certain: half a period is three of them."""
_TERMS = 12
"""Terms of the series; the next one is below 1e-9 at the width above."""


def wrapped_moments(variance: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Return g and f of the module's text; 1 and the variance where it is not wide."""
    unit = variance * (2 * np.pi / period) ** 2
    wide: np.ndarray = variance > (_WIDE * period) ** 2  # not where it is not finite
    n = np.arange(1, _TERMS + 1)[:, None]
    terms = -((-1.0) ** n) * np.exp(-0.5 * n * n * np.where(wide, unit, np.inf))
    slope = 2 * total(terms)
    size = (period / (2 * np.pi)) ** 2 * (np.pi**2 / 3 - 4 * total(terms / (n * n)))
    return np.where(wide, slope, 1.0), np.where(wide, size, variance)


def _wider(variances: np.ndarray, periods: Periods, share: float) -> list[int]:
    """Return the components with a period, some of whose variances (n, batch) are those of standard
    deviations above this share of it."""
    return [
        i
        for i, period in enumerate(periods)
        if period is not None and (variances[i] > (share * period) ** 2).any()
    ]


def wrapped_state(system: System, state: State) -> State:
    """Return the state with the covariance that its errors have when whole periods of its angles do
    not count: D P D + diag(f − g²s), with D = diag(g), positive semidefinite since f ≥ g²s."""
    periods = system.state_period
    if periods is None or state.P is None:
        return state
    variances = np.einsum("bii->ib", state.P)
    wide = _wider(variances, periods, _WIDE)
    if not wide:
        return state
    g, extra = np.ones_like(variances), np.zeros_like(variances)
    for i in wide:
        period = periods[i]
        assert period is not None
        g[i], size = wrapped_moments(variances[i], period)
        extra[i] = np.where(g[i] < 1, size - g[i] ** 2 * variances[i], 0.0)
    P, L = g.T[:, :, None] * state.P * g.T[:, None], state.root
    np.einsum("bii->bi", P)[...] += extra.T
    if L is not None:
        rows, L = square_root.carried(L), L.copy()
        added = np.sqrt(np.maximum(extra.T[rows], 0.0))[..., None] * np.eye(len(g))
        L[rows] = square_root.compressed(g.T[rows, :, None] * L[rows], added)
        P[rows] = square_root.covariance(L[rows])
    return replace(state, P=P, root=L)


def say_what_turns(
    label: str,
    system: System,
    sample: tuple[float, np.ndarray, np.ndarray],
    xhat: np.ndarray,
    P: np.ndarray,
    R: np.ndarray,
) -> None:
    """Log in one line, once, where a normal distribution cannot tell what an angle does to it.

    That is, where an output may have turned by a whole period more or less than the states that
    count turns say, or where outputs are not linear in a state that is an angle, and of which the
    standard deviation is more than an eighth of a turn. Covariances may then be too small by far.

    Args:
        label: name of the estimator.
        system: the model.
        sample: time in s, outputs (batch, ny) and inputs (batch, nu).
        xhat: predictions, shape (batch, nx).
        P: their covariances, shape (nx, nx, batch).
        R: covariance of the output noise, shape (ny, ny, batch or 1).
    """
    if system.output_period is None and system.state_period is None:
        return
    H = _jacobian(system, sample, xhat)
    _say(label, system, _curved(system, sample, xhat, P, H, R) or _unsure(system, P, H, R))


def say_of_outputs(
    label: str,
    system: System,
    sample: tuple[float, np.ndarray, np.ndarray],
    xhat: np.ndarray,
    P: np.ndarray,
    R: np.ndarray,
) -> None:
    """As `say_what_turns`, only of outputs, with P of shape (batch, nx, nx): particles take any
    distribution on a circle, but lose modes that are turns apart."""
    if system.output_period is not None:
        H = _jacobian(system, sample, xhat)
        _say(label, system, _unsure(system, P.transpose(1, 2, 0), H, R))


def _jacobian(
    system: System, sample: tuple[float, np.ndarray, np.ndarray], xhat: np.ndarray
) -> np.ndarray:
    """Return the output Jacobians (ny, nx, batch), zero where y is missing."""
    t, y, u = sample
    H = np.asarray(system.h_jacobian(t, xhat, u)).transpose(1, 2, 0)
    return np.where(np.isnan(y).T[:, None], 0.0, H)


def _say(label: str, system: System, found: str | None) -> None:
    if found is not None:
        say_once(
            f"{label} on {type(system).__name__}: {found}; its covariances may be far too small, "
            "begin with a narrower prior"
        )


def _unsure(system: System, P: np.ndarray, H: np.ndarray, R: np.ndarray) -> str | None:
    """Return what is said of an output whose turn is not certain."""
    if system.output_period is None:
        return None
    C = product(P, H.swapaxes(0, 1))
    variances = np.einsum("iib->ib", product(H, C) + R)
    angles = [i for i, each in enumerate(system.state_period or ()) if each is not None]
    if angles:
        # Turns of states that are angles do not count. Given these, the variance is S − CᵀP⁻¹C.
        L = cholesky(P[np.ix_(angles, angles)], semidefinite=True).transpose(2, 0, 1)
        white = square_root.substituted(L, C[angles].transpose(2, 0, 1))
        variances = variances - np.square(white).sum(axis=1).T
    for i in _wider(variances, system.output_period, _UNSURE):
        return (
            f"output {system.output_names[i]} repeats, and the standard deviation of its "
            "prediction is more than a sixth of a turn, so that its turn is not certain"
        )
    return None


def _curved(
    system: System,
    sample: tuple[float, np.ndarray, np.ndarray],
    xhat: np.ndarray,
    P: np.ndarray,
    H: np.ndarray,
    R: np.ndarray,
) -> str | None:
    """Return what is said of an angle that is not known and in which outputs are not linear."""
    t, y, u = sample
    periods, noise = system.state_period or (), np.sqrt(np.einsum("iib->bi", R))
    variances = np.einsum("iib->ib", P)
    for i in _wider(variances, periods, _CURVED):
        period = periods[i]
        assert period is not None
        step = period / 8 * np.eye(system.nx)[i]
        start = np.asarray(system.h(t, xhat, u))
        for sign in (1, -1):
            moved = system.output_residual(np.asarray(system.h(t, xhat + sign * step, u)), start)
            off = abs(moved - sign * period / 8 * H[:, i].T)
            off = np.where(np.isnan(y), 0.0, off)
            wide = variances[i] > (_CURVED * period) ** 2
            if (off > noise)[wide].any():
                return (
                    f"state {system.state_names[i]} repeats, and its standard deviation is more "
                    "than an eighth of a turn, over which outputs are not linear in it"
                )
    return None


def say_of_start(label: str, system: System, record: Record, R: np.ndarray) -> None:
    """As `say_what_turns`, at the first sample of a record with its prior."""
    prior, sample = record.prior, (float(record.t[0]), record.y[:, 0], record.u[:, 0])
    say_what_turns(label, system, sample, prior.mean, prior.cov.transpose(1, 2, 0), R)
