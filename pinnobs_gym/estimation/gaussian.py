"""Tuning, checks and prediction shared by estimators with a mean and a covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pinnobs_gym.estimation import square_root
from pinnobs_gym.estimation.estimator import BaseEstimator, Range, State
from pinnobs_gym.estimation.kalman import joseph_update, predict
from pinnobs_gym.simulation.noise import AssumedNoise, Noise
from pinnobs_gym.simulation.notices import say_once
from pinnobs_gym.simulation.plant_form import first_row
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.system import System


@dataclass(frozen=True)
class GaussianEstimator(BaseEstimator):
    """The settings of estimators with a mean and a covariance.

    The tuning rule is the same for all systems: x̂₀ and P₀ are those of the prior, R is that of the
    known output noise, and the process noise is the known one with `assumed_noise` added.
    """

    assumed_noise: float = 3e-3
    """Standard deviation of process noise that is assumed beyond the known one, over each state's
    scale and the benchmark's duration: what the model may be off after that time."""

    tunable = {"assumed_noise": Range(3e-6, 3.0, log=True)}

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.assumed_noise < np.inf:
            raise ValueError(f"assumed_noise={self.assumed_noise}; expected a number of at least 0")

    @cached_property
    def noise(self) -> AssumedNoise:
        """The known noise, with `assumed_noise` and an output noise above zero."""
        told = self.system.noise(self.noise_std, self.process_noise)
        noise = AssumedNoise.of(self.system, told, self.assumed_noise)
        self._say_if_too_large(noise)
        return noise

    def _say_if_too_large(self, noise: AssumedNoise) -> None:
        """Log in one line, once, where the assumed process noise moves an output from one sample to
        the next by more than the output noise and the known process noise do together: estimates
        then follow the latest outputs, and the model counts for nothing.

        The default is a share of the state's scale, which is right where the scale is the range of
        a state. It is not where a state varies little about a large value.
        """
        system, setup = first_row(self.system), self.system.setups["benchmark"]
        mean = Prior.of(system, setup, 1).mean
        with np.errstate(all="ignore"):  # an output that is not defined there says nothing
            H = np.asarray(system.h_jacobian(0.0, mean, np.zeros((1, system.nu))))[0]
            assumed = np.sqrt(np.square(H * noise.extra).sum(axis=1) * setup.dt)
            known = H @ noise.told.L(0.0)[..., 0]
            variance = np.einsum("iib->ib", noise.R(0.0))[:, 0]
            rest = np.sqrt(variance + np.square(known).sum(axis=1) * setup.dt)
            ratio = assumed / rest
        if (ratio > 1).any():
            worst = int(np.nanargmax(ratio))
            name, value = system.output_names[worst], self.assumed_noise
            say_once(
                f"{self.label} on {type(system).__name__}: assumed_noise={value:g} moves {name} by "
                f"{assumed[worst]:.3g} from sample to sample, {ratio[worst]:.3g} times its noise, "
                "so that estimates follow the latest output; expected at most "
                f"{0.1 * value / ratio[worst]:.1g}, or 0 for an exact model"
            )


def checked(prior: Prior) -> Prior:
    """Check the covariances of a prior, and return the prior in double precision.

    Raises:
        ValueError: in one line, if a covariance is not finite, symmetric and positive semidefinite.
    """
    P = np.asarray(prior.cov, dtype=float)
    size = abs(P).max(axis=(1, 2))
    if (
        not np.isfinite(P).all()
        or (abs(P - P.transpose(0, 2, 1)).max(axis=(1, 2)) > 1e-9 * size).any()
    ):
        raise ValueError("P0 is not symmetric and finite; expected a covariance")
    least = np.linalg.eigvalsh(P)[:, 0]
    if (least < -1e-9 * size).any():
        row = int(np.argmin(least / np.maximum(size, 1e-300)))
        raise ValueError(
            f"P0 of row {row} has eigenvalue {least[row]:.3g}; expected a covariance, none below 0"
        )
    return Prior(np.asarray(prior.mean, dtype=float), P)


def covariances(state: State) -> np.ndarray:
    """Return the covariances of a state with the batch last, shape (nx, nx, batch).

    Raises:
        ValueError: in one line, if the state has none.
    """
    if state.P is None:
        raise ValueError("the state has no covariance; begin with reset(prior)")
    return state.P.transpose(1, 2, 0)


def predicted(
    system: System,
    state: State,
    P: np.ndarray,
    noise: Noise,
    t: float,
    u: np.ndarray,
) -> State:
    """Return the state with the prediction x̂(k|k−1) and its covariance ΦPΦᵀ + Q; see
    `RecursiveEstimator.predict`.

    Args:
        system: the model.
        state: the state after the previous sample.
        P: covariances at that sample, shape (nx, nx, batch), in place of those of the state.
        noise: the noise, of which the process noise is used.
        t: time of the next sample in s.
        u: inputs at the next sample, shape (batch, nu).
    """
    assert state.t is not None  # no prediction precedes the first sample
    xhat, P, F, Q = predict(system, (state.t, t), state.xhat, P, noise, (state.u, u))
    covariance, L = P.transpose(2, 0, 1), state.root
    if L is not None:
        rows = square_root.carried(L)
        added = np.broadcast_to(Q, (*Q.shape[:2], len(xhat)))[..., rows]
        L, covariance = L.copy(), covariance.copy()
        moved = F.transpose(2, 0, 1)[rows] @ L[rows]
        L[rows] = square_root.compressed(moved, square_root.root_of(added.transpose(2, 0, 1)))
        covariance[rows] = square_root.covariance(L[rows])
    return State(xhat, state.t, state.u, covariance, state.innovation, None, state.memory, L)


def enlarged(state: State, growth: np.ndarray) -> State:
    """Return the state with a covariance (nx, nx, batch) added to P and to its roots."""
    P, L = (covariances(state) + growth).transpose(2, 0, 1), state.root
    if L is not None:
        rows = square_root.carried(L)
        L, P = L.copy(), P.copy()
        added = square_root.root_of(growth[..., rows].transpose(2, 0, 1))
        L[rows] = square_root.compressed(L[rows], added)
        P[rows] = square_root.covariance(L[rows])
    return replace(state, P=P, root=L)


def corrected(
    state: State,
    sample: tuple[float, np.ndarray],
    P: np.ndarray,
    innovation: np.ndarray,
    H: np.ndarray,
    R: np.ndarray,
) -> State:
    """Return the state after a Kalman update: in Joseph's form, or by the roots of the covariances
    in the rows that have them.

    Args:
        state: the prediction; its memory is kept.
        sample: time in s, and inputs (batch, nu), of the sample.
        P: covariances of the prediction, shape (nx, nx, batch).
        innovation: y − h(t, x̂, u), shape (batch, ny), zero where y is missing.
        H: output Jacobians, shape (ny, nx, batch), zero where y is missing.
        R: covariance of the output noise, shape (ny, ny, batch or 1).
    """
    xhat, P, S = joseph_update(state.xhat, P, innovation, H, R)
    covariance, L = P.transpose(2, 0, 1), state.root
    if L is not None:
        rows = square_root.carried(L)
        noise = np.broadcast_to(R, (*R.shape[:2], len(xhat)))[..., rows].transpose(2, 0, 1)
        L, xhat, covariance = L.copy(), xhat.copy(), covariance.copy()
        outputs = H.transpose(2, 0, 1)[rows]
        step, L[rows] = square_root.updated(L[rows], innovation[rows], outputs, noise)
        xhat[rows] = state.xhat[rows] + step
        covariance[rows] = square_root.covariance(L[rows])
    S = S.transpose(2, 0, 1)
    return State(xhat, *sample, covariance, innovation, S, state.memory, L)
