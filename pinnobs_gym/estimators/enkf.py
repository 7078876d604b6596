"""The ensemble Kalman filter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from pinnobs_gym.estimation.circular import gathered
from pinnobs_gym.estimation.compiled_ensemble import CompiledEnsemble
from pinnobs_gym.estimation.estimator import Range, State
from pinnobs_gym.estimation.gaussian import GaussianEstimator, checked
from pinnobs_gym.estimation.kalman import gain_of_deviations
from pinnobs_gym.estimation.least_squares import root
from pinnobs_gym.estimation.localisation import tapers
from pinnobs_gym.estimation.projection import nearest_points
from pinnobs_gym.estimation.random_streams import generator
from pinnobs_gym.estimation.recursive import RecursiveEstimator
from pinnobs_gym.estimation.wrapping import say_what_turns
from pinnobs_gym.simulation.kernels.plant_library import PlantLibrary
from pinnobs_gym.simulation.matrices import divide, einsum, outer, product, spread, total
from pinnobs_gym.simulation.model import noisy_model_step
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.value_shape import outputs_at
from pinnobs_gym.simulation.values import check_points


@dataclass(frozen=True)
class EnsembleMemory:
    """The ensemble."""

    members: np.ndarray
    """States, shape (num_members, batch, nx)."""
    sample: int = 0
    """Number of samples processed so far."""


@dataclass(frozen=True)
class EnKF(RecursiveEstimator, GaussianEstimator):
    """The ensemble Kalman filter with perturbed outputs (Evensen 1994; Burgers, van Leeuwen &
    Evensen 1998) and multiplicative inflation of the ensemble (Anderson & Anderson 1999).

    The inflation follows an analysis and gives back at most the spread that the analysis has taken,
    state by state, as the relaxation to prior spread does (Whitaker & Hamill 2012). A state of
    which the outputs tell nothing is not inflated. An ensemble with no more members than states is
    allowed; its covariance is singular. A member outside of the states' bounds is moved to the
    nearest point inside, in the metric of the inverse of the ensemble's covariance.

    Members that differ by whole turns of an angle are the same states: they are taken within half a
    turn of their circular mean, and so are their outputs.

    Correlations of few members over a long distance are mostly chance. With ``localisation``, the
    covariances of outputs with states and with each other are tapered by distance (Gaspari & Cohn
    1999; Houtekamer & Mitchell 2001), which takes a system that declares `System.distances`.

    Random numbers depend only on the seed and the sample, and all episodes of a batch share them.
    Results are therefore reproducible, and the result of an episode does not depend on the others
    in its batch. The numbers have mean zero and unit variance over the ensemble.

    Default tuning is the same rule for all systems: P₀ is that of the prior, and the noise is
    the known one with `assumed_noise` added.

    When to choose it: where the plant has hundreds of states or more, as a discretised field does,
    so that covariance matrices and Jacobians are too large. With few states `ukf` costs less and is
    no worse.
    """

    members: int = 50
    """Size of the ensemble, from 2 to 1000000."""
    inflation: float = 1.01
    """Largest factor of the deviations from the ensemble mean after each analysis."""
    localisation: float | None = None
    """Distance, in the unit of `System.distances`, from which on correlations are taken as zero;
    None for no localisation."""
    seed: int = 0
    """Seed of the random numbers."""

    name = "enkf"
    template: ClassVar[str] = "ensemble"
    exempt_from = {
        "model_alone": "its mean is that of points that the model has moved apart",
        "blank_rows": "its random numbers are drawn row by row",
    }
    equations = r"""
x_k^{i-} &= \varphi(x_{k-1}^i, w_i) \quad
\text{with } dx = f\, dt + L\, dw_i \text{ between the samples} \\
X &= \tfrac{1}{\sqrt{N-1}} \bigl[ x_k^{i-} - \bar x_k^- \bigr]_i, \qquad
Y = \tfrac{1}{\sqrt{N-1}} \bigl[ h(t_k, x_k^{i-}, u_k) - \bar y \bigr]_i \\
K &= (\rho_{xy} \circ X Y^\top) (\rho_{yy} \circ Y Y^\top + R)^{-1}, \qquad
\rho = 1 \text{ without localisation} \\
x_k^i &= x_k^{i-} + K\, (y_k + v_i - h(t_k, x_k^{i-}, u_k)), \qquad v_i \sim \mathcal N(0, R) \\
x_k^i &:= \hat x_k + \ell \odot (x_k^i - \hat x_k), \qquad
\ell_j = \min\bigl(\lambda, (1 - (2 K Y X^\top - K (Y Y^\top + R) K^\top)_{jj}
/ (X X^\top)_{jj})^{-1/2}\bigr) \\
\hat x_k &= \tfrac1N \sum_i x_k^i, \qquad
P_k = \tfrac{1}{N-1} \sum_i (x_k^i - \hat x_k)(x_k^i - \hat x_k)^\top
"""
    tunable = {**GaussianEstimator.tunable, "inflation": Range(1.0, 1.1)}

    def __post_init__(self) -> None:
        super().__post_init__()
        check_points("members", self.members)
        if not 1 <= self.inflation < np.inf:
            raise ValueError(f"inflation={self.inflation}; expected a number of at least 1")
        if self.localisation is not None:
            if not 0 < self.localisation < np.inf:
                raise ValueError(f"localisation={self.localisation}; expected a number above 0")
            _ = self._tapers  # raises without distances

    @cached_property
    def _tapers(self) -> tuple[np.ndarray, np.ndarray]:
        assert self.localisation is not None
        return tapers(self.system, self.localisation)

    def reset(self, prior: Prior) -> State:
        prior = checked(prior)
        L = root(prior.cov.transpose(1, 2, 0))
        members = prior.mean + spread(L, self._normal(0)(self.system.nx))
        members = self._inside(gathered(members, self.system.state_period))
        return State(prior.mean, P=prior.cov, memory=EnsembleMemory(_batch_innermost(members)))

    def not_compiled(self) -> str:
        return "" if self.localisation is None else "its covariances are localised"

    def compiled_with(self, made: PlantLibrary) -> CompiledEnsemble:
        return CompiledEnsemble(self, made)

    def memory_rows(self, memory: EnsembleMemory, rows: np.ndarray) -> EnsembleMemory:
        return replace(memory, members=_batch_innermost(memory.members[:, rows]))

    def predict(self, state: State, t: float, u: np.ndarray) -> State:
        assert state.t is not None
        memory: EnsembleMemory = state.memory
        normal = self._normal(2 * memory.sample + 1)
        members = noisy_model_step(
            self.system,
            self.noise,
            state.t,
            t,
            memory.members,
            state.u,
            u,
            lambda size: normal(size)[:, None],
        )
        members = self._inside(gathered(members, self.system.state_period))
        memory = replace(memory, members=members)
        return State(total(members) / self.members, state.t, state.u, memory=memory)

    def correct(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        memory: EnsembleMemory = state.memory
        members = memory.members
        mean, outputs = total(members) / self.members, outputs_at(self.system, t, members, u)
        outputs = gathered(outputs, self.system.output_period)
        yhat = total(outputs) / self.members
        # v = Gw with G of R, for each member.
        G = self.noise.G(t)
        normal = self._normal(2 * memory.sample + 2)
        noise = einsum("pmb,nm->nbp", G, normal(G.shape[1]))
        weight = 1 / np.sqrt(self.members - 1)
        X = weight * (members - mean).transpose(2, 0, 1)
        Y = weight * (outputs - yhat).transpose(2, 0, 1)
        say_what_turns(self.label, self.system, (t, y, u), mean, outer(X, X), self.noise.R(t))
        missing = np.isnan(y)
        Y = np.where(missing.T[:, None], 0.0, Y)
        K, S, taken = self._analysis(X, Y, self.noise.R(t, y))
        # Correct each member with its own perturbed output.
        errors = self.system.output_residual(y + noise, outputs)
        errors = np.where(missing, 0.0, errors)
        for p, column in enumerate(K.transpose(1, 2, 0)):
            members = members + errors[..., p, None] * column
        members = gathered(members, self.system.state_period)
        xhat = total(members) / self.members
        deviations = self._inflation(X, taken) * (members - xhat)
        analysed = xhat + deviations
        members = self._inside(analysed)
        if members is not analysed:
            moved = (members != analysed).any(axis=(0, 2))[:, None]
            xhat = np.where(moved, total(members) / self.members, xhat)
            deviations = np.where(moved, members - xhat, deviations)
        X = weight * deviations.transpose(2, 0, 1)
        P, innovation = outer(X, X).transpose(2, 0, 1), self.system.output_residual(y, yhat)
        innovation = np.where(missing, 0.0, innovation)
        memory = replace(memory, members=members, sample=memory.sample + 1)
        return State(xhat, t, u, P, innovation, S.transpose(2, 0, 1), memory)

    def _inside(self, members: np.ndarray) -> np.ndarray:
        """Return the members (num_members, batch, nx) with those outside of the bounds moved to the
        nearest points inside."""
        box = self.system.state_box
        if box is None or not box.outside(members).any():
            return members
        X = (members - total(members) / self.members).transpose(2, 0, 1)
        P = outer(X, X).transpose(2, 0, 1) / (self.members - 1)
        return nearest_points(members, P, box)

    def _analysis(
        self, X: np.ndarray, Y: np.ndarray, R: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the gains (nx, ny, batch), the innovation covariances (ny, ny, batch), and the
        variances (nx, batch) that the analysis is expected to take; the arguments are those of
        `gain_of_deviations`."""
        if self.localisation is None:
            K, S = gain_of_deviations(X, Y, R)
            return K, S, np.add.accumulate(K * outer(X, Y), axis=1)[:, -1]
        between, own = outer(X, Y), outer(Y, Y)
        states, outputs = self._tapers
        S = outputs[..., None] * own + R
        K = divide(states[..., None] * between, S)
        # Members change by −K(Y − v): their variances by −2KYXᵀ + K(YYᵀ + R)Kᵀ for any gain.
        change = 2 * between - product(K, own + R)
        return K, S, np.add.accumulate(K * change, axis=1)[:, -1]

    def _inflation(self, X: np.ndarray, taken: np.ndarray) -> np.ndarray:
        """Return the factors (batch, nx) of the deviations after an analysis that has taken these
        variances (nx, batch) from the weighted deviations X (nx, num_members, batch)."""
        variance = total((X * X).transpose(1, 2, 0)).T
        share = np.where(variance > 0, taken / variance, 0.0)
        return np.clip(1 / np.sqrt(1 - np.clip(share, 0.0, 1.0)), 1.0, self.inflation).T

    def _normal(self, stream: int) -> Callable[[int], np.ndarray]:
        """Return a function that draws normal numbers (members, size) with mean zero and unit
        variance over the ensemble, one after another from a random stream."""
        rng, members = generator(self.seed, stream), self.members

        def normal(size: int) -> np.ndarray:
            draws = rng.standard_normal((members, size))
            draws -= np.add.reduce(draws) / members
            # The sum of the rest is rounding; as in `numpy.std`, which takes twice the time.
            rest = draws - np.add.reduce(draws) / members
            rest *= rest
            return draws / np.sqrt(np.add.reduce(rest) / (members - 1))

        return normal


def _batch_innermost(members: np.ndarray) -> np.ndarray:
    """Return members (num_members, batch, nx) with the batch innermost in memory, where noise that
    rows share is added several times faster."""
    return np.ascontiguousarray(members.swapaxes(1, 2)).swapaxes(1, 2)
