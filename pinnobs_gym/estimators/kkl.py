"""Learned KKL observers: the trained networks and their file, and one estimator per trainer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pinnobs_gym.estimation.estimator import Estimator, State
from pinnobs_gym.estimation.learned.kkl_dynamics import Dynamics, Mode, Start, at_rest
from pinnobs_gym.estimation.learned.kkl_maps import Activation
from pinnobs_gym.estimation.learned.perceptron import Layers, perceptron
from pinnobs_gym.estimation.learned.trained import LearnedEstimator, Trained
from pinnobs_gym.estimation.learned.trained_file import check_same
from pinnobs_gym.estimation.takes import EVERYTHING
from pinnobs_gym.simulation.model import model_step
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.system import Array, System
from pinnobs_gym.simulation.value_shape import outputs_at

if TYPE_CHECKING:
    from pinnobs_gym.estimation.export.algorithm import Algorithm
    from pinnobs_gym.simulation.kernels.plant_code import PlantCode


@dataclass(frozen=True, eq=False)
class Clock:
    """Additional inputs of time-dependent maps T and T*: e^(−rt), with t the time since the first
    sample, and the plant's input over its amplitude."""

    rates: tuple[float, ...] = ()
    """Rates r in 1/s."""
    amplitudes: tuple[float, ...] = ()
    """Amplitudes of the plant's inputs; empty without inputs."""

    @property
    def size(self) -> int:
        """Number of additional inputs."""
        return len(self.rates) + len(self.amplitudes)

    def __call__(self, t: Array, u: Array, xp: Any = np) -> Array:
        """Return the additional inputs (..., size) at times t (...) since the first sample in s,
        for the plant's inputs u (..., nu)."""
        inputs = [xp.exp(-rate * t) for rate in self.rates]
        inputs += [u[..., i] / size for i, size in enumerate(self.amplitudes)]
        return xp.stack(inputs, -1)


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainedKKL(Trained):
    """A trained KKL observer. Its loss is the mean squared scaled error of x̂ on noisy held-out
    episodes, and its iterations are those of both networks together."""

    A: np.ndarray
    """A_z, shape (nz, nz), in 1/s."""
    B: np.ndarray
    """B_z, shape (nz, ny), in 1/s per output unit."""
    mode: Mode
    start: Start
    clock: Clock
    """Additional inputs of T*, and of T if it depends on time."""
    activation: Activation
    encoder: Layers
    """T: from x (and the additional inputs, if T depends on time) to z."""
    decoder: Layers
    """T*: from z and the additional inputs to x."""
    facts: Mapping[str, Any]
    """Further facts of the training: dropped initial states, the error of T, a sweep."""

    @cached_property
    def dynamics(self) -> Dynamics:
        """The dynamics of z."""
        return Dynamics(self.A, self.B, self.mode)

    @cached_property
    def rest(self) -> np.ndarray:
        """Initial z per constant output, (nz, ny): the equilibrium if ``start`` is ``output``, else
        zero."""
        return at_rest(self.dynamics, self.start)

    def T(self, x: np.ndarray, t: float = 0.0, u: np.ndarray | None = None) -> np.ndarray:
        """Return the z (..., nz) that T assigns to states x (..., nx). If T depends on time, t is
        the time since the first sample in s, and u are the inputs (zero if None)."""
        if self.encoder[0][0].shape[1] > x.shape[-1]:
            u = np.zeros(len(self.clock.amplitudes)) if u is None else u
            inputs = self.clock(np.asarray(t), u)
            x = np.concatenate([x, np.broadcast_to(inputs, (*x.shape[:-1], inputs.shape[-1]))], -1)
        return perceptron(self.encoder, self.activation, x)

    def inverse(self, z: np.ndarray, t: float | np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return the estimates T*(z), shape (..., nx), for z (..., nz), times t since the first
        sample in s, and inputs u (..., nu)."""
        if self.clock.size:
            shape = z.shape[:-1]
            t = np.broadcast_to(np.asarray(t, dtype=float), shape)
            u = np.broadcast_to(u, (*shape, u.shape[-1]))
            z = np.concatenate([z, self.clock(t, u)], axis=-1)
        return perceptron(self.decoder, self.activation, z)

    @property
    def notes(self) -> Mapping[str, Any]:
        return {name: self.facts[name] for name in ("dropped", "drawn")}

    def check_fits(self, path: str | Path, system: System) -> None:
        sizes = {"nx": len(self.decoder[-1][1]), "ny": self.B.shape[1]}
        check_same(path, sizes, {"nx": system.nx, "ny": system.ny})


@dataclass(frozen=True)
class KKL(LearnedEstimator, Estimator):
    """The base class of the learned KKL observers, ż = A_z z + B_z y and x̂ = T*(z).

    In continuous mode z is integrated exactly for outputs that are linear between samples at any
    times; in discrete mode by Euler steps. A missing output is replaced by h of the model's
    prediction from the previous estimate.
    """

    trained: TrainedKKL = field(kw_only=True, repr=False)
    """The trained observer."""

    knows = ("model", "noise", "initial set", "simulated true states")
    exempt_from = {
        "model_alone": "its estimate is a function of z, which knows no prior",
        "blank_rows": "a missing output is replaced by that of its own prediction",
        "units": "its maps were learned in the units of its training",
    }
    takes = EVERYTHING - {"maps", "stiff", "output_period", "held_input"}
    equations = r"""
\dot z &= A_z z + B_z y, \qquad z_{k+1} = \Phi z_k + \Gamma_0 y_k + \Gamma_1 y_{k+1} \\
\hat x &= T^*(z), \qquad \tfrac{\partial T}{\partial t} + \tfrac{\partial T}{\partial x}\,
f(t, x, u) = A_z T + B_z h(t, x, u)
"""

    def __post_init__(self) -> None:
        super().__post_init__()

    @property
    def training(self) -> dict[str, Any]:
        """Training metadata; z that starts at T(x̂₀) knows the prior."""
        facts = super().training
        return {**facts, "knows": ("prior",)} if self.trained.start == "prior" else facts

    def reset(self, prior: Prior) -> State:
        return State(np.array(prior.mean, dtype=float))

    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        trained = self.trained
        y = self._complete(state, t, y, u)
        if state.t is None:
            z, first = self._begin(state.xhat, y), t
        else:
            before, first, y0 = state.memory
            flow, gamma0, gamma1 = trained.dynamics.step(t - state.t)
            z = before @ flow.T
            z += y0 @ gamma0.T
            z += y @ gamma1.T
        return State(trained.inverse(z, t - first, u), t, u, memory=(z, first, y))

    def exported(self, code: PlantCode, prior: Prior) -> Algorithm | None:
        from pinnobs_gym.estimation.export.kkl import kkl_code

        return kkl_code(self.trained, self.system, code)

    def _begin(self, xhat: np.ndarray, y: np.ndarray) -> np.ndarray:
        if self.trained.start == "prior":
            return self.trained.T(xhat)
        return y @ self.trained.rest.T

    def _complete(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return the outputs, with predicted outputs of the model in place of missing ones."""
        missing = np.isnan(y)
        if not missing.any():
            return y
        rows = missing.any(axis=1)
        xhat = state.xhat[rows]
        if state.t is not None:
            before = None if state.u is None else state.u[rows]
            xhat = model_step(self.system, state.t, t, xhat, before, u[rows])
        y = y.copy()
        y[rows] = np.where(missing[rows], outputs_at(self.system, t, xhat, u[rows]), y[rows])
        return y


@dataclass(frozen=True)
class KKLSupervised(KKL):
    """The KKL observer ż = A_z z + B_z y, x̂ = T*(z), with T* fitted to simulated pairs of states
    and z (Ramos et al. 2020).

    When to choose it: where no first guess is to be relied on, and the initial states come from a
    set that can be simulated: the estimate depends on outputs alone. It is the plainest of the
    three KKL observers to train.
    """

    name = "kkl_supervised"
    equations = (
        KKL.equations.rstrip()
        + r""" \\
T &: \; \min \textstyle\sum_i \| T(x_i) - z_i \|^2, \qquad
T^* : \; \min \textstyle\sum_i \| T^*(z_i) - x_i \|^2
"""
    )
    needs_training = "kkl_supervised"


@dataclass(frozen=True)
class KKLPinn(KKL):
    """The KKL observer ż = A_z z + B_z y, x̂ = T*(z), with T fitted to simulated pairs and to its
    partial differential equation at further points (Niazi et al. 2023).

    When to choose it: as for `kkl_supervised`, with few simulated pairs: the partial differential
    equation also holds T between them.
    """

    name = "kkl_pinn"
    equations = (
        KKL.equations.rstrip()
        + r""" \\
T &: \; \min \sum_i \| T(x_i) - z_i \|^2 + \frac{w}{\lambda^2} \sum_j
\Bigl\| \Bigl( \tfrac{\partial T}{\partial t} + \tfrac{\partial T}{\partial x}\, f
- A_z T - B_z h \Bigr) (t_j, x_j, u_j) \Bigr\|^2, \qquad
\lambda = \min |\operatorname{Re} \lambda(A_z)| \\
T^* &: \; \min \textstyle\sum_i \| T^*(z_i) - x_i \|^2
"""
    )
    needs_training = "kkl_pinn"


@dataclass(frozen=True)
class KKLAutoencoder(KKL):
    """The KKL observer ż = A_z z + B_z y, x̂ = T*(z), with T fitted to its own equation over several
    samples, and T* to T, without simulated z (Peralez & Nadri 2021).

    When to choose it: as for `kkl_supervised`, where z is not to be simulated for the training. Its
    transient errors are larger on the systems here.
    """

    name = "kkl_autoencoder"
    equations = (
        KKL.equations.rstrip()
        + r""" \\
T &: \; \min \sum_k \Bigl\| T(x_{k+m}) - \Phi^m T(x_k)
- \sum_{j=k}^{k+m-1} \Phi^{k+m-1-j} (\Gamma_0 y_j + \Gamma_1 y_{j+1}) \Bigr\|^2 \\
T^* &: \; \min \textstyle\sum_k \| T^*(z_k) - x_k \|^2, \qquad z_k \text{ computed from } T
"""
    )
    needs_training = "kkl_autoencoder"
