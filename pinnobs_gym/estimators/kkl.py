"""Learned KKL observers: what is trained, its file, and the three ways to train it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pinnobs_gym.estimation.estimator import Estimator, State
from pinnobs_gym.estimation.learned.kkl_dynamics import Dynamics, Mode, Start, at_rest
from pinnobs_gym.estimation.learned.kkl_maps import Activation
from pinnobs_gym.estimation.learned.perceptron import Layers, perceptron
from pinnobs_gym.estimation.learned.trained import LearnedEstimator, Trained
from pinnobs_gym.estimation.learned.trained_file import check_same
from pinnobs_gym.simulation.model import model_step
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.system import Array, System


@dataclass(frozen=True, eq=False)
class Clock:
    """What T and T* are told beside x or z where they depend on time: e^(−rt), t the time since the
    first sample, and the input over its size."""

    rates: tuple[float, ...] = ()
    """r in 1/s."""
    amplitudes: tuple[float, ...] = ()
    """Sizes of the inputs; none if the plant has none."""

    @property
    def size(self) -> int:
        """How many numbers it tells."""
        return len(self.rates) + len(self.amplitudes)

    def __call__(self, t: Array, u: Array, xp: Any = np) -> Array:
        """The numbers (..., size) at times t (...) since the first sample, inputs (..., nu)."""
        inputs = [xp.exp(-rate * t) for rate in self.rates]
        inputs += [u[..., i] / size for i, size in enumerate(self.amplitudes)]
        return xp.stack(inputs, -1)


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainedKKL(Trained):
    """A KKL observer; its loss is the mean squared scaled error of x̂ on episodes held out, noise
    included, and its iterations are those for both networks."""

    A: np.ndarray
    """Shape (nz, nz), in 1/s."""
    B: np.ndarray
    """Shape (nz, ny)."""
    mode: Mode
    start: Start
    clock: Clock
    """What T* is told beside z; T, too, if it changes with time."""
    activation: Activation
    encoder: Layers
    """T: from x (and the clock, if T changes with time) to z."""
    decoder: Layers
    """T*: from z and the clock to x."""
    facts: Mapping[str, Any]
    """What else is known of the training: initial states dropped, the error of T, a sweep."""

    @cached_property
    def dynamics(self) -> Dynamics:
        """The dynamics of z."""
        return Dynamics(self.A, self.B, self.mode)

    @cached_property
    def rest(self) -> np.ndarray:
        """What z begins at over a constant output, (nz, ny); zero unless it begins at rest."""
        return at_rest(self.dynamics, self.start)

    def T(self, x: np.ndarray, t: float = 0.0, u: np.ndarray | None = None) -> np.ndarray:
        """What z is at states (..., nx), (..., nz); if T changes with time, at time t since the
        first sample (s) and inputs u."""
        if self.encoder[0][0].shape[1] > x.shape[-1]:
            u = np.zeros(len(self.clock.amplitudes)) if u is None else u
            inputs = self.clock(np.asarray(t), u)
            x = np.concatenate([x, np.broadcast_to(inputs, (*x.shape[:-1], inputs.shape[-1]))], -1)
        return perceptron(self.encoder, self.activation, x)

    def inverse(self, z: np.ndarray, t: float | np.ndarray, u: np.ndarray) -> np.ndarray:
        """Estimates (..., nx) at z (..., nz), times t since the first sample, inputs (..., nu)."""
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
        found = {"nx": len(self.decoder[-1][1]), "ny": self.B.shape[1]}
        check_same(path, found, {"nx": system.nx, "ny": system.ny})


@dataclass(frozen=True)
class KKL(LearnedEstimator, Estimator):
    """What the learned KKL observers share: ż = A_z z + B_z y, exactly integrated for outputs that
    are straight lines between samples, of any lengths, and x̂ = T*(z).

    A missing output is replaced by h of the model's prediction from the last x̂.
    """

    trained: TrainedKKL = field(kw_only=True, repr=False)
    """The trained observer."""

    knows = ("model", "noise", "simulated true states")
    exempt_from = {"model_alone": "its estimate is a function of z, which knows no prior"}
    equations = r"""
\dot z &= A_z z + B_z y, \qquad z_{k+1} = \Phi z_k + \Gamma_0 y_k + \Gamma_1 y_{k+1} \\
\hat x &= T^*(z), \qquad \tfrac{\partial T}{\partial t} + \tfrac{\partial T}{\partial x}\,
f(t, x, u) = A_z T + B_z h(t, x, u)
"""

    def reset(self, prior: Prior) -> State:
        return State(np.array(prior.mean, dtype=float))

    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        trained = self.trained
        y = self._complete(state, t, y, u)
        if state.t is None:
            z, first = self._begin(state.xhat, y), t
        else:
            before, first, y0 = state.memory
            flow, held, now = trained.dynamics.step(round(t - state.t, 12))
            z = before @ flow.T
            z += y0 @ held.T
            z += y @ now.T
        return State(trained.inverse(z, t - first, u), t, u, memory=(z, first, y))

    def _begin(self, xhat: np.ndarray, y: np.ndarray) -> np.ndarray:
        if self.trained.start == "prior":
            return self.trained.T(xhat)
        return y @ self.trained.rest.T

    def _complete(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Outputs with what the model predicts where it is missing."""
        missing = np.isnan(y)
        if not missing.any():
            return y
        rows = missing.any(axis=1)
        xhat = state.xhat[rows]
        if state.t is not None:
            before = None if state.u is None else state.u[rows]
            xhat = model_step(self.system, state.t, t, xhat, before, u[rows])
        y = y.copy()
        y[rows] = np.where(missing[rows], self.system.h(t, xhat, u[rows]), y[rows])
        return y


@dataclass(frozen=True)
class KKLSupervised(KKL):
    """A KKL observer, ż = A_z z + B_z y and x̂ = T*(z), whose T* is fitted to simulated pairs of
    states and z (Ramos et al. 2020)."""

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
    """A KKL observer, ż = A_z z + B_z y and x̂ = T*(z), whose T is fitted to simulated pairs and to
    its partial differential equation at other points (Niazi et al. 2023)."""

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
    """A KKL observer, ż = A_z z + B_z y and x̂ = T*(z), whose T is fitted to its own equation over
    several samples, and T* to T, without simulated z (Peralez & Nadri 2021)."""

    name = "kkl_autoencoder"
    equations = (
        KKL.equations.rstrip()
        + r""" \\
T &: \; \min \sum_k \Bigl\| T(x_{k+m}) - \Phi^m T(x_k)
- \sum_{j=k}^{k+m-1} \Phi^{k+m-1-j} (\Gamma_0 y_j + \Gamma_1 y_{j+1}) \Bigr\|^2 \\
T^* &: \; \min \textstyle\sum_k \| T^*(z_k) - x_k \|^2, \qquad z_k \text{ as } T \text{ says}
"""
    )
    needs_training = "kkl_autoencoder"
