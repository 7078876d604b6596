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
from pinnobs_gym.estimation.learned.kkl_region import Region
from pinnobs_gym.estimation.learned.perceptron import Layers, perceptron
from pinnobs_gym.estimation.learned.trained import LearnedEstimator, Trained
from pinnobs_gym.estimation.learned.trained_file import check_same
from pinnobs_gym.estimation.takes import EVERYTHING, NotTaken
from pinnobs_gym.estimators.ukf import UKF
from pinnobs_gym.simulation.model import model_step
from pinnobs_gym.simulation.notices import say_first
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.system import Array, System
from pinnobs_gym.simulation.value_shape import outputs_at

if TYPE_CHECKING:
    from pinnobs_gym.estimation.export.algorithm import Algorithm
    from pinnobs_gym.simulation.kernels.plant_code import PlantCode

_HOLD = 3.0
"""How long z has to be inside of its region before its estimates count again, over its slowest time
constant. What is left of earlier outputs is then e⁻³ of them."""


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
    """B_z, shape (nz, ny), in 1/s per output unit; or (nz, ny + nu) if inputs drive z, too."""
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
    region: Region | None = None
    """Where T* was trained; None without a fallback."""

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
        drives = self.B.shape[1]
        ny = system.ny if drives == system.ny + system.nu else drives
        sizes = {"nx": len(self.decoder[-1][1]), "ny": ny}
        check_same(path, sizes, {"nx": system.nx, "ny": system.ny})


@dataclass(frozen=True, eq=False)
class KKLMemory:
    """What a KKL observer remembers beside the fields of `State`."""

    z: np.ndarray | None = None
    """State of the observer, shape (batch, nz); None before the first sample, as the next two."""
    first: float | None = None
    """Time of the first sample in s."""
    y: np.ndarray | None = None
    """Outputs at the last sample, predicted ones where they are missing, followed by the inputs if
    these drive z; shape (batch, ny) or (batch, ny + nu)."""
    left: np.ndarray | None = None
    """Time in s at which z was last outside of its region, −∞ if it never was, shape (batch,); None
    without a fallback."""
    beside: State | None = None
    """State of the fallback."""


@dataclass(frozen=True)
class KKL(LearnedEstimator, Estimator):
    """The base class of the learned KKL observers, ż = A_z z + B_z y and x̂ = T*(z).

    In continuous mode z is integrated exactly for outputs that are linear between samples at any
    times; in discrete mode by Euler steps. A missing output is replaced by h of the model's
    prediction from the previous estimate.

    T* is right only where it was trained. An unscented Kalman filter that is told the same runs
    alongside from the prior, and while z is outside of the region of the training (`Region`), and
    for three of its slowest time constants after, the estimate is that of the filter. ``outside``
    of the state says when. z goes on meanwhile, since it depends on the outputs alone. An observer
    trained with ``fallback=False`` gives T*(z) everywhere.

    Of a plant whose inputs are drawn (`System.draw_input`), z is driven by outputs and inputs
    alike, so that it knows the recent past of both.
    """

    trained: TrainedKKL = field(kw_only=True, repr=False)
    """The trained observer."""

    knows = ("model", "noise", "initial set", "simulated true states")
    exempt_from = {
        "model_alone": "its estimate is a function of z, which knows no prior",
        "blank_rows": "a missing output is replaced by that of its own prediction",
        "units": "its maps were learned in the units of its training",
        "sampled_noise": "z takes every output as it is, however uncertain",
        "held_input": "T* is given the input at the sample, too, on which outputs may depend",
    }
    takes = EVERYTHING - {"maps", "stiff", "output_period"}
    equations = r"""
\dot z &= A_z z + B_z y, \qquad z_{k+1} = \Phi z_k + \Gamma_0 y_k + \Gamma_1 y_{k+1} \\
\hat x &= T^*(z), \qquad \tfrac{\partial T}{\partial t} + \tfrac{\partial T}{\partial x}\,
f(t, x, u) = A_z T + B_z h(t, x, u)
"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self._held and not self._takes_inputs:
            raise NotTaken(
                f"{self.label} was trained with the inputs that {type(self.system).__name__} "
                "defines; for measured ones that are held it has to be trained on drawn ones "
                "(System.draw_input)"
            )

    @cached_property
    def _hold(self) -> float:
        """How long z has to be inside of its region before its estimates count again, in s."""
        return _HOLD / self.trained.dynamics.slowest

    @property
    def _takes_inputs(self) -> bool:
        """Whether inputs drive z, too."""
        return self.trained.B.shape[1] > self.system.ny

    @property
    def _held(self) -> bool:
        """Whether there are measured inputs that are held between samples."""
        system = self.system
        return system.measured_input and system.nu > 0 and system.input_hold == "previous"

    @property
    def training(self) -> dict[str, Any]:
        """Training metadata; z that starts at T(x̂₀) knows the prior, as does a fallback."""
        facts, trained = super().training, self.trained
        knows_prior = trained.start == "prior" or trained.region is not None
        return {**facts, "knows": ("prior",)} if knows_prior else facts

    @cached_property
    def fallback(self) -> UKF:
        """The filter whose estimates count where T* was not trained."""
        return UKF(self.system, self.noise_std, self.process_noise)

    def reset(self, prior: Prior) -> State:
        mean = np.array(prior.mean, dtype=float)
        if self.trained.region is None:
            return State(mean, memory=KKLMemory())
        left, beside = np.full(len(mean), -np.inf), self.fallback.reset(prior)
        return State(mean, memory=KKLMemory(left=left, beside=beside))

    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        trained, memory, given = self.trained, state.memory, y
        y = self._complete(state, t, y, u)
        if self._takes_inputs:
            y = np.concatenate([y, u], axis=1)
        if state.t is None:
            z, first = self._begin(state.xhat, y), t
        else:
            first, end = memory.first, y
            if self._takes_inputs and self._held:  # until the sample they are those of the last one
                ny = self.system.ny
                end = np.concatenate([y[:, :ny], memory.y[:, ny:]], axis=1)
            flow, gamma0, gamma1 = trained.dynamics.step(t - state.t)
            z = memory.z @ flow.T
            z += memory.y @ gamma0.T
            z += end @ gamma1.T
        xhat = trained.inverse(z, t - first, u)
        if trained.region is None:
            return State(xhat, t, u, memory=KKLMemory(z, first, y))
        beside = self.fallback.update(memory.beside, t, given, u)
        left = np.where(trained.region.outside(z, xhat), t, memory.left)
        outside = t - left <= self._hold
        if outside.any():
            self._say()
            xhat = np.where(outside[:, None], beside.xhat, xhat)
        memory = KKLMemory(z, first, y, left, beside)
        return State(xhat, t, u, memory=memory, outside=outside.astype(float))

    def _say(self) -> None:
        """Say once that estimates are not those of T*."""
        what = f"{self.label} on {type(self.system).__name__}"
        say_first(
            f"{what}: outside",
            f"{what}: z left the region of its training; estimates there, marked as outside, are "
            f"those of the {self.fallback.label} that runs alongside",
        )

    def exported(self, code: PlantCode, prior: Prior) -> Algorithm | None:
        from pinnobs_gym.estimation.export.kkl import kkl_code

        if self._takes_inputs:
            raise ValueError(f"{self.label} is driven by measured inputs, too: it is not exported")
        return kkl_code(self.trained, self.system, code, self._hold)

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
