"""A learned gain shared by all episodes, trained in advance on outputs and the model's equations
only."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pinnobs_gym.estimation.estimator import State
from pinnobs_gym.estimation.gaussian import GaussianEstimator, checked, covariances, predicted
from pinnobs_gym.estimation.kalman import observe
from pinnobs_gym.estimation.learned.gain_network import (
    Variant,
    memory_size,
    recurrent_gain,
    shapes,
    update_with_network,
)
from pinnobs_gym.estimation.learned.perceptron import Layers
from pinnobs_gym.estimation.learned.trained import LearnedEstimator, Trained
from pinnobs_gym.estimation.learned.trained_file import check_same
from pinnobs_gym.estimation.recursive import RecursiveEstimator
from pinnobs_gym.estimation.takes import EVERYTHING
from pinnobs_gym.simulation.kernels.source import WIDEST
from pinnobs_gym.simulation.matrices import mapped
from pinnobs_gym.simulation.model import model_step
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.residual import nearest
from pinnobs_gym.simulation.system import System, output_scale, vector
from pinnobs_gym.simulation.value_shape import outputs_at

if TYPE_CHECKING:
    from pinnobs_gym.estimation.export.algorithm import Algorithm
    from pinnobs_gym.simulation.kernels.plant_code import PlantCode


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainedGain(Trained):
    """A trained network for the gain. Its loss is the error on held-out episodes, relative to that
    of the EKF."""

    layers: Layers
    """Weights and biases with the least held-out loss."""
    variant: Variant
    """``kalman`` corrects a Kalman gain; ``gru`` is a recurrent network without covariance."""

    @property
    def width(self) -> int:
        """Number of neurons per hidden layer."""
        return self.layers[-1][0].shape[1]

    def check_fits(self, path: str | Path, system: System) -> None:
        sizes = [list(W.shape) for W, b in self.layers if b.shape == W.shape[:1]]
        expected = [list(s) for s in shapes(self.variant, system.nx, system.ny, self.width)]
        check_same(path, {"sizes": sizes}, {"sizes": expected})


@dataclass(frozen=True)
class PinnGain(LearnedEstimator, RecursiveEstimator, GaussianEstimator):
    """A Kalman filter whose gain is corrected by a small network, one for all episodes. The network
    is trained in advance on outputs and the model's equations, without true states.

    Prediction, default tuning and covariance are those of the `EKF`. The inputs of the network at a
    sample are the prediction, its covariance, the innovation and the size of recent innovations. It
    scales and shifts the Kalman gain within bounds that shrink with P
    (`pinnobs_gym.estimation.learned.gain_network.corrected_gain`), and P is updated in Joseph's
    form with the corrected gain. The noise level enters through R, so that the network can be used
    at another noise level than that of its training. It sees angles within half a period about
    zero. The form resembles that of Recursive KalmanNet (Mortada et al. 2025) and KalmanNet (Revach
    et al. 2022), which learn from true states.

    The variant ``gru`` is a recurrent network for the gain in x̂ = x̂⁻ + K(y − h(t, x̂⁻, u)), without
    a covariance.

    When to choose it: where one plant is estimated often enough to be worth a training beforehand,
    and the gain of `ekf` is not good enough in the transient. True states are not needed.
    """

    trained: TrainedGain = field(kw_only=True, repr=False)
    """The trained network."""

    name = "pinn_gain"
    exempt_from = {
        "noise_matrix": "the variant gru sees the outputs' standard deviations alone",
        "sampled_noise": "its network remembers the sizes of innovations, however uncertain",
    }
    takes = EVERYTHING
    equations = r"""
K &= P_k^- H^\top S^{-1}, \qquad s_j = \bigl( (H P_k^- H^\top)_{jj} / S_{jj} \bigr)^{3/4} \\
K'_{ij} &= K_{ij}\, 8^{\tanh(a_{ij} s_j)}
+ \tanh(b_{ij} s_j) \sqrt{P^-_{k,ii} / S_{jj}} \\
(a, b) &= \text{network}(\hat x_k^-, P_k^-, e_k, \text{recent innovations}) \\
\hat x_k &= \hat x_k^- + K' e_k, \qquad
P_k = (I - K' H)\, P_k^- (I - K' H)^\top + K' R K'^\top
"""
    template = "learned_gain"
    needs_training = "pinn_gain"
    knows = ("model", "prior", "noise", "initial set")

    def reset(self, prior: Prior) -> State:
        return self.begin(checked(prior))

    def begin(self, prior: Prior, R: np.ndarray | None = None) -> State:
        """Return the state before the first sample, as `reset` does; a covariance R of the output
        noise of all samples, shape (ny, ny, batch), replaces the known one."""
        batch = len(prior.mean)
        scale = vector(self.system.scale, self.system.nx, "scale")[:, None]
        size = memory_size(self.trained.variant, self.system.ny, self.trained.width)
        if self.trained.variant == "gru":
            fixed = scale, output_scale(self.system)[:, None], R
            return State(prior.mean, memory=(fixed, np.zeros((size, batch))))
        return State(prior.mean, P=prior.cov, memory=((scale, R), np.ones((size, batch))))

    def predict(self, state: State, t: float, u: np.ndarray) -> State:
        if self.trained.variant == "gru":
            assert state.t is not None
            xhat = model_step(self.system, state.t, t, state.xhat, state.u, u)
            return State(xhat, state.t, state.u, memory=state.memory)
        return predicted(self.system, state, covariances(state), self.noise, t, u)

    def correct(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        if self.trained.variant == "gru":
            return self._recurrent(state, t, y, u)
        fixed, memory = state.memory
        scale, R = fixed
        R = self.noise.R(t, y) if R is None else R
        xhat, P = state.xhat, covariances(state)
        innovation, H = observe(self.system, t, xhat, y, u)
        seen = nearest(xhat, 0.0, self.system.state_period)  # angles within a period
        x, e = np.ascontiguousarray(seen.T), np.ascontiguousarray(innovation.T)
        x, P, S, memory = update_with_network(
            self.trained.layers, scale, x, P, e, H, R, memory, ~np.isnan(y).T
        )
        P, S = P.transpose(2, 0, 1), S.transpose(2, 0, 1)
        xhat = x.T if seen is xhat else x.T + (xhat - seen)
        return State(xhat, t, u, P, innovation, S, (fixed, memory))

    def _recurrent(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        """Apply `correct` with the recurrent network's gain, without a covariance."""
        fixed, memory = state.memory
        scale, size, R = fixed
        std = np.sqrt(np.einsum("iib->ib", self.noise.R(t) if R is None else R))
        xhat = state.xhat
        innovation = self.system.output_residual(y, outputs_at(self.system, t, xhat, u))
        innovation = np.where(np.isnan(y), 0.0, innovation)
        seen = nearest(xhat, 0.0, self.system.state_period)
        x, e = np.ascontiguousarray(seen.T), np.ascontiguousarray(innovation.T)
        known_noise = np.broadcast_to(std, e.shape)
        K, new = recurrent_gain(self.trained.layers, scale, size, x, e, known_noise, memory)
        memory = np.where(np.isnan(y).all(axis=1), memory, new)  # a row without outputs is no step
        xhat = xhat + mapped(K, innovation)
        return State(xhat, t, u, innovation=innovation, memory=(fixed, memory))

    def not_compiled(self) -> str:
        if self.trained.variant == "gru":
            return "its network is recurrent"
        wide = self.trained.width > WIDEST
        return f"its network is {self.trained.width} wide, more than {WIDEST}" if wide else ""

    def plan_settings(self) -> dict[str, Any]:
        parts = chain.from_iterable(self.trained.layers)
        return {
            "network": np.concatenate([np.ravel(part) for part in parts]),
            "width": self.trained.width,
            "scale": vector(self.system.scale, self.system.nx, "scale"),
            "carried": self.system.ny,
        }

    def carried_memory(self, memory: Any) -> tuple[Any, dict[str, np.ndarray]]:
        fixed, averages = memory
        averages = np.array(averages, dtype=float, order="C")
        return (fixed, averages), {"carried": averages}

    def given_noise(self, memory: Any) -> np.ndarray | None:
        return memory[0][1]

    def memory_rows(self, memory: Any, rows: np.ndarray) -> Any:
        (scale, R), averages = memory
        R = R[..., rows] if R is not None and R.shape[-1] > 1 else R
        return (scale, R), averages[:, rows]

    def with_memory_rows(self, memory: Any, rows: np.ndarray, part: Any) -> Any:
        fixed, averages = memory
        averages = averages.copy()
        averages[:, rows] = part[1]
        return fixed, averages

    def exported(self, code: PlantCode, prior: Prior) -> Algorithm | None:
        return None
